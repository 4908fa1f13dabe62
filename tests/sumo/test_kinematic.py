"""N vehicles beside one copy of a network, held against N copies in SUMO."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.study import load_study
from safevar_sumo.sumo.batch import score
from safevar_sumo.sumo.kinematic import simulate_alone
from safevar_sumo.sumo.matrix import simulate
from safevar_sumo.sumo.system import System, assemble


def both(system: System, settings: FloatArray) -> tuple[Evaluations, Evaluations]:
    return score(system, settings, simulate(system, settings)), score(system, settings, simulate_alone(system, settings))


@pytest.mark.parametrize("study", ["sun", "rain", "lgsvl"])
def test_vehicles_beside_one_copy_do_what_they_do_in_copies_of_their_own(study: str) -> None:
    system = assemble(load_study(study))
    characteristics, rng = system.characteristics, np.random.default_rng(5)
    settings = rng.uniform(characteristics.lower, characteristics.upper, (150, len(characteristics)))
    copies, alone = both(system, settings)
    assert np.array_equal(copies.outcome, alone.outcome)
    for name, values in copies.metrics.items():
        np.testing.assert_allclose(alone.metrics[name], values, atol=1e-9, err_msg=name)


def test_collisions_are_those_that_sumo_finds() -> None:
    """Brakes that come at every gap: hit by the front, by a corner, by the side, and missed."""
    study = load_study("sun")
    rng = np.random.default_rng(6)
    found = []
    for gap in rng.uniform(3.0, 9.0, 6):
        ads = {**study.ads.parameters, "brake_gap": float(gap), "brake_gap_before": 1.0, "first_command": float(rng.uniform(0, 1.5))}
        system = assemble(msgspec.structs.replace(study, ads=msgspec.structs.replace(study.ads, parameters=ads)))
        characteristics = system.characteristics
        copies, alone = both(system, rng.uniform(characteristics.lower, characteristics.upper, (40, len(characteristics))))
        assert np.array_equal(copies.outcome, alone.outcome)
        np.testing.assert_allclose(alone.collision_speed, copies.collision_speed, atol=1e-9)
        found += copies.outcome.tolist()
    assert 40 < found.count(Outcome.COLLISION) < 220
