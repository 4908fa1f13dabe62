"""Roads of OpenDRIVE, beside those that netconvert makes of the same file."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

from safevar_sumo.openscenario import play
from safevar_sumo.openscenario.road import read_network
from safevar_sumo.sumo.network import program_of_sumo, run_program
from tests.openscenario.writing import ROAD, STRAIGHT, at, private, speed, teleport, world, write

BEND = """<geometry s="0" x="300" y="-40" hdg="0.5" length="100"><line/></geometry>
<geometry s="100" x="387.758256" y="7.942554" hdg="0.5" length="157.079633">
<arc curvature="0.01"/></geometry>"""


CURVE = """<geometry s="0" x="30" y="-4" hdg="0.5" length="{}">
<paramPoly3 aU="0" bU="{}" cU="{}" dU="{}"
aV="0" bV="0" cV="{}" dV="{}" pRange="{}"/></geometry>"""
CUBIC = """<geometry s="0" x="30" y="-4" hdg="0.5" length="{}">
<poly3 a="0" b="0" c="{}" d="{}"/></geometry>"""


def length_of(u: tuple[float, ...], v: tuple[float, ...], end: float) -> float:
    """The length of a curve with these polynomials, for their parameter from 0 to an end."""
    rates = [np.polynomial.Polynomial(one).deriv() for one in (u, v)]
    return float(quad(lambda p: np.hypot(*(rate(p) for rate in rates)), 0, end)[0])


def curve(u: tuple[float, ...], v: tuple[float, ...], end: float) -> tuple[str, float]:
    """A paramPoly3 of these weights of p, p^2 and p^3, and its length."""
    length = length_of((0, *u), (0, *v), end)
    range_of_p = "normalized" if end == 1 else "arcLength"
    return CURVE.format(length, *u, *v[1:], range_of_p), length


def cubic(c: float, d: float) -> tuple[str, float]:
    """A poly3 of 200 m along its first direction, and its length."""
    length = length_of((0, 1), (0, 0, c, d), 200)
    return CUBIC.format(length, c, d), length


def distance_to(line: np.ndarray, place: complex) -> float:
    """The distance of a place from a line of vertices [m]."""
    ways = []
    for a, b in pairwise(line):
        share = np.clip(((place - a) * (b - a).conjugate()).real / abs(b - a) ** 2, 0, 1)
        ways.append(abs(a + share * (b - a) - place))
    return min(ways)


@pytest.mark.parametrize(
    ("geometry", "length", "within"),
    [
        (STRAIGHT, 2000.0, 1e-5),
        (BEND, 257.079633, 0.006),
        (*curve((100, 60, 40), (0, 0, 0), 1), 1e-3),
        (*curve((200, 0, 0), (0, 20, -5), 1), 0.01),
        (*curve((1, 0, 0), (0, 5e-4, -1e-6), 200), 0.01),
        (*cubic(5e-4, -1e-6), 0.01),
    ],
    ids=["straight", "bend", "straight curve", "curve", "by arc length", "poly3"],
)
def test_lanes_are_where_netconvert_has_them(
    tmp_path: Path, geometry: str, length: float, within: float
) -> None:
    """Without its offset; a bend becomes a polygon with a vertex each 2 m there, 0.005 m away at a
    radius of 100 m.
    """
    (tmp_path / "road.xodr").write_text(ROAD.format(length=length, geometry=geometry))
    options = ("--offset.disable-normalization", "--output.original-names", "--precision", "6")
    netconvert = program_of_sumo("netconvert", "test")
    code, errors = run_program(
        tmp_path, netconvert, "--opendrive-files", "road.xodr", *options, "-o", "net.xml"
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


@pytest.mark.parametrize("kind", ["poly3", "paramPoly3"])
def test_a_place_on_a_parabola_is_found_by_its_distance_along_it(tmp_path: Path, kind: str) -> None:
    """v = c u^2 has the length u r / 2 + asinh(2 c u) / 4 c with r = sqrt(1 + 4 c^2 u^2), and the
    curvature 2 c / r^3.
    """
    c = 0.002

    def way(u: float) -> float:
        return u * math.hypot(1, 2 * c * u) / 2 + math.asinh(2 * c * u) / (4 * c)

    geometry = CURVE.format(way(80), 80, 0, 0, c * 80**2, 0, "normalized")
    if kind == "poly3":
        geometry = CUBIC.format(way(80), c, 0)
    (tmp_path / "road.xodr").write_text(ROAD.format(length=way(80), geometry=geometry))
    line = read_network(str(tmp_path / "road.xodr")).road("1").line
    start, ahead = 30 - 4j, np.exp(0.5j)
    for u in (0.0, 7.0, 40.0, 80.0):
        pose = line.pose(way(u))
        direction = ahead * (1 + 2j * c * u) / math.hypot(1, 2 * c * u)
        assert pose.place == pytest.approx(start + ahead * complex(u, c * u**2), abs=1e-5)
        assert pose.facing == pytest.approx(direction, abs=1e-5)
        bend = 2 * c / math.hypot(1, 2 * c * u) ** 3
        assert line.curvature(np.array([way(u)]))[0] == pytest.approx(bend, rel=1e-4)


@pytest.mark.parametrize("lane", [-2, 2])
def test_who_drives_in_a_lane_follows_it_where_it_moves(tmp_path: Path, lane: int) -> None:
    """The two inner lanes are 4 m + ds^3 / 2e6 m^2 wide from s = 100 m on, and lane 0 is beside the
    line by ds^2 / 8,000 m; the body keeps its speed along its own direction.
    """
    ego = private("Ego", teleport(world(0, 18)), speed(20))
    file = write(tmp_path, ego=ego, car=(teleport(at(lane, 120 if lane < 0 else 420)), speed(10)))
    text = (tmp_path / "road.xodr").read_text()
    inner = "<width sOffset='100' a='4' b='0' c='0' d='5e-7'/></lane>"
    for name in (1, -1):
        before, _, after = text.partition(f'<lane id="{name}"')
        text = before + f'<lane id="{name}"' + after.replace("</lane>", inner, 1)
    offset = "<laneOffset s='100' a='0' b='0' c='1.25e-4' d='0'/>"
    (tmp_path / "road.xodr").write_text(text.replace("<lanes>", f"<lanes>{offset}"))
    (car,) = play(file, {}).others
    place = car.place - 1.5 * car.facing - complex(10, 20)
    ds = place.real - 100
    t = 1.25e-4 * ds**2 + np.sign(lane) * (4 + 5e-7 * ds**3 + 2)
    assert np.abs(place.imag - t)[1:].max() < 1e-3
    assert np.abs(np.abs(np.diff(place)) - 10 * 0.01).max() < 1e-5
