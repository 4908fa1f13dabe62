"""A user's network is simulated with its recipe, edge types and traffic lights, or as a single `.net.xml`; otherwise it
is refused.
"""

from __future__ import annotations

import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import sumo

from safevar_sumo.errors import InputError
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import simulate
from safevar_sumo.sumo.network import built_network, copied_network, open_network
from safevar_sumo.sumo.network_check import check_network
from safevar_sumo.sumo.system import System, assemble

NETCONVERT = str(Path(sumo.SUMO_HOME) / "bin" / "netconvert")


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A user's copy of a network with a crossing."""
    shutil.copytree(NETWORKS / "pedestrian_crossing", tmp_path / "mine")
    return tmp_path / "mine"


def rewritten(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def on(study: str, network: Path) -> System:
    return assemble(load_study(study, scenario={"parameters": {"network": str(network)}}))


def roads(network: Path, n: int = 1) -> ElementTree.Element:
    return ElementTree.parse(copied_network(open_network(str(network)), n).network).getroot()


def test_edge_types_in_a_separate_file_change_the_network(mine: Path) -> None:
    before = open_network(str(mine)).digests
    (mine / "network.typ.xml").write_text(
        '<types><type id="slow" speed="7" numLanes="1" width="3" disallow="pedestrian"/></types>'
    )
    with pytest.raises(InputError, match=r"network\.typ\.xml: is not used: network\.netccfg does not name it"):
        check_network(str(mine), "study")
    rewritten(mine / "network.netccfg", "</input>", '<type-files value="network.typ.xml"/></input>')
    rewritten(
        mine / "network.edg.xml",
        'id="departure" from="crossing" to="east" numLanes="1" width="4" speed="70" disallow="pedestrian"',
        'id="departure" from="crossing" to="east" type="slow"',
    )
    check_network(str(mine), "study")
    lane = roads(mine).find(".//lane[@id='0.departure_0']")
    assert lane is not None
    assert [float(lane.attrib[name]) for name in ("speed", "width")] == [7, 3]
    assert open_network(str(mine)).digests != before
    first = copied_network(open_network(str(mine)), 1).network
    rewritten(mine / "network.typ.xml", 'speed="7"', 'speed="8"')
    assert copied_network(open_network(str(mine)), 1).network != first


def test_traffic_lights_are_copied_with_their_programmes(mine: Path) -> None:
    rewritten(mine / "network.nod.xml", 'type="priority"', 'type="traffic_light"')
    subprocess.run(
        [
            NETCONVERT,
            "-n",
            "network.nod.xml",
            "-e",
            "network.edg.xml",
            "-x",
            "network.con.xml",
            "--tls.cycle.time",
            "77",
            "--plain-output-prefix",
            "network",
        ],
        cwd=mine,
        check=True,
        capture_output=True,
    )
    rewritten(mine / "network.tll.xml", "duration=", 'name="my own" duration=')
    check_network(str(mine), "study")
    copies = roads(mine, 2)
    lights = copies.findall("tlLogic")
    assert [light.attrib["id"] for light in lights] == ["0.crossing", "1.crossing"]
    assert all(phase.attrib["name"] == "my own" for light in lights for phase in light.iter("phase"))
    controlled = [one for one in copies.findall("connection") if "tl" in one.attrib]
    assert controlled
    assert all(
        one.attrib["tl"].partition(".")[0] == one.attrib["from"].removeprefix(":").partition(".")[0]
        for one in controlled
    )


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('<unheard-of value="1"/>', "netconvert refuses the network: No option with the name 'unheard-of' exists"),
        ('<type-files value="none.typ.xml"/>', "none.typ.xml is missing"),
    ],
)
def test_a_recipe_that_netconvert_refuses_is_an_error(mine: Path, line: str, message: str) -> None:
    rewritten(mine / "network.netccfg", "</configuration>", f"{line}</configuration>")
    with pytest.raises(InputError) as caught:
        check_network(str(mine), "study")
    assert message in str(caught.value)


def test_a_built_network_without_sources_gives_the_same_results(mine: Path) -> None:
    settings = np.vstack([original := load_original("smoke"), original * 1.01])
    expected = simulate(on("smoke", mine), settings).trace.gap
    for name in ("network.nod.xml", "network.edg.xml", "network.con.xml", "network.netccfg"):
        (mine / name).unlink()
    assert np.array_equal(simulate(on("smoke", mine), settings).trace.gap, expected)
    (mine / "network.net.xml").rename(mine / "town.net.xml")
    for network in (mine, mine / "town.net.xml"):
        assert np.array_equal(simulate(on("smoke", network), settings).trace.gap, expected)
    shutil.copy(mine / "town.net.xml", mine / "village.net.xml")
    with pytest.raises(InputError, match=r"has town\.net\.xml and village\.net\.xml"):
        on("smoke", mine)
    before = open_network(str(mine / "town.net.xml")).digests
    rewritten(mine / "town.net.xml", "<location", "<!-- --><location")
    assert open_network(str(mine / "town.net.xml")).digests != before


def load_original(study: str) -> np.ndarray:
    return assemble(load_study(study)).characteristics.original[np.newaxis]


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("network.nod.xml", 'x="80" y="0"', 'x="80" y="0" z="4"', "lane 'departure_0', which rises"),
        ("network.edg.xml", 'id="approach"', 'id="approach" friction="0.3"', "lane 'approach_0' of friction 0.3"),
    ],
)
def test_a_slope_or_friction_that_has_no_effect_is_refused(
    mine: Path, file: str, old: str, new: str, message: str
) -> None:
    rewritten(mine / file, old, new)
    with pytest.raises(InputError, match=r"traffic\.rou\.xml: vehicle 'vut' drives on ") as caught:
        check_network(str(mine), "study")
    assert message in str(caught.value)


def test_a_remark_lists_the_networks_attributes_of_the_vehicle_that_are_not_used(mine: Path) -> None:
    assert on("sun", mine).remarks == []
    rewritten(
        mine / "network.edg.xml",
        'id="approach" from="west" to="crossing" numLanes="1" width="4" speed="70"',
        'id="approach" from="west" to="crossing" numLanes="1" width="4" speed="8.33"',
    )
    rewritten(
        mine / "traffic.rou.xml", '<vType id="vut"', '<vType id="vut" carFollowModel="IDM" speedFactor="0.8" accel="3"'
    )
    (remark,) = on("sun", mine).remarks
    assert remark.startswith(
        f"{mine / 'traffic.rou.xml'}: no effect on vehicle 'vut': carFollowModel = IDM, speedFactor = 0.8, accel = 3, "
        "the speed limit of lane 'approach_0' (8.33 m/s)"
    )


def test_no_id_of_a_built_network_belongs_to_two_copies(tmp_path: Path) -> None:
    """A network with sidewalks, crossings, traffic lights and opposite lanes: its copies contain no id of the
    original.
    """
    netgenerate = str(Path(sumo.SUMO_HOME) / "bin" / "netgenerate")
    subprocess.run(
        [
            netgenerate,
            "--grid",
            "--grid.number",
            "3",
            "--default.lanenumber",
            "1",
            "--sidewalks.guess",
            "--crossings.guess",
            "--tls.guess",
            "--tls.default-type",
            "actuated",
            "--opposites.guess",
            "-o",
            str(tmp_path / "town.net.xml"),
        ],
        check=True,
        capture_output=True,
    )
    for name in ("traffic.rou.xml", "scenario.sumocfg"):
        shutil.copy(NETWORKS / "along" / name, tmp_path / name)
    root = roads(tmp_path / "town.net.xml", 2)
    plain = ElementTree.parse(built_network(open_network(str(tmp_path / "town.net.xml")))).getroot()
    originals = {one.attrib["id"] for one in plain.iter() if one.tag in ("edge", "lane", "junction", "tlLogic")}
    numbers = ("index", "fromLane", "toLane", "linkIndex", "linkIndex2", "name", "type")
    kept = {
        value
        for child in root
        if child.tag not in ("location", "type")
        for element in child.iter()
        if element.tag != "param"
        for name, text in element.attrib.items()
        if name not in numbers
        for value in text.split()
    }
    assert originals
    assert not originals & kept
    assert len(root.findall("edge")) == 2 * len(plain.findall("edge"))
