"""The question `permit`: may this car drive? The answer states, for each of several measured cars,
the greatest speed up to which the car is safe in every encounter of the study and in every
parameter set. An encounter counts even if the original vehicle is not safe in it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import compress
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from safevar_sumo.errors import InputError, about
from safevar_sumo.metrics import Unsafe
from safevar_sumo.output import check_writable, whole_file
from safevar_sumo.questions import cases
from safevar_sumo.questions.answer import Answer, contents
from safevar_sumo.questions.ask import Criterion, question
from safevar_sumo.questions.case import Subject
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import keeping_distance, models_of
from safevar_sumo.questions.options import (
    CARS_FILE,
    Fits,
    LimitTexts,
    Margin,
    Range,
    ValueTexts,
)
from safevar_sumo.questions.permit.answer import DIGEST, PermitAnswer
from safevar_sumo.questions.permit.encounters import Span, span_of
from safevar_sumo.questions.permit.fleet import Fleet, read_fleet
from safevar_sumo.questions.permit.permits import (
    Permit,
    PermitSearch,
    Repaired,
    cars_of,
)
from safevar_sumo.questions.permit.rows import CARS, SETS, failure_columns
from safevar_sumo.questions.permit.speed_search import Cars
from safevar_sumo.questions.words import join_phrases
from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios.declared import with_ranges
from safevar_sumo.study import Study, limits_of, unit_text
from safevar_sumo.vehicles import CharacteristicSet

MOST_VALUES = 10_000
"""Largest number of values of a grid."""
SEARCH_FACTOR = 2
"""Number of simulations that search for a counterexample to a speed, as a multiple of
`LEAST_SIMULATIONS`.
"""
NEED = re.compile(r"\s*([-+]?\d+(?:\.\d+)?)\s*(\S.*?)?\s*")
"""The form of the option `need`: a number and its unit, such as "50 km/h"."""


@question
@contents(
    "unsafe",
    "margin",
    "scope",
    "cars",
    "drive",
    "limited",
    "stop",
    "fits",
    "attacked",
    "step",
    "need",
    "not_driven_above",
    "rough",
    lead="cars",
    cars=CARS,
    sets=SETS,
)
def permit(
    subject: Subject,
    evaluator: Evaluator,
    *,
    cars: Annotated[Any, CARS_FILE] = None,
    set: ValueTexts = (),
    limits: LimitTexts = (),
    others: Annotated[Literal["new"] | None, "new"] = None,
    ignore: Annotated[tuple[str, ...], "COLUMN"] = (),
    need: Annotated[str | None, '"50 km/h"'] = None,
    by: Annotated[str | None, "NAME"] = None,
    step: Annotated[float, Range(0, 1000, is_open=True)] = 1.0,
    margin: Margin = None,
    unsafe: Criterion = None,
    fits: Fits = None,
    quick: bool = False,
    out: Annotated[str | None, "FILE.csv"] = None,
) -> Answer:
    """Find the highest speed up to which each of several measured cars is safe. You get a speed for
    each car, what happens above this speed, and the part to renew first. The speed is safe in
    every encounter of the study and in every parameter set (calibration) of the vehicle model.

    Example: python -m safevar_sumo permit wear --set treadDepth=3 --set payload=300
    --set brakeTorque=0.9

    Parameters
    ----------
    cars
        List of measured cars. The first column names the car, all others are characteristics.
    set
        Ask about a single car with this measured value; may be repeated. State the value in the
        unit of the study.
    limits
        Ask about all cars within this limit, such as "treadDepth >= 3"; may be repeated.
    others
        Take the value of a new car for each characteristic without a measured or stated value.
        Default: an error.
    ignore
        Ignore this column of the list; may be repeated.
    need
        Speed at which every car must be safe, else exit code 3.
    by
        Find the highest safe value of this speed, such as target_speed. Default: the speed of the
        car.
    step
        Step between two tested speeds. The answer is a multiple of this step.
    margin
        Clearance to keep between bumpers, in metres. Default: the value of the study, else 0.3 m.
    unsafe
        What counts as unsafe: a collision, less than X m of clearance, or a metric beyond a limit.
        Default: a collision or too little clearance.
    fits
        Number of parameter sets (calibrations) of the vehicle model in which a car must be safe.
        Default: all; 0 uses only the set of the study.
    quick
        Give a rough answer that proves nothing, from the tested speeds alone. No car gets the
        verdict "drive".
    out
        Write the list with the highest safe speeds to this file.
    """
    if evaluator.study.states_ranges:
        evaluator = evaluator.for_study(with_ranges(evaluator.study))
    study = evaluator.study
    span = span_of(study, by)
    demand = _demand_of(need, span)
    values = _grid(span, step)
    members = evaluator.characteristics.vehicle
    _check_forms(
        cars,
        set,
        limits,
        out,
        is_quick=quick,
    )
    fleet = read_cars(
        study,
        cars,
        set,
        limits,
        others,
        ignore,
    )
    criterion = keeping_distance(
        evaluator,
        evaluator.checked(unsafe or Unsafe()),
        margin,
        is_stated=unsafe is not None,
    )
    models = models_of(
        evaluator,
        criterion,
        fits,
        with_unsafe_originals=True,
    )
    # With limits, the answer is a claim about all cars within the limits. It is searched as much as
    # joint limits are.
    budget = cases.USUAL_BUDGET if limits else SEARCH_FACTOR * cases.LEAST_SIMULATIONS
    budget = 0 if quick else evaluator.scaled(budget)
    search = PermitSearch(models, span, values, budget)
    _check_driven(demand, search)
    if limits:
        candidates = [_cars_within(members, limits, study, fleet.settings[0])]
    else:
        candidates = cars_of(members, fleet)
    has_repairs = not (quick or limits)
    new_car, permits, repaired = _search_speeds(
        evaluator, search, fleet, candidates, with_repairs=has_repairs
    )
    # The search for the worst assumed values needs further simulations. It is left out if the
    # number of simulations is limited, or if the user states a number, even one that suffices.
    is_stated = evaluator.account.allowance is not None
    worst_ends = None
    if not (limits or is_stated or evaluator.account.is_limited):
        of_cars = zip(candidates, fleet.measured, permits, strict=True)
        worst_ends = [search.worst_end(members, *of_car) for of_car in of_cars]
    answer = PermitAnswer(
        study=study,
        span=span,
        need=demand,
        step=step,
        models=models,
        search=search,
        fleet=fleet,
        new_car=new_car,
        permits=permits,
        repaired=repaired,
        is_quick=quick,
        is_rough=quick or evaluator.account.is_limited,
        is_box=bool(limits),
        worst_ends=worst_ends,
    ).answer()
    if out is not None:
        with whole_file(Path(out), "out") as file:
            file.write_text(answer.render("csv"), encoding="utf-8")
    return answer


def _search_speeds(
    evaluator: Evaluator,
    search: PermitSearch,
    fleet: Fleet,
    candidates: Sequence[Cars],
    *,
    with_repairs: bool,
) -> tuple[Permit, list[Permit], list[Repaired]]:
    """Search how far the new car and each candidate are safe, and the best repair of each
    candidate. A repair is None if none helps, or if repairs were not searched.

    Raises
    ------
    InputError
        If the new car is not safe at the least value.
    """
    members = evaluator.characteristics.vehicle
    cars = [Cars.one(members.original), *candidates]
    phases = search.phases(cars, with_repairs=with_repairs)
    # All encounters count: the price has no simulation of the original in each car's encounters.
    without_originals = evaluator.for_study(evaluator.study.all_count)
    without_originals.begin(phases, search.least, of_list=len(candidates) > 1)
    # The new car has a floor: only its least speed over all sets is of interest.
    floors = [-np.inf, *[None] * len(candidates)]
    new_car, *permits = search.reach(cars, floors)
    if new_car.safe_value is None:
        study = evaluator.study
        words = failure_columns([new_car.least.failure])[0]["because"]
        raise InputError(
            study.source,
            f"the new car is not safe at {search.values[0]:g}"
            f"{unit_text(search.span.unit)}: {words}",
            "a study in which it is, or another --unsafe",
        )
    # If the number of simulations is limited, too few are left to search for repairs.
    if not with_repairs or evaluator.account.is_limited:
        return new_car, permits, [None] * len(permits)
    worn = fleet.measured & (fleet.settings != members.original)
    repaired = search.repair_first(candidates, worn, members.original, permits)
    return new_car, permits, repaired


def read_cars(
    study: Study,
    cars: Any,
    values: Sequence[str],
    limits: Sequence[str],
    others: str | None,
    ignore: Sequence[str],
) -> Fleet:
    """The cars that the user asks about. With `limits`, this is a single car: the limited
    characteristics have the original's values, and all others have the values that the study or
    `others` states.
    """
    members = CharacteristicSet.of(study).vehicle
    if limits:
        rows = study.vehicle.characteristics
        with about("limits"):
            names = limits_of(limits, rows)
        cars = {
            f"All cars with {join_phrases(limits)}": {
                name: rows[name].original for name in names
            }
        }
    return read_fleet(
        study,
        members,
        cars,
        values,
        others=others,
        ignore=ignore,
        answer_columns=[*CARS, DIGEST],
    )


def _check_forms(
    cars: object,
    values: Sequence[str],
    limits: Sequence[str],
    out: str | None,
    *,
    is_quick: bool,
) -> None:
    """Refuse a call that gives cars in several ways, or in none. Also refuse an output file that is
    the list of cars itself, or that would hold a rough answer.
    """
    is_given = (cars is not None, values, limits)
    forms = list(compress(("--cars", "--set", "--limits"), is_given))
    if len(forms) != 1:
        raise InputError(
            "permit",
            f"{join_phrases(forms or ['no car'])} given",
            "--cars, --set or --limits",
        )
    if out is None:
        return
    if is_quick:
        raise InputError(
            "quick",
            f"a rough answer is not written to {out}",
            "--quick without --out, or --out without --quick",
        )
    path = Path(out)
    if isinstance(cars, str | Path) and path.exists() and path.samefile(cars):
        raise InputError("out", f"{out} is the list itself", "another file")
    check_writable(path, "out", (".csv",))


def _demand_of(text: str | None, span: Span) -> float | None:
    """The speed that the option `need` states, such as "40 km/h"; None if `text` is None. The unit
    must be that of the study, and the speed must be within the range that is driven.
    """
    if text is None:
        return None
    match = NEED.fullmatch(text)
    if (
        match is None
        or (match[2] or "") != span.unit
        or not span.low <= float(match[1]) <= span.high
    ):
        example = f"{span.high:g} {span.unit}".strip()
        raise InputError(
            "need",
            repr(text),
            f'from {span.low:g} to {span.high:g} with the unit, such as "{example}"',
        )
    return float(match[1])


def _check_driven(demand: float | None, search: PermitSearch) -> None:
    """Refuse a demanded speed at which no car is driven, because a test lists its speeds."""
    if demand is not None and len(search.listed) and demand not in search.listed:
        raise InputError(
            "need",
            f"{demand:g}",
            f"a value that is driven: {join_phrases(f'{value:g}' for value in search.listed)}",
        )


def _grid(span: Span, step: float) -> FloatArray:
    """The grid of speeds, in ascending order: the ends of the range, and all multiples of `step`
    between them.
    """
    low = span.low
    high = span.high
    if (high - low) / step > MOST_VALUES:
        raise InputError(
            "step",
            f"{step:g}",
            f"at most {MOST_VALUES:,} steps from {low:g} to {high:g}",
        )
    # The first multiple may lie below the range: it is clipped. Digits beyond the ninth decimal are
    # errors of rounding.
    numbers = np.arange(low // step, high / step)
    multiples = np.round(step * numbers, 9)
    values = [low, *multiples, high]
    return np.unique(np.clip(values, low, high))


def _cars_within(
    members: CharacteristicSet, limits: Sequence[str], study: Study, setting: FloatArray
) -> Cars:
    """All cars within the limits. A characteristic without a limit has its value in `setting`,
    shape (n,).
    """
    lower = setting.copy()
    upper = setting.copy()
    domains = study.vehicle.characteristics
    for name, limit in limits_of(limits, domains).items():
        column = members.names.index(name)
        lower[column], upper[column] = limit.interval(domains[name])
    return Cars.within(lower, upper, study.search.seed)
