"""Copies of a network: their number is right, all are equal, and no two are connected."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import sumo

from safevar_sumo.errors import EnvironmentFault, InputError
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.sumo.cache import CHECKSUM_FILE, ensure_all_cached
from safevar_sumo.sumo.engine import open_world
from safevar_sumo.sumo.network import copied_network, open_network
from safevar_sumo.sumo.network_check import check_network
from safevar_sumo.sumo.staging import _store_network

FOLDERS = sorted(path.name for path in NETWORKS.iterdir() if path.is_dir())
BINARIES = Path(sumo.SUMO_HOME) / "bin"


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_recipe_builds_the_network_that_is_kept(folder: str, tmp_path: Path) -> None:
    shutil.copytree(NETWORKS / folder, tmp_path / folder)
    subprocess.run(
        [str(BINARIES / "netconvert"), "-c", "network.netccfg"], cwd=tmp_path / folder, check=True, capture_output=True
    )

    def without_head(path: Path) -> list[str]:
        lines = path.read_text().splitlines()
        return lines[next(i for i, line in enumerate(lines) if line.startswith("<net ")) :]

    assert without_head(tmp_path / folder / "network.net.xml") == without_head(NETWORKS / folder / "network.net.xml")


def test_copies_share_coordinates_and_nothing_else() -> None:
    text = copied_network(open_network("pedestrian_crossing"), 2).network.read_text()
    shapes = {
        copy: [
            line.split('shape="')[1].split('"')[0]
            for line in text.splitlines()
            if f'lane id="{copy}.approach_0"' in line
        ]
        for copy in (0, 1)
    }
    assert shapes[0] == shapes[1] != []
    connections = [
        dict(re.findall(r'(from|to)=":?(\d+)\.', line)) for line in text.splitlines() if "<connection " in line
    ]
    assert {one["from"] for one in connections} == {"0", "1"}
    assert all(one["from"] == one["to"] for one in connections)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_text(path.read_text().replace('id="0', 'id="00')),
        lambda path: path.write_text("<net><edge id='x'/></net>"),
        lambda path: path.write_bytes(path.read_bytes()[:-500]),
        lambda path: path.write_bytes(b""),
        Path.unlink,
    ],
)
@pytest.mark.parametrize("which", ["network", "traffic"])
def test_a_damaged_file_in_the_cache_is_built_again(spoil: Callable[[Path], None], which: str) -> None:
    file: Path = getattr(copied_network(open_network("lead_vehicle_stopped"), 2), which)
    built = file.read_bytes()
    spoil(file)
    assert getattr(copied_network(open_network("lead_vehicle_stopped"), 2), which) == file
    assert file.read_bytes() == built
    assert {path.name for path in file.parent.iterdir()} == {file.name, CHECKSUM_FILE}


def test_a_variant_of_a_network_is_checked_before_use_as_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = ("traffic.rou.xml", b"<routes/>"), ("scenario.sumocfg", b"<configuration/>"), ("network.net.xml", b"<net/>")
    build = _store_network.__wrapped__
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = build("road", files).folder
    (folder / files[0][0]).write_bytes(b"<rou")
    (folder / files[1][0]).unlink()
    assert build("road", files).folder == folder
    assert {name: (folder / name).read_bytes() for name, _ in files} == dict(files)
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(EnvironmentFault, match="cannot write the cache of networks"):
        build("road", files)


def test_a_folder_of_the_cache_is_moved_into_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rating needs 2,200 of them; removing a temporary folder for each took two thirds of the time on some file
    systems.
    """
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(os, "rmdir", lambda *_, **__: pytest.fail("a folder is removed"))
    folder = ensure_all_cached("road", ["a"], lambda into: into.joinpath("a").touch())
    assert [path.name for path in folder.parent.iterdir()] == ["road"]


def test_two_processes_may_build_the_same_folder_of_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def build(into: Path) -> None:
        (into / "a").write_bytes(b"same")

    def build_later(into: Path) -> None:
        ensure_all_cached("road", ["a"], build)
        build(into)

    folder = ensure_all_cached("road", ["a"], build_later)
    assert {path.name for path in folder.iterdir()} == {"a", CHECKSUM_FILE}
    assert [path.name for path in folder.parent.iterdir()] == ["road"]
    ensure_all_cached("road", ["a"], lambda _: pytest.fail("the folder is built again"))


@pytest.mark.parametrize(("loss", "n"), [("half", 12), ("nothing", 25), ("error", 60)])
def test_a_full_disk_during_a_build_leaves_no_files(
    loss: str, n: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In an empty cache, because other tests may have built as many copies already."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    ran = subprocess.run

    def full(command: list[str], **options: Any) -> Any:
        done = ran(command, **options)
        target = Path(command[command.index("-o") + 1])
        if loss == "error":
            target.unlink()
            return subprocess.CompletedProcess(
                command, 1, "", f"Error: Could not build output file '{target}' (No space left)"
            )
        target.write_bytes(target.read_bytes()[: len(target.read_bytes()) // 2 if loss == "half" else 0])
        return done

    monkeypatch.setattr(subprocess, "run", full)
    with pytest.raises(EnvironmentFault, match="netconvert"):
        copied_network(open_network("lead_vehicle_stopped"), n)
    monkeypatch.setattr(subprocess, "run", ran)
    ElementTree.parse(copied_network(open_network("lead_vehicle_stopped"), n).network)


def test_sources_that_netconvert_refuses_are_an_error(tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    shutil.copytree(NETWORKS / "lead_vehicle_stopped", mine)
    (mine / "network.edg.xml").write_text('<edges><edge id="road" from="west" to="nowhere"/></edges>')
    with pytest.raises(
        InputError, match="netconvert refuses the network: Edge's 'road' to-node 'nowhere' is not known"
    ):
        copied_network(open_network(str(mine)), 1)
    (mine / "network.edg.xml").write_text("<edges>")
    with pytest.raises(InputError, match="tags were ended"):
        copied_network(open_network(str(mine)), 1)


CAR = '<vType id="car" speedDev="0" sigma="0"/><vType id="walker" vClass="pedestrian" speedDev="0"/>'


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    shutil.copytree(NETWORKS / "pedestrian_crossing", tmp_path / "mine")
    return tmp_path / "mine"


def with_traffic(mine: Path, more: str) -> str:
    file = mine / "traffic.rou.xml"
    file.write_text(file.read_text().replace("</routes>", f"{CAR}{more}</routes>"))
    return str(mine)


GOOD = {
    "a flow": '<flow id="f" type="car" from="oncoming" to="oncoming_on" begin="0" end="9" period="3"/>',
    "a flow on a route": '<route id="r" edges="oncoming"/>'
    '<flow id="f" type="car" route="r" begin="0" end="9" number="2"/>',
    "a trip": '<trip id="t" type="car" depart="0" from="oncoming" to="oncoming_on"/>',
    "a trip by a via": '<trip id="t" type="car" depart="0" from="oncoming" via="oncoming" to="oncoming_on"/>',
    "a late vehicle": (
        '<vehicle id="t" type="car" depart="0:0:2"><route edges="oncoming"/><stop edge="oncoming" '
        'duration="1"/></vehicle>'
    ),
    "a person's trip": '<person id="w" type="walker" depart="0">'
    '<personTrip from="footpath" to="footpath_on"/></person>',
    "a flow of persons": (
        '<personFlow id="w" type="walker" begin="0" end="4" period="2"><walk from="footpath" '
        'to="footpath_on"/></personFlow>'
    ),
    "stop and walk": (
        '<person id="w" type="walker" depart="0"><stop lane="footpath_0" duration="2"/><walk '
        'edges="footpath"/></person>'
    ),
    "parameters": (
        '<vehicle id="v" type="car" depart="0"><route edges="oncoming"/><param key="note" value="approach"/></vehicle>'
    ),
}


@pytest.mark.parametrize("what", sorted(GOOD))
def test_legal_traffic_moves_equally_in_every_copy(mine: Path, what: str) -> None:
    network = with_traffic(mine, GOOD[what])
    check_network(network, "study")
    with open_world(copied_network(open_network(network), 2), 2) as world:
        world.depart()
        seen: set[str] = set()
        for _ in range(60):
            world.api.simulationStep()
            there = world.actor_poses()
            first, second = (
                {name[2:]: place for name, place in there.items() if name.startswith(copy)} for copy in ("0.", "1.")
            )
            assert first == second
            seen |= set(first)
        assert seen > {"vut", "pedestrian"}


BAD = {
    "random kinds": (
        '<vTypeDistribution id="d"><vType id="x"/></vTypeDistribution>',
        "has a 'vTypeDistribution', which",
    ),
    "a random flow": (
        '<flow id="f" type="car" from="oncoming" begin="0" end="9" probability="0.5"/>',
        "'f.0' moves at random",
    ),
    "a Poisson flow": (
        '<flow id="f" type="car" from="oncoming" begin="0" end="9" period="exp(0.5)"/>',
        "'f.0' moves at random",
    ),
    "a random place": (
        '<trip id="t" type="car" from="oncoming" depart="0" departPos="random"/>',
        "'t' moves at random",
    ),
    "SUMO's default type": ('<trip id="t" from="oncoming" depart="0"/>', "'t' moves at random"),
    "random speeds": (
        '<vType id="r" sigma="0"/><trip id="t" type="r" from="oncoming" depart="0"/>',
        "vType 'r' drives at random: speedDev = 0.1",
    ),
    "random driving": (
        '<vType id="r" speedDev="0"/><trip id="t" type="r" from="oncoming" depart="0"/>',
        "drives at random: sigma = 0.5",
    ),
    "a random model": (
        '<vType id="r" speedDev="0" carFollowModel="EIDM"/><trip id="t" type="r" from="oncoming" depart="0"/>',
        "carFollowModel = EIDM",
    ),
    "no such edge": ('<trip id="t" type="car" from="nowhere" depart="0"/>', "The edge 'nowhere' within the route"),
    "an id twice": ('<trip id="vut" type="car" from="oncoming" depart="0"/>', "A vehicle with id 'vut' already exists"),
    "the tested type for others": ('<trip id="t" type="vut" from="oncoming" depart="0"/>', "'vut', a vType of its own"),
    "an impossible length": ('<vType id="x" length="-1"/>', "length must be greater than 0"),
    "a ride": (
        '<person id="w" type="walker" depart="0"><ride from="approach" to="departure" lines="vut"/></person>',
        "has a 'ride'",
    ),
}


@pytest.mark.parametrize("what", sorted(BAD))
def test_illegal_traffic_is_refused_with_its_name(mine: Path, what: str) -> None:
    more, message = BAD[what]
    with pytest.raises(InputError, match=r"mine(/traffic\.rou\.xml)?: ") as caught:
        check_network(with_traffic(mine, more), "study")
    assert message in str(caught.value)


def test_a_configuration_that_waits_for_a_client_is_refused(mine: Path) -> None:
    file = mine / "scenario.sumocfg"
    port = '<traci_server><remote-port value="8813"/></traci_server>'
    file.write_text(file.read_text().replace("</configuration>", f"{port}</configuration>"))
    with pytest.raises(InputError, match=r"scenario\.sumocfg: remote-port = '8813'"):
        check_network(str(mine), "study")


def test_persons_who_dawdle_are_refused(mine: Path) -> None:
    file = mine / "scenario.sumocfg"
    file.write_text(file.read_text().replace('dawdling value="0"', 'dawdling value="0.2"'))
    with pytest.raises(
        InputError, match=r"traffic\.rou\.xml: 'pedestrian' moves at random: two copies of it differ at \d"
    ):
        check_network(str(mine), "study")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<vehicle id="vut"', '<vehicle id="ego"', "has no vehicle 'vut'"),
        ('id="vut" type="vut" depart="0"', 'id="vut" type="vut" depart="3"', "depart = '3'"),
        ('id="vut" type="vut" depart', 'id="vut" type="pedestrian" depart', "type = 'pedestrian'"),
        (
            '<route edges="approach departure"/>',
            '<route edges="approach departure"/><stop lane="departure_0" duration="9"/>',
            "has a stop",
        ),
    ],
)
def test_the_vehicle_under_test_must_depart_at_time_0(mine: Path, old: str, new: str, message: str) -> None:
    file = mine / "traffic.rou.xml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(InputError) as caught:
        check_network(str(mine), "study")
    assert message in str(caught.value)
