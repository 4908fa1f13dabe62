"""What docs/trust.md says of the shipped studies, on numbers that anyone may have: so that the page cannot rot."""

from __future__ import annotations

import numpy as np
import pytest

from safevar_sumo.reference.agreement import rank_correlation
from safevar_sumo.study import load_study
from safevar_sumo.sumo.batch import score
from safevar_sumo.sumo.kinematic import simulate_alone
from safevar_sumo.sumo.system import assemble

PUBLISHED_EFFECTS = {"tireFric": 1.2, "mass": -0.8, "maxBrakeTorque": 0.6, "dampRateZeroT_CE": 0.4, "radius": 0.4, "max_rpm": 0.2,
                     "dampRateZeroT_CD": 0.2}
"""Linear effect on the safety degree over a whole domain in the published random search in sun [m]."""
NEAR = 0.05


@pytest.mark.parametrize(("study", "within"), [
    ("sun", {"safety_degree": 0.05, "tet": 0.05, "tit": 0.05, "ave_dece": 0.05}),
    ("lgsvl", {"safety_degree": 0.05, "tet": 0.05, "tit": 0.05, "ave_dece": 0.05}),
    ("rain", {"safety_degree": 0.40 / 2.2, "tet": 0.05, "tit": 0.15, "ave_dece": 0.05}),
])
def test_the_original_vehicle_is_as_near_to_the_published_one_as_is_said(study: str, within: dict[str, float]) -> None:
    """Rain's published vehicle is one simulation, 0.3 to 0.4 m above its own neighbours."""
    read = load_study(study)
    system = assemble(read)
    settings = system.characteristics.original[np.newaxis]
    here = score(system, settings, simulate_alone(system, settings)).metrics
    for name, share in within.items():
        assert here[name][0] == pytest.approx(read.published[name], rel=share), name


@pytest.mark.parametrize(("study", "expected"), [("sun", 0.60), ("rain", 0.59)])
def test_vehicles_come_in_the_order_of_the_published_effects(study: str, expected: float) -> None:
    """Spearman's rho over 150 vehicles with the published linear effects, which know nothing of what saturates or comes together."""
    system = assemble(load_study(study))
    characteristics = system.characteristics
    width = characteristics.upper - characteristics.lower
    settings = np.random.default_rng(14).uniform(characteristics.lower, characteristics.upper, (150, len(width)))
    effects = np.array([PUBLISHED_EFFECTS.get(name, 0.0) for name in characteristics.names])
    here = score(system, settings, simulate_alone(system, settings)).f_safe
    assert rank_correlation(((settings - characteristics.original) / width) @ effects, here) == pytest.approx(expected, abs=NEAR)
