"""The search of `permit`: from a plan to everything that its answer tells."""

from __future__ import annotations

import numpy as np

from safevar_sumo.campaign.inputs import manifest_now
from safevar_sumo.errors import InputError
from safevar_sumo.questions.between import remark_on_phases
from safevar_sumo.questions.part import UpperEnd, scope_of, study_up_to
from safevar_sumo.questions.permit.examples import examples_of, with_examples
from safevar_sumo.questions.permit.found import (
    Found,
    FoundCar,
    Permit,
    Repaired,
    WorstEnd,
)
from safevar_sumo.questions.permit.plan import Plan
from safevar_sumo.questions.permit.speed_search import Cars
from safevar_sumo.records import BoolArray
from safevar_sumo.results import identity_digest
from safevar_sumo.sumo.system import assemble

STUDY_DIGEST_LENGTH = 12
"""Number of characters of the digest of a study in the list of cars."""


def search(plan: Plan) -> Found:
    """Search how far each car is safe, the part to renew first, and the assumed value that matters
    most.

    Raises
    ------
    InputError
        If the new car is not safe at the least value.
    """
    speeds = plan.speeds
    study = plan.evaluator.study
    fleet = plan.fleet
    vehicle = plan.evaluator.characteristics.vehicle
    worn = fleet.measured & (fleet.settings != vehicle.original)
    budget = plan.evaluator.budget
    _begin(plan, worn)
    # The new car has a floor: only its least speed over all sets is of interest.
    floors = [-np.inf, *[None] * len(plan.cars)]
    new_car, *permits = speeds.reach([_new_car(plan), *plan.cars], floors)
    _check_new_car(plan, new_car)
    repaired: list[Repaired | None] = [None] * len(permits)
    # If the number of simulations is limited, too few are left to search for repairs.
    if plan.with_repairs and not budget.is_few:
        repaired = speeds.repair_first(plan.cars, worn, permits)
    # The search for the worst assumed values needs further simulations. It is left out if the
    # number of simulations is limited, or if the user states a number, even one that suffices.
    has_worst_ends = not (plan.is_box or budget.stated is not None or budget.is_few)
    worst_ends: list[WorstEnd | None] = [None] * len(permits)
    if has_worst_ends:
        of_cars = zip(plan.cars, fleet.measured, permits, strict=True)
        worst_ends = [speeds.worst_end(*of_car) for of_car in of_cars]

    told = with_examples(speeds.bench, permits, with_car=plan.is_box)
    cars = [
        FoundCar(*of_car)
        for of_car in zip(fleet.names, told, repaired, worst_ends, strict=True)
    ]
    span = speeds.span
    claim = study
    if span.ending:
        claim = study_up_to(claim, UpperEnd(span.name, span.high))
    manifest = manifest_now(study, assemble(study))
    return Found(
        study=study,
        scope=scope_of(claim),
        digest=identity_digest(manifest)[:STUDY_DIGEST_LENGTH],
        span=span,
        need=plan.need,
        step=plan.step,
        vehicle=vehicle,
        unsafe=plan.unsafe,
        sets=len(speeds.sets),
        values=speeds.values,
        is_listed=len(speeds.values) == len(speeds.listed),
        attacked=speeds.attacked,
        fleet=fleet,
        new_car=new_car.order,
        cars=cars,
        phases=remark_on_phases(speeds.bench.own.in_phases),
        is_quick=plan.is_quick,
        is_rough=budget.is_rough,
        is_box=plan.is_box,
        has_worst_ends=has_worst_ends,
    )


def _new_car(plan: Plan) -> Cars:
    """The new car, of which each value is known."""
    original = plan.evaluator.characteristics.vehicle.original
    return Cars(original, original, original[np.newaxis])


def _begin(plan: Plan, worn: BoolArray) -> None:
    """Say how many simulations are expected. `worn` are the characteristics that may be repaired,
    shape (K, n).
    """
    speeds = plan.speeds
    evaluator = plan.evaluator
    cars = [_new_car(plan), *plan.cars]
    stages = speeds.stages(cars, with_repairs=plan.with_repairs)
    # All encounters count: the price has no simulation of the original in each car's encounters.
    without_originals = evaluator.for_study(evaluator.study.all_count)
    without_originals.begin(stages, speeds.least, of_list=len(plan.cars) > 1)
    if not evaluator.budget.is_few:
        repairable = worn & plan.with_repairs
        most = speeds.most(cars, repairable, ~plan.fleet.measured)
        evaluator.phases.plan_most(most, len(evaluator.system.points))


def _check_new_car(plan: Plan, new_car: Permit) -> None:
    """Refuse a study in which the new car is not safe at the least value."""
    failure = new_car.least.failure
    if new_car.safe_value is not None or failure is None:
        return
    speeds = plan.speeds
    (example,) = examples_of(speeds.bench, [failure])
    least = speeds.span.text(speeds.values[0])
    raise InputError(
        plan.evaluator.study.source,
        f"the new car is not safe at {least}: {example.because}",
        "a study in which it is, or another --unsafe",
    )
