"""Networks: copies are equal and not connected; a user's network is simulated, or refused by
name.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.replay.export import converted, open_drive
from safevar_sumo.scenarios.published import (
    LATERAL_START,
    WALKING_SPEED,
    PedestrianCrossing,
)
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.sumo.engine import open_world
from safevar_sumo.sumo.matrix import drive_worst
from safevar_sumo.sumo.network import (
    _BuiltRoads,
    built_network,
    copied_network,
    open_network,
    program_of_sumo,
)
from safevar_sumo.sumo.network_check import check_network
from safevar_sumo.sumo.system import System
from tests.support.in_process import SLOW, own_network, rewrite
from tests.support.made_up import system_of

FOLDERS = sorted(path.name for path in NETWORKS.iterdir() if path.is_dir())


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_recipe_builds_the_network_that_is_kept(
    folder: str, tmp_path: Path
) -> None:
    own_network(tmp_path / folder, folder)
    subprocess.run(
        [program_of_sumo("netconvert", folder), "-c", "network.netccfg"],
        cwd=tmp_path / folder,
        check=True,
        capture_output=True,
    )

    def without_head(path: Path) -> str:
        return path.read_text().partition("\n<net ")[2]

    assert without_head(tmp_path / folder / "network.net.xml") == without_head(
        NETWORKS / folder / "network.net.xml"
    )


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_network_has_the_road_that_netconvert_makes_of_it(folder: str) -> None:
    assert converted(open_network(folder)) == open_drive(open_network(folder))


def test_constants_of_the_published_crossing_are_those_of_its_files() -> None:
    """How fast the pedestrian walks, and how far beside the vehicle's lane the walk begins."""
    person = ElementTree.parse(NETWORKS / "pedestrian_crossing/traffic.rou.xml").find(
        "person"
    )
    assert person is not None
    walk = person.find("walk")
    assert walk is not None
    scenario = PedestrianCrossing(
        lateral_start=LATERAL_START, walking_speed=WALKING_SPEED
    )
    actors = scenario.actors(_BuiltRoads(open_network("pedestrian_crossing")))
    stated = actors["person[@id='pedestrian']"]["departPos"]
    assert float(stated) == float(person.attrib["departPos"])
    assert actors["person[@id='pedestrian']/walk"]["speed"] == walk.attrib["speed"]


def test_without_sumos_programs_what_needs_them_says_so(
    mine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # a network that is in no cache
    rewrite(mine / "network.edg.xml", ('width="4"', 'width="3.9"'))
    monkeypatch.setitem(sys.modules, "sumo", None)
    with pytest.raises(
        InputError, match=r"netccfg: needs SUMO's program netconvert\n.*\[sumo\]"
    ):
        check_network(str(mine))
    with pytest.raises(InputError, match=r"sumo-gui\n.*\[sumo\]"):
        program_of_sumo("sumo-gui", "gui")
    (mine / "network.netccfg").unlink()
    check_network(str(mine))
    with pytest.raises(
        InputError, match=r"an export of .*mine: needs SUMO's program netconvert\n"
    ):
        open_drive(open_network(str(mine)))


CAR = (
    '<vType id="car" speedDev="0" sigma="0"/>'
    '<vType id="walker" vClass="pedestrian" speedDev="0"/>'
)


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    return own_network(tmp_path / "mine")


GOOD = {
    "a flow": (
        '<flow id="f" type="car" from="oncoming" to="oncoming_on" begin="0" end="9" period="3"/>'
    ),
    "a flow on a route": (
        '<route id="r" edges="oncoming"/>'
        '<flow id="f" type="car" route="r" begin="0" end="9" number="2"/>'
    ),
    "a trip": '<trip id="t" type="car" depart="0" from="oncoming" to="oncoming_on"/>',
    "a late vehicle": (
        '<vehicle id="t" type="car" depart="0:0:2"><route edges="oncoming"/><stop edge="oncoming" '
        'duration="1"/></vehicle>'
    ),
    "a person's trip": (
        '<person id="w" type="walker" depart="0">'
        '<personTrip from="footpath" to="footpath_on"/></person>'
    ),
    "a flow of persons": (
        '<personFlow id="w" type="walker" begin="0" end="4" period="2"><walk from="footpath" '
        'to="footpath_on"/></personFlow>'
    ),
    "stop and walk": (
        '<person id="w" type="walker" depart="0"><stop lane="footpath_0" duration="2"/><walk '
        'edges="footpath"/></person>'
    ),
    "parameters": (
        '<vehicle id="v" type="car" depart="0"><route edges="oncoming"/><param key="note"'
        ' value="approach"/></vehicle>'
    ),
}


@SLOW
@pytest.mark.parametrize("what", sorted(GOOD))
def test_legal_traffic_moves_equally_in_every_copy(mine: Path, what: str) -> None:
    rewrite(mine / "traffic.rou.xml", ("</routes>", f"{CAR}{GOOD[what]}</routes>"))
    network = str(mine)
    check_network(network)
    with open_world(copied_network(open_network(network), 2), 2) as world:
        world.enter(None)
        seen = set()
        for _ in range(60):
            world.api.simulationStep()
            there = world.actor_poses()
            first, second = (
                {
                    name[2:]: place
                    for name, place in there.items()
                    if name.startswith(copy)
                }
                for copy in ("0.", "1.")
            )
            assert first == second
            seen |= set(first)
        assert seen > {"vut", "pedestrian"}


def on(network: Path) -> System:
    return system_of("smoke", scenario={"parameters": {"network": str(network)}})


def roads(network: Path, n: int = 1) -> ElementTree.Element:
    return ElementTree.parse(
        copied_network(open_network(str(network)), n).network
    ).getroot()


@SLOW
def test_edge_types_in_a_separate_file_change_the_network(mine: Path) -> None:
    before = open_network(str(mine)).digests
    (mine / "network.typ.xml").write_text(
        '<types><type id="slow" speed="7" numLanes="1" width="3" disallow="pedestrian"/></types>'
    )
    rewrite(
        mine / "network.netccfg",
        ("</input>", '<type-files value="network.typ.xml"/></input>'),
    )
    rewrite(
        mine / "network.edg.xml",
        (
            'id="departure" from="crossing" to="east" numLanes="1" width="4" speed="70"'
            ' disallow="pedestrian"',
            'id="departure" from="crossing" to="east" type="slow"',
        ),
    )
    check_network(str(mine))
    (lane,) = roads(mine).iterfind(".//lane[@id='0.departure_0']")
    assert [float(lane.attrib[name]) for name in ("speed", "width")] == [7, 3]
    assert open_network(str(mine)).digests != before
    first = copied_network(open_network(str(mine)), 1).network
    rewrite(mine / "network.typ.xml", ('speed="7"', 'speed="8"'))
    assert copied_network(open_network(str(mine)), 1).network != first


def test_a_built_network_without_sources_gives_the_same_results(mine: Path) -> None:
    settings = np.vstack(
        [
            original := system_of("smoke").characteristics.original_settings,
            original * 1.01,
        ]
    )
    expected = drive_worst(on(mine), settings).trace.gap
    for name in (
        "network.nod.xml",
        "network.edg.xml",
        "network.con.xml",
        "network.netccfg",
    ):
        (mine / name).unlink()
    assert np.array_equal(drive_worst(on(mine), settings).trace.gap, expected)
    (mine / "network.net.xml").rename(mine / "town.net.xml")
    for network in (mine, mine / "town.net.xml"):
        assert np.array_equal(drive_worst(on(network), settings).trace.gap, expected)
    shutil.copy(mine / "town.net.xml", mine / "village.net.xml")
    with pytest.raises(InputError, match=r"has town\.net\.xml and village\.net\.xml"):
        on(mine)


def test_no_id_of_a_built_network_belongs_to_two_copies(tmp_path: Path) -> None:
    """A network with sidewalks, crossings, traffic lights and opposite lanes: its copies contain no
    id of the original.
    """
    subprocess.run(
        [
            program_of_sumo("netgenerate", "my_map"),
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
    plain = ElementTree.parse(
        built_network(open_network(str(tmp_path / "town.net.xml")))
    ).getroot()
    originals = {
        one.attrib["id"]
        for one in plain.iter()
        if one.tag in ("edge", "lane", "junction", "tlLogic")
    }
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


@SLOW
def test_a_file_that_options_of_sumo_add_is_one_of_the_networks_files(
    mine: Path,
) -> None:
    (mine / "more.add.xml").write_text('<additional><vType id="more"/></additional>')
    rewrite(
        mine / "scenario.sumocfg",
        ("</input>", '<additional-files value="more.add.xml"/></input>'),
    )
    check_network(str(mine))
    before = open_network(str(mine)).digests
    (mine / "more.add.xml").write_text(
        '<additional><vType id="more" length="7"/></additional>'
    )
    assert open_network(str(mine)).digests != before
