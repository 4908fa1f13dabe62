"""The plan of `permit`: which cars are asked about, and at which speeds they drive."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.output import check_writable
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.permit.encounters import Span
from safevar_sumo.questions.permit.fleet import Fleet
from safevar_sumo.questions.permit.permits import PermitSearch
from safevar_sumo.questions.permit.speed_search import Cars
from safevar_sumo.questions.words import join_phrases
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Limit, Study
from safevar_sumo.vehicles import CharacteristicSet

MOST_VALUES = 10_000
"""Largest number of values of a grid."""
NEED = re.compile(r"\s*([-+]?\d+(?:\.\d+)?)\s*(\S.*?)?\s*")
"""The form of the option `need`: a number and its unit, such as "50 km/h"."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is asked about cars.

    Attributes
    ----------
    evaluator
        Simulates the study.
    speeds
        The search for the speed of each car, with the parameter, its grid and the parameter sets.
    unsafe
        The criterion of an unsafe vehicle.
    fleet, cars
        The list of cars, and the vehicles that each of them may be, in the order of the list.
    need
        The speed that every car must reach; None without one.
    step
        The step of the grid of speeds.
    is_quick
        Whether cars are driven only at the grid's speeds, without a search for counterexamples.
    is_box
        Whether the only "car" stands for all cars within the limits that the user states.
    """

    evaluator: Evaluator
    speeds: PermitSearch
    unsafe: Unsafe
    fleet: Fleet
    cars: Sequence[Cars]
    need: float | None
    step: float
    is_quick: bool
    is_box: bool

    @property
    def with_repairs(self) -> bool:
        """Whether the best repair of each car is searched."""
        return not (self.is_quick or self.is_box)


def check_forms(
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
    is_given = {"--cars": cars is not None, "--set": values, "--limits": limits}
    forms = [option for option, given in is_given.items() if given]
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


def demand_of(text: str | None, span: Span) -> float | None:
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


def check_driven(demand: float | None, search: PermitSearch) -> None:
    """Refuse a demanded speed at which no car is driven, because a test lists its speeds."""
    if demand is not None and len(search.listed) and demand not in search.listed:
        raise InputError(
            "need",
            f"{demand:g}",
            f"a value that is driven: {join_phrases(f'{value:g}' for value in search.listed)}",
        )


def grid_of(span: Span, step: float) -> FloatArray:
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


def cars_within(
    members: CharacteristicSet,
    limits: Mapping[str, Limit],
    study: Study,
    setting: FloatArray,
) -> Cars:
    """All cars within the limits. A characteristic without a limit has its value in `setting`,
    shape (n,).
    """
    lower = setting.copy()
    upper = setting.copy()
    for name, limit in limits.items():
        column = members.names.index(name)
        domain = study.vehicle.characteristics[name]
        lower[column], upper[column] = limit.interval(domain)
    return Cars.within(lower, upper, study.search.seed)
