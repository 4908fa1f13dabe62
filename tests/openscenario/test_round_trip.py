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
CCRB = {"test": "CCRb", "speed": 50}
CPNA = {"test": "CPNA", "speed": 40}
COLLISION = Outcome.COLLISION


def runs_of(study: Study, wear: Mapping[str, float]) -> tuple[SimulationRuns, Any, np.ndarray]:
    system = assemble(study)
    setting = system.characteristics.original.copy()
    for name, value in wear.items():
        setting[[*system.characteristics.names].index(name)] = value
    (result,) = simulate_all_points(system, setting[np.newaxis])
    return result.runs, system, setting


@pytest.mark.parametrize(
    ("scenario", "wear", "outcome"),
    [
        pytest.param(
            {"file": str(FILES / "crossing_pedestrian.xosc")},
            WEAR,
            COLLISION,
            marks=pytest.mark.slow,
        ),
        (
            {"file": str(FILES / "cut_in.xosc"), "values": {"gap_m": 6, "slower_kmh": 30}},
            WEAR,
            COLLISION,
        ),
        pytest.param(
            {"file": str(FILES / "braking_leader.xosc")}, WEAR, COLLISION, marks=pytest.mark.slow
        ),
        ({"model": "car_to_car", "parameters": CCRB}, WEAR, COLLISION),
        pytest.param(
            {"model": "crossing", "parameters": CPNA}, WEAR, COLLISION, marks=pytest.mark.slow
        ),
        ({"file": str(FILES / "cut_in.xosc")}, {}, Outcome.PASSED),
        pytest.param(
            {"file": str(FILES / "crossing_pedestrian.xosc")},
            {},
            Outcome.STOPPED,
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"file": str(FILES / "braking_leader.xosc")},
            {},
            Outcome.STOPPED,
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"model": "car_to_car", "parameters": CCRB}, {}, Outcome.PASSED, marks=pytest.mark.slow
        ),
        pytest.param(
            {"model": "crossing", "parameters": CPNA}, {}, Outcome.STOPPED, marks=pytest.mark.slow
        ),
    ],
)
def test_an_exported_run_is_the_same_from_its_file(
    tmp_path: Path, scenario: dict[str, Any], wear: Mapping[str, float], outcome: Outcome
) -> None:
    study = load_study("wear", scenario=scenario, matrix={"tests": []})
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
    for name in ("position", "gap", "lateral"):
        first, second = (getattr(one.trace, name)[:n, 0] for one in (runs, again))
        assert (
            np.abs(first - second - (first[0] - second[0]) * (name == "position")).max() < 1e-3
        ), name
    for name in ("collision_speed", "closing_speed"):
        before = getattr(runs, name)
        assert getattr(again, name) == pytest.approx(before, abs=1e-3, nan_ok=True), name
