"""The limits sheet: rounding, and what fails first in words."""

from __future__ import annotations

import numpy as np
import pytest

from safevar_sumo.analysis.tolerance.sheet import describe_failure, safe_text
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Evaluations
from safevar_sumo.study import load_study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet


def test_limits_are_rounded_to_the_safe_side() -> None:
    one = CharacteristicSet.of(load_study("wear")).members[0]
    assert safe_text(one, 2.3178, upwards=True) == "2.32"
    assert safe_text(one, 2.3278, upwards=False) == "2.32"
    assert safe_text(one, 7.999, upwards=True) == "8.00"


@pytest.mark.parametrize(("speed", "words"), [(0.01, ""), (2.5, " with 9 km/h")])
def test_an_impact_at_the_limit_itself_has_no_speed(speed: float, words: str) -> None:
    system, one = assemble(load_study("sun")), np.ones(1)
    collision = Evaluations(
        settings=system.characteristics.original[np.newaxis],
        outcome=np.array(["collision"]),
        collision_speed=speed * one,
        metrics={"safety_degree": -speed * one},
        f_diff=one,
        f_num_diff=one.astype(int),
    )
    failure = describe_failure(collision, system.points, Unsafe())
    assert failure["description"] == f"the car hits {system.points[0].scenario.obstacle()}{words}"
