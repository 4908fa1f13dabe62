"""Copies of a network: as many as asked for, all alike, none connected with another."""

from __future__ import annotations

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
from safevar_sumo.sumo import network
from safevar_sumo.sumo.network import copied_network

FOLDERS = sorted(path.name for path in NETWORKS.iterdir() if path.is_dir())
BINARIES = Path(sumo.SUMO_HOME) / "bin"


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_recipe_builds_the_network_that_is_kept(folder: str, tmp_path: Path) -> None:
    shutil.copytree(NETWORKS / folder, tmp_path / folder)
    subprocess.run([str(BINARIES / "netconvert"), "-c", "network.netccfg"], cwd=tmp_path / folder, check=True, capture_output=True)

    def without_head(path: Path) -> list[str]:
        lines = path.read_text().splitlines()
        return lines[next(i for i, line in enumerate(lines) if line.startswith("<net ")):]

    assert without_head(tmp_path / folder / "network.net.xml") == without_head(NETWORKS / folder / "network.net.xml")


def test_copies_share_coordinates_and_nothing_else() -> None:
    text = copied_network("pedestrian_crossing", 2).network.read_text()
    shapes = {copy: [line.split('shape="')[1].split('"')[0] for line in text.splitlines() if f'lane id="{copy}.approach_0"' in line]
              for copy in (0, 1)}
    assert shapes[0] == shapes[1] != []
    connections = [dict(re.findall(r'(from|to)=":?(\d+)\.', line)) for line in text.splitlines() if "<connection " in line]
    assert {one["from"] for one in connections} == {"0", "1"}
    assert all(one["from"] == one["to"] for one in connections)


def test_a_network_is_built_once() -> None:
    first = copied_network("lead_vehicle_stopped", 3)
    written = first.network.stat().st_mtime_ns
    assert copied_network("lead_vehicle_stopped", 3) == first
    assert first.network.stat().st_mtime_ns == written


@pytest.mark.parametrize("spoil", [
    lambda path: path.write_text(path.read_text().replace('id="0', 'id="00')), lambda path: path.write_text("<net><edge id='x'/></net>"),
    lambda path: path.write_bytes(path.read_bytes()[:-500]), lambda path: path.write_bytes(b""), Path.unlink])
@pytest.mark.parametrize("which", ["network", "traffic"])
def test_a_cached_file_that_is_not_what_was_built_is_built_again(spoil: Callable[[Path], None], which: str) -> None:
    file: Path = getattr(copied_network("lead_vehicle_stopped", 2), which)
    built = file.read_bytes()
    spoil(file)
    assert getattr(copied_network("lead_vehicle_stopped", 2), which) == file
    assert file.read_bytes() == built
    kept = {path.name for path in file.parent.iterdir()} - {"nobody.rou.xml", "nobody.rou.xml.sha256"}  # the same without its actors
    assert kept == {file.name, f"{file.name}.sha256"}


@pytest.mark.parametrize(("loss", "n"), [("half", 12), ("nothing", 25), ("error", 60)])
def test_a_disk_that_is_full_while_a_network_is_built_leaves_nothing_behind(loss: str, n: int, tmp_path: Path,
                                                                              monkeypatch: pytest.MonkeyPatch) -> None:
    """In a cache of its own: other tests may have built as many copies already."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    ran = subprocess.run

    def full(command: list[str], **options: Any) -> Any:
        done = ran(command, **options)
        made = Path(command[command.index("-o") + 1])
        if loss == "error":
            made.unlink()
            return subprocess.CompletedProcess(command, 1, "", f"Error: Could not build output file '{made}' (No space left)")
        made.write_bytes(made.read_bytes()[:len(made.read_bytes()) // 2 if loss == "half" else 0])
        return done

    monkeypatch.setattr(subprocess, "run", full)
    with pytest.raises(EnvironmentFault, match="netconvert"):
        copied_network("lead_vehicle_stopped", n)
    monkeypatch.setattr(subprocess, "run", ran)
    ElementTree.parse(copied_network("lead_vehicle_stopped", n).network)


def test_another_recipe_or_builder_is_another_network(monkeypatch: pytest.MonkeyPatch) -> None:
    before = copied_network("lead_vehicle_stopped", 1).network
    monkeypatch.setattr(network, "RECIPE", ("--xml-validation", "never", "--junctions.corner-detail", "3"))
    network._digest.cache_clear()
    assert copied_network("lead_vehicle_stopped", 1).network != before
    monkeypatch.setattr(network, "netconvert_version", lambda: "1.99.0")
    network._digest.cache_clear()
    assert "lead" in str(copied_network("lead_vehicle_stopped", 1).network)
    monkeypatch.undo()
    network._digest.cache_clear()


def test_a_cache_that_cannot_be_written_is_the_surroundings_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("platformdirs.user_cache_path", lambda name: tmp_path / "file")
    with pytest.raises(EnvironmentFault, match="cannot write the cache of networks"):
        copied_network("lead_vehicle_stopped", 1)


def test_a_users_folder_serves_as_well_and_its_content_counts(tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    shutil.copytree(NETWORKS / "lead_vehicle_stopped", mine)
    before = copied_network(str(mine), 1).traffic
    traffic = mine / "traffic.rou.xml"
    traffic.write_text(traffic.read_text().replace('departPos="85"', 'departPos="90"').replace('endPos="85"', 'endPos="90"'))
    assert copied_network(str(mine), 1).traffic != before


def test_sources_that_netconvert_refuses_are_an_error(tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    shutil.copytree(NETWORKS / "lead_vehicle_stopped", mine)
    (mine / "network.edg.xml").write_text('<edges><edge id="road" from="west" to="nowhere"/></edges>')
    with pytest.raises(InputError, match="netconvert refuses the network: Edge's 'road' to-node 'nowhere' is not known"):
        copied_network(str(mine), 1)
    (mine / "network.edg.xml").write_text("<edges>")
    with pytest.raises(InputError, match="tags were ended"):
        copied_network(str(mine), 1)
