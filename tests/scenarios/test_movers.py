"""Who moves vehicles: what all movers state, and a made-up one that simulates many at once."""

from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.errors import UserCodeError
from safevar_sumo.records import FloatArray, SimulationRuns
from safevar_sumo.scenarios import SCENARIO_BASES, SCENARIOS, Simulator
from safevar_sumo.scenarios.mover import OWN_SIMULATOR
from safevar_sumo.sumo.batch import OF_MOVERS
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import System
from tests.made_up import made_up_runs
from tests.scenarios.test_simulated import STUDY, system_of


class Carts(Simulator):
    mover = OWN_SIMULATOR._replace(kind="carts", at_once=64)
    UNITS = {"decel": "m/s^2", "delay": "s"}  # noqa: RUF012
    OPTIONAL = ("delay",)


def brake(system: System, settings: FloatArray) -> SimulationRuns:
    """A cart keeps as many metres as it brakes in m/s^2, and fails above 8.5 m/s^2."""
    decel = settings[:, 0]
    assert len(decel) <= 64
    if max(decel) > 8.5:
        raise UserCodeError("", "too hard")
    return made_up_runs(0.1, np.array([decel, decel]), decel)


def test_each_mover_but_sumo_has_a_function_and_says_how_many_settings_it_takes() -> None:
    movers = [base.mover for base in SCENARIO_BASES]
    assert OF_MOVERS.keys() == {mover.kind for mover in movers if mover.at_once}


def test_a_repeated_setting_among_many_fails_alone(
    in_tmp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SCENARIOS, "carts", Carts)
    monkeypatch.setitem(OF_MOVERS, "carts", brake)
    study = in_tmp / "carts.toml"
    study.write_text(STUDY + 'failed = "skip"')
    system = system_of(study, scenario={"model": "carts", "repeats": 3})
    settings = np.linspace([2, 0], [9, 0], 70)
    np.testing.assert_array_equal(
        drive_and_score(system, settings).f_safe, np.where(settings > 8.5, np.nan, settings)[:, 0]
    )
