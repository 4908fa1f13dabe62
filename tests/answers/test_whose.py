"""Whose failure: the driving system's, if a competent driver avoids it in the same vehicle; the vehicle's, if nobody does."""

from __future__ import annotations

import msgspec
import numpy as np

from safevar_sumo.answers import Whose, whose_failures
from safevar_sumo.answers.whose import summary
from safevar_sumo.records import Outcome
from safevar_sumo.simulation import assemble, evaluate
from safevar_sumo.study import ModelTable, load_study

BASE = msgspec.structs.replace(load_study("euro_ncap_pedestrian"), matrix=None)
BLIND = ModelTable(model="aeb", parameters={"reach": 3.0})


def at(ads: ModelTable, **parameters: object) -> list[Whose]:
    """What is told of the vehicle with a tenth of its brakes and with all of them, where the driving system fails with both."""
    study = msgspec.structs.replace(BASE, ads=ads, scenario=ModelTable(model="crossing", parameters=parameters))
    system = assemble(study)
    weak = system.characteristics.original.copy()
    weak[system.characteristics.names.index("maxBrakeTorque")] /= 10
    weak[system.characteristics.names.index("dampRateZeroT_CE")] /= 10
    both = np.stack([system.characteristics.original, weak])
    assert (evaluate(system, both).outcome == Outcome.COLLISION).all()
    assert summary(study, both).startswith("Whose failure (2 collisions")
    return whose_failures(study, both)


def test_a_short_sighted_system_fails_where_a_competent_driver_does_not_and_no_one_stops_without_brakes() -> None:
    assert at(BLIND, test="CPFA", speed=40) == [Whose.COMPETENT, Whose.NOBODY]


def test_a_child_that_comes_out_late_is_avoided_by_full_braking_alone() -> None:
    assert at(BLIND, test="CPNCO", speed=40)[0] == Whose.BRAKING
