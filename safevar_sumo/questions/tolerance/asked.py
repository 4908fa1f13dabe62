"""What is asked about limits: which characteristics vary, in which worlds, and how much is
searched.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError, about, check_name
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.box import MAX_CORNERS
from safevar_sumo.questions.cases import (
    CaseSearch,
    Counterexamples,
    SearchPlan,
    Space,
    search_cases,
)
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import Model, Models
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.tolerance.boxes import BoxEffort, Boxes
from safevar_sumo.questions.tolerance.oracle import Oracle
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Limit, Study, limits_of

MAX_UNSAFE_SHARE = 0.003
"""Upper bound of a box's unsafe share, with 95 % confidence, if every sampled vehicle is safe."""
CASES_ALONE = 5_000
CASES = 80_000
CASES_OF_SET = 4_000
"""Usual numbers of cases: for each limit alone, for the joint limits with the study's own parameter
set, and with each other one.
"""
LEAST_VALUES = 8
"""Least number of values between the original and each end with which a limit alone is stated."""
FEW_ALONE = 0.15
FEW_OWN = 0.1
"""Shares of few simulations that seek limits alone, and that search the box that is printed."""
FEW_PARTS = 4, 4
"""Into how many parts the way to something unsafe is divided with few simulations."""
FEW_GENERATION = 24
"""Cases of a generation of such a search."""
FEW_FARTHEST = 0.8
"""How far they keep off at most, as a share of the change that failed."""
LEAST_CASES = 20
"""Fewest cases of each of three searches of joint limits: if all were drawn at random, at most 5 %
of such cases are unsafe, with 95 % confidence.
"""
FEW_RETREAT = 0.5
FURTHER_RETREAT = 200.0
"""How much farther limits keep off failures after each box that failed, in `LEAST_MOVE`; and what
is added, times the number of cases: the fewer they are, the fewer boxes can be searched.
"""


class Effort(NamedTuple):
    """How much is searched.

    Attributes
    ----------
    encounters, values
        Listed encounters in which limits alone are sought, and values between the original and each
        end.
    alone, cases, cases_of_set
        Cases that search for a counterexample to limits alone, and to a box with the study's own
        parameter set, and with another one.
    lines
        Number of lines on which a search seeks encounters that only just count.
    generation, followers
        Cases of a generation of such a search, and generations that follow the first with an unsafe
        case.
    box
        How much boxes are searched.
    corners
        Corners of a box that meet all listed encounters.
    confirmations
        Further searches of the box that is to be printed.
    share
        Upper bound of its unsafe share; nothing is proved from 1 on.
    """

    encounters: float = math.inf
    values: int = 100
    alone: int = 2000
    cases: int = 5000
    cases_of_set: int = 1000
    lines: int = 0
    generation: int = 512
    followers: int = 2
    box: BoxEffort = BoxEffort()
    corners: int = MAX_CORNERS
    confirmations: int = 3
    share: float = MAX_UNSAFE_SHARE


USUAL = Effort()
"""How much is searched by default."""
LINES = 640
"""Number of lines on which a search seeks encounters that only just count, if encounters are
ranges.
"""
EDGE_CORNERS = 16
"""Number of vehicles, at corners of the box, in each such encounter."""


class Asked(NamedTuple):
    """What is asked.

    Attributes
    ----------
    fits
        The numbers of the parameter sets, the study's own first.
    lower, upper
        The domains of the vehicle's values, shape (n,); the original where a value does not vary.
    specification
        The specified limits, shape (2, n); NaN where there are none.
    avoided
        Vehicles that no box may hold, shape (K, n).
    exclusions
        The models in which the original itself is unsafe.
    """

    oracle: Oracle
    fits: tuple[int, ...]
    lower: FloatArray
    upper: FloatArray
    specification: FloatArray
    avoided: FloatArray
    effort: Effort
    seed: int
    exclusions: tuple[Model, ...] = ()

    @property
    def original(self) -> FloatArray:
        """The values of the original vehicle."""
        return self.oracle.vehicle.original

    def sides(self, lower: FloatArray, upper: FloatArray) -> FloatArray:
        """How far values reach below and above the original, shape (2, n)."""
        return np.stack([self.original - lower, upper - self.original])

    @property
    def domain(self) -> FloatArray:
        """The sides of the domains."""
        return self.sides(self.lower, self.upper)

    @property
    def star(self) -> Space:
        """The cases of vehicles that differ from the original in one value."""
        space = self.oracle.space(0, self.lower, self.upper)
        return space._replace(center=self.original)

    @property
    def nothing(self) -> FloatArray:
        """No cases."""
        return self.star.lower[np.newaxis][:0]

    def search(
        self,
        stream: Stream,
        fit: int,
        budget: int | None = None,
        *,
        phases: bool = True,
    ) -> CaseSearch:
        """A search for unsafe cases with a parameter set, by default for a counterexample to a
        box. It begins with vehicles in encounters that only just count.
        """
        if budget is None:
            budget = self.effort.cases_of_set if fit else self.effort.cases
        lines = self.effort.lines
        (search,) = self.searches(stream, fit, [budget], lines, phases=phases)
        return search

    def searches(
        self,
        stream: Stream,
        fit: int,
        budgets: Sequence[int],
        lines: int = 0,
        *,
        phases: bool,
    ) -> list[CaseSearch]:
        """Searches with some numbers of cases, which draw from the same stream in turn."""
        oracle = self.oracle
        rng = stream.generator(self.seed, fit)

        def search(
            plan: SearchPlan, space: Space, start: FloatArray
        ) -> Counterexamples:
            n = space.size
            cases = oracle.space(fit, space.lower[:n], space.upper[:n], phases=phases)
            cases = cases._replace(center=space.center)
            # New lines each time: where there is one sliver, there may be others.
            encounters = oracle.edges(fit, lines, rng).repeat(EDGE_CORNERS, axis=0)
            corners = rng.random((len(encounters), n)) < 0.5
            vehicles = np.where(corners, space.lower[:n], space.upper[:n])
            start = np.concatenate([start, np.hstack([vehicles, encounters])])
            plan = plan._replace(budget=plan.budget + len(encounters))
            # A failure in another parameter set begins the search in its own test.
            start[:, n] = cases.lower[n] + start[:, n] % oracle.fits.count(fit)
            return search_cases(oracle, cases, start, plan, rng)

        effort = self.effort
        return [
            partial(search, SearchPlan(budget, effort.generation, effort.followers))
            for budget in budgets
        ]

    def boxes(self, longest: FloatArray) -> Boxes:
        """Boxes with the specified limits, whose other sides are at most so long."""
        is_specified = ~np.isnan(self.specification)
        lengths = np.abs(self.specification - self.original)
        longest = np.where(is_specified, lengths, longest)

        def printed(sides: FloatArray) -> FloatArray:
            """Sides as they are printed; ends of domains and specified limits stay."""
            rounded = sides.copy()
            for column, item in enumerate(self.oracle.vehicle):
                low = item.rounded(item.original - sides[0, column], upwards=True)
                high = item.rounded(item.original + sides[1, column], upwards=False)
                rounded[:, column] = item.original - low, high - item.original
            return np.where((sides >= self.domain) | is_specified, sides, rounded)

        is_free = (self.domain > 0) & ~is_specified
        space = self.oracle.space(0, self.lower, self.upper)
        effort = self.effort.box
        return Boxes(
            self.oracle, space, self.original, longest, is_free, printed, effort
        )


def asked_of(
    models: Models,
    new_car: Unsafe,
    columns: Sequence[int],
    limits: Mapping[str, Limit],
    *,
    at_tests: bool,
) -> Asked:
    """The limits of some characteristics that are sought in some models; an encounter between the
    values of a test counts unless the original is unsafe by `new_car` in it.
    """
    evaluator = models.own.evaluator
    oracle = Oracle(models.members, new_car, between=not at_tests)
    vehicle = oracle.vehicle
    varies = np.isin(range(len(vehicle)), columns)
    ends = np.stack([vehicle.lower, vehicle.upper])
    lower, upper = np.where(varies, ends, vehicle.original)
    specification = np.full_like(ends, np.nan)
    for name, limit in limits.items():
        specification[:, vehicle.names.index(name)] = limit.at_least, limit.at_most
    return Asked(
        oracle=oracle,
        fits=models.fits,
        lower=lower,
        upper=upper,
        specification=specification,
        avoided=np.zeros((0, len(vehicle))),
        effort=effort_of(evaluator, oracle.available, len(columns)),
        seed=evaluator.seed,
        exclusions=models.exclusions,
    )


def usual_alone(evaluator: Evaluator, columns: int | None = None) -> float:
    """The usual number of settings that seek the limits of so many characteristics alone, by
    default of all.
    """
    number = len(evaluator.characteristics.vehicle) if columns is None else columns
    return evaluator.scaled(CASES_ALONE * number) / cases_of_setting(evaluator)


def cases_of_setting(evaluator: Evaluator) -> int:
    """The number of cases that cost as much as a setting: where encounters are ranges, each case
    drives at all points, too.
    """
    return 1 if evaluator.study.ranges else len(evaluator.system.points)


def effort_of(evaluator: Evaluator, cases: float, varied: int) -> Effort:
    """How much is searched, with at most so many cases."""
    if math.isfinite(cases):
        return _effort_of_few(int(cases), varied)
    names = ("values", "alone", "cases", "cases_of_set", "corners", "confirmations")
    scaled = {name: evaluator.scaled(getattr(USUAL, name)) for name in names}
    scaled["values"] = max(scaled["values"], LEAST_VALUES)
    box = USUAL.box._replace(growths=evaluator.scaled(USUAL.box.growths))
    if evaluator.study.ranges:
        scaled["lines"] = evaluator.scaled(LINES)
        # A small batch costs almost as much as a large one: each box drives at all points.
        box = box._replace(explored=evaluator.scaled(box.explored))
    return USUAL._replace(
        **scaled, share=USUAL.share / evaluator.account.effort, box=box
    )


def _effort_of_few(cases: int, varied: int) -> Effort:
    """How much is searched with few simulations: without other parameter sets, and without limits
    alone that lie beyond what a scan of fewer than `LEAST_VALUES` values shows.
    """
    of_line = int(FEW_ALONE * cases / (2 * max(varied, 1)))
    values = min(max(of_line, 1), LEAST_VALUES)
    box = BoxEffort(
        parts=FEW_PARTS,
        explored=0,
        growths=0,
        learnt=1,
        places=4,
        retreat=FEW_RETREAT + FURTHER_RETREAT / cases,
        farthest=FEW_FARTHEST,
    )
    return Effort(
        encounters=max(of_line // (values + sum(FEW_PARTS)), 1),
        values=values,
        alone=0,
        cases=int(FEW_OWN * cases),
        generation=FEW_GENERATION,
        followers=0,
        box=box,
        corners=1,
        confirmations=2,
        share=1.0,
    )


def columns_of(names: Sequence[str], characteristics: Sequence[str]) -> list[int]:
    """The columns of chosen characteristics, of all without a choice."""
    chosen = [name.strip() for text in characteristics for name in text.split(",")]
    for name in chosen:
        check_name(
            "characteristics", f"there is no characteristic {name!r}", name, names
        )
        if chosen.count(name) > 1:
            raise InputError(
                "characteristics", f"{name} is given twice", "each name once"
            )
    return [column for column, name in enumerate(names) if not chosen or name in chosen]


def specified_limits(
    study: Study, texts: Sequence[str], columns: Sequence[int]
) -> dict[str, Limit]:
    """The limits of the study and of the option for the characteristics that vary."""
    rows = study.vehicle.characteristics
    varied = [list(rows)[column] for column in columns]
    with about("limits"):
        for name in limits_of(texts, rows):
            check_name(
                "", f"{name} does not vary with these --characteristics", name, varied
            )
        limits = limits_of(texts, rows, study.limits)
    return {name: limit for name, limit in limits.items() if name in varied}
