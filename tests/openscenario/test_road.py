"""Roads of OpenDRIVE, beside those that netconvert makes of the same file."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.openscenario.road import read_network
from safevar_sumo.sumo.network import run_program
from tests.openscenario.writing import ROAD, STRAIGHT

BEND = """<geometry s="0" x="300" y="-40" hdg="0.5" length="100"><line/></geometry>
<geometry s="100" x="387.758256" y="7.942554" hdg="0.5" length="157.079633">
<arc curvature="0.01"/></geometry>"""


def distance_to(line: np.ndarray, place: complex) -> float:
    """The distance of a place from a line of vertices [m]."""
    ways = []
    for a, b in pairwise(line):
        share = np.clip(((place - a) * (b - a).conjugate()).real / abs(b - a) ** 2, 0, 1)
        ways.append(abs(a + share * (b - a) - place))
    return min(ways)


@pytest.mark.parametrize(
    ("geometry", "length", "within"),
    [(STRAIGHT, 2000.0, 1e-5), (BEND, 257.079633, 0.006)],
    ids=["straight", "bend"],
)
def test_lanes_are_where_netconvert_has_them(
    tmp_path: Path, geometry: str, length: float, within: float
) -> None:
    """Without its offset; an arc becomes a polygon with a vertex each 2 m there, 0.005 m away at a
    radius of 100 m.
    """
    (tmp_path / "road.xodr").write_text(ROAD.format(length=length, geometry=geometry))
    options = ("--offset.disable-normalization", "--output.original-names", "--precision", "6")
    code, errors = run_program(
        tmp_path, "netconvert", "--opendrive-files", "road.xodr", *options, "-o", "net.xml"
    )
    assert code == 0, errors
    road = read_network(str(tmp_path / "road.xodr")).road("1")
    lanes = {}
    for lane in ElementTree.parse(tmp_path / "net.xml").findall("edge[@type]/lane"):
        name = next(
            one.get("value", "") for one in lane.iter("param") if one.get("key") == "origId"
        )
        points = [complex(*map(float, point.split(","))) for point in lane.get("shape", "").split()]
        lanes[int(name.rpartition("_")[2])] = np.array(points)
    assert sorted(lanes) == [-2, -1, 1, 2]
    for name, line in lanes.items():
        for s in np.linspace(15.0, length - 15.0, 9):
            place = road.line.pose(s, road.lane_t(name, s)).place
            assert distance_to(line, place) < within, (name, s)
            assert road.lane_at(s, road.lane_t(name, s)) == name
