"""A run that was exported as OpenSCENARIO is driven again from its file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safevar_sumo.api.simulation import load_study, simulate_with_original
from safevar_sumo.records import Outcome, SimulationRuns
from safevar_sumo.replay.comparison import comparison_of
from safevar_sumo.replay.export import write_files
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import assemble

FILES = Path(__file__).parent / "files"
WEAR = {"treadDepth": 1.6, "brakeTorque": 0.2}
COLLISION, PASSED, STOPPED = Outcome.COLLISION, Outcome.PASSED, Outcome.STOPPED


def scene_of(file: str, **values: float) -> dict[str, Any]:
    return {"file": str(FILES / file), "values": values}


SCENES: dict[str, dict[str, Any]] = {
    "cut-in": scene_of("cut_in.xosc"),
    "near cut-in": scene_of("cut_in.xosc", gap_m=6, slower_kmh=30),
    "pedestrian": scene_of("crossing_pedestrian.xosc"),
    "leader": scene_of("braking_leader.xosc"),
    "CCRb": {"model": "car_to_car", "parameters": {"test": "CCRb", "speed": 50}},
    "CPNA": {"model": "crossing", "parameters": {"test": "CPNA", "speed": 40}},
}
FAST = [("near cut-in", COLLISION), ("CCRb", COLLISION), ("cut-in", PASSED)]
SLOW = [
    *((name, COLLISION) for name in ("pedestrian", "leader", "CPNA")),
    *((name, STOPPED) for name in ("pedestrian", "leader", "CPNA")),
    ("CCRb", PASSED),
]
"""How runs end: worn vehicles collide, new ones do not."""


def runs_of(study: Study, wear: Mapping[str, float]) -> tuple[SimulationRuns, Any, np.ndarray]:
    system = assemble(study)
    setting = system.characteristics.original.copy()
    for name, value in wear.items():
        setting[[*system.characteristics.names].index(name)] = value
    (result,) = simulate_all_points(system, setting[np.newaxis])
    return result.runs, system, setting


@pytest.mark.parametrize(
    ("name", "outcome"), [*FAST, *(pytest.param(*one, marks=pytest.mark.slow) for one in SLOW)]
)
def test_an_exported_run_is_the_same_from_its_file(
    tmp_path: Path, name: str, outcome: Outcome
) -> None:
    wear = WEAR if outcome == COLLISION else {}
    study = load_study("wear", scenario=SCENES[name], matrix={"tests": []})
    runs, system, setting = runs_of(study, wear)
    write_files(
        comparison_of(simulate_with_original(study, system, setting, filtered=False)),
        "openscenario",
        tmp_path / "out",
        "RS:0:0",
        {},
    )
    (file,) = (tmp_path / "out").glob("*.xosc")
    assert runs.outcome == outcome
    again, *_ = runs_of(load_study("wear", scenario={"file": str(file)}), wear)
    assert again.outcome == runs.outcome
    n = int(np.count_nonzero(runs.trace.active)) + (outcome == COLLISION)
    for column in ("position", "gap", "lateral"):
        first, second = (getattr(one.trace, column)[:n, 0] for one in (runs, again))
        assert (
            np.abs(first - second - (first[0] - second[0]) * (column == "position")).max() < 1e-3
        ), column
    for column in ("collision_speed", "closing_speed"):
        before = getattr(runs, column)
        assert getattr(again, column) == pytest.approx(before, abs=1e-3, nan_ok=True), column
