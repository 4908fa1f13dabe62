"""The scenarios on roads that lead anywhere: the same outcomes; where the road is not straight, they say so."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import simulate
from safevar_sumo.sumo.system import assemble

TURNS = {"north": (0.0, 1.0), "west": (-1.0, 0.0), "north-west": (-0.6, 0.8)}
"""Where a road that leads east leads then."""


def moved(folder: Path, network: str, forth: tuple[float, float], skew: float = 0.0) -> str:
    """A copy of a network, turned, with its southern end shifted to the right by `skew` [m]."""
    def place(match: re.Match[str]) -> str:
        x, y = float(match[1]), float(match[2])
        x += skew if y < -10 else 0
        return f'x="{x * forth[0] - y * forth[1]}" y="{x * forth[1] + y * forth[0]}"'

    shutil.copytree(NETWORKS / network, folder / "mine")
    nodes = folder / "mine" / "network.nod.xml"
    nodes.write_text(re.sub(r'x="([-\d.]+)" y="([-\d.]+)"', place, nodes.read_text()))
    return str(folder / "mine")


@pytest.mark.parametrize("forth", TURNS.values(), ids=TURNS)
@pytest.mark.parametrize("study", ["rain", "native"])
def test_a_turned_road_changes_nothing(study: str, forth: tuple[float, float], tmp_path: Path) -> None:
    ours = load_study(study)
    mine = load_study(study, scenario={"parameters": {"network": moved(tmp_path, ours.scenario.model, forth)}})
    system = assemble(ours)
    settings = np.vstack([system.characteristics.original, system.characteristics.lower])
    here, there = simulate(system, settings), simulate(assemble(mine), settings)
    assert here.outcome.tolist() == there.outcome.tolist()
    for name in ("gap", "lateral", "speed"):
        assert np.allclose(getattr(here.trace, name), getattr(there.trace, name), atol=0.02), name
    way, same = (run.trace.position[-1] - run.trace.position[0] for run in (here, there))
    assert np.allclose(way, same, atol=0.02), "a position is along the way"


@pytest.mark.parametrize(("study", "network"), [("native", "lead_vehicle_stopped"), ("euro_ncap_car_to_car", "car_to_car")])
def test_a_bent_road_is_refused(study: str, network: str, tmp_path: Path) -> None:
    shutil.copytree(NETWORKS / network, tmp_path / "mine")
    edges = tmp_path / "mine" / "network.edg.xml"
    edges.write_text(edges.read_text().replace("<edge ", '<edge shape="0,0 100,5 200,0" '))
    system = assemble(load_study(study, scenario={"parameters": {"network": str(tmp_path / "mine")}}))
    with pytest.raises(InputError, match=r"lane 'road_0' strays [\d.]+ m from the straight"):
        simulate(system.at(system.points[0]), system.characteristics.original[np.newaxis])


def test_a_skewed_way_across_is_refused(tmp_path: Path) -> None:
    network = moved(tmp_path, "crossing", (1.0, 0.0), skew=4.0)
    system = assemble(load_study("rain", scenario={"model": "crossing", "parameters": {"network": network}}, title="", published={}))
    with pytest.raises(InputError, match=r"lane 'footpath_0' leads [\d.]+ m along the road"):
        simulate(system, system.characteristics.original[np.newaxis])
    crossings = Path(moved(tmp_path / "other", "pedestrian_crossing", (1.0, 0.0)), "network.con.xml")
    crossings.write_text(crossings.read_text().replace("<crossing ", '<crossing shape="0.3,4 6,-4" '))
    system = assemble(load_study("smoke", scenario={"parameters": {"network": str(crossings.parent)}}))
    with pytest.raises(InputError, match=r"lane ':crossing_c0_0' leads [\d.]+ m along the road"):
        simulate(system, system.characteristics.original[np.newaxis])


def test_a_pedestrian_from_the_left_is_refused_where_he_would_turn_at_once(tmp_path: Path) -> None:
    network = Path(moved(tmp_path, "pedestrian_crossing", (1.0, 0.0)))
    traffic = network / "traffic.rou.xml"
    edges = network / "network.edg.xml"
    edges.write_text(edges.read_text().replace('"footpath" from="south" to="crossing"', '"footpath" from="north" to="crossing"')
                     .replace('"footpath_on" from="crossing" to="north"', '"footpath_on" from="crossing" to="south"'))
    traffic.write_text(traffic.read_text().replace('departPos="8.84"', 'departPos="2"'))
    system = assemble(load_study("smoke", scenario={"parameters": {"network": str(network)}}))
    with pytest.raises(InputError, match=r"the pedestrian begins [\d.]+ m to the left"):
        simulate(system, system.characteristics.original[np.newaxis])
