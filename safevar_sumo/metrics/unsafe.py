"""Criteria by which a vehicle is unsafe: a collision, or a value beyond a limit."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.metrics.base import F_SAFE
from safevar_sumo.metrics.bound import COMPARISONS, MetricBound
from safevar_sumo.metrics.legal import IMPACT_EXCESS, IMPACT_SPEED
from safevar_sumo.metrics.measures import UNSAFE_SHARE
from safevar_sumo.metrics.words import (
    degree_in_words,
    impact_in_words,
    runs_in_words,
    unit_of_degree,
    value_on_side,
)
from safevar_sumo.records import (
    BoolArray,
    Evaluations,
    FloatArray,
    Outcome,
    Quantity,
    TextArray,
    significant,
)
from safevar_sumo.study import SAFETY_DEGREE
from safevar_sumo.study.schema import Tables

if TYPE_CHECKING:
    import pandas as pd

CRITERIA = (
    "collision, below=X with a clearance X [m] of at least 0, or a metric with <, <=, > or >= and a"
    ' number, such as "drac > 6"'
)
COLLISION = str(Outcome.COLLISION)
DEGREE_SHARE = 0.5
"""The default limit if nothing collides, as a share of the original's safety degree."""
CRITERION_DIGITS = 6
"""Number of significant digits of this limit."""
SHARE_DECIMALS = 9
"""Decimals to which a sum of shares is rounded, so that three thirds are 1."""
LEAST = 1e-9
"""Least distance of an unsafe value from the limit, in the limit's unit: without it, a vehicle
exactly at a limit (`>=`) would have the robustness 0, like a safe vehicle.
"""


ColumnOf = Callable[[str], Quantity]
"""A function that returns the values of a metric by its name."""


@dataclass(frozen=True)
class Unsafe:
    """A criterion by which a vehicle is unsafe. Each kind of criterion is a class of its own:

    - without arguments: a collision; with `keep`, also less clearance than `keep` [m];
    - with `below`: a collision, or a clearance below this limit [m];
    - with `degree`: a safety degree below this limit [m, or -m/s];
    - with `bound`: a metric beyond a limit, or a collision.

    `contact` is the safety degree of bodies that touch [m]: 0, or the distance of their middles.

    Examples
    --------
    >>> Unsafe(below=0.3).description
    'collision, or clearance below 0.3 m'
    >>> Unsafe.parse("drac > 6").description
    'drac > 6, or a collision'
    """

    below: float | None = None
    keep: float = 0.0
    contact: float = 0.0
    bound: MetricBound | None = None
    degree: float | None = None
    is_half: bool = field(default=False, compare=False, repr=False)
    """Whether `degree` is half of the original vehicle's, the default if nothing collides."""

    is_collision = True
    """Whether the criterion is a collision alone, or less clearance than `keep`."""
    verbs = "collides", "collide"
    """What an unsafe vehicle does, and what several unsafe vehicles do."""
    event = "a collision"
    effects = "causes a collision", "cause a collision"
    """What a change does that makes the vehicle unsafe, and what several changes do."""
    option = "--margin"
    """The option by which a user states a weaker criterion."""
    is_of_impacts = False
    """Whether the criterion bounds impacts: a slow impact may then be allowed."""

    def __new__(cls, below: float | None = None, **fields: Any) -> Self:
        """Create an object of the class for this kind of criterion."""
        kind: type = cls
        if bound := fields.get("bound"):
            kind = METRIC_KINDS.get(bound.measure, UnsafeMetric)
        elif fields.get("degree") is not None:
            kind = UnsafeDegree
        elif below is not None:
            kind = UnsafeClearance
        return object.__new__(kind)

    def __str__(self) -> str:
        return COLLISION

    @property
    def measure(self) -> str:
        """The name of the column that is compared with the limit: a metric, or the safety
        degree.
        """
        return F_SAFE.name

    @property
    def distance(self) -> float:
        """The clearance between bumpers below which a vehicle is unsafe [m]; 0: only collisions."""
        return self.keep

    @property
    def limit(self) -> float:
        """The limit of the safety degree, or of the bounded metric."""
        return self.contact + self.distance

    @property
    def worst(self) -> Callable[..., float]:
        """The function that returns the worst of values: `min`, or `max` if large ones are
        unsafe.
        """
        return min

    @property
    def description(self) -> str:
        """The criterion in words, rounded: `collision, or clearance below 0.3 m`, `safety degree
        below 1.4 m, half of the original's`, `drac > 6, or a collision`.
        """
        if not self.distance:
            return COLLISION
        clearance = f"collision, or clearance below {self.distance:g} m"
        if self.contact:
            clearance += ", from bumper to bumper"
        return clearance

    @property
    def remark(self) -> str:
        """A sentence about a default limit, which replaces collisions; "" for any other
        criterion.
        """
        return ""

    def smaller_demand(self, original: Evaluations) -> str:
        """What a user does if the original vehicle is unsafe; "" if no weaker criterion would
        help.
        """
        if self.is_collision and (not self.keep or original.collided[0]):
            return ""
        return f"Ask again with a weaker criterion ({self.option})."

    def of(self, evaluations: Evaluations) -> BoolArray:
        """Return which of M evaluations are unsafe in any run, shape (M,). An undefined measure is
        safe; a collision is unsafe for every bound that does not stand alone.
        """
        return np.asarray(self.runs(evaluations).any(axis=0))

    def runs(self, evaluations: Evaluations) -> BoolArray:
        """Return which of the R runs of each of M evaluations are unsafe, shape (R, M). R is 1
        without repeats.
        """
        repeats = self._repeats(evaluations)
        return np.stack(
            [self._holds(repeat.outcome, repeat.column) for repeat in repeats]
        )

    def _repeats(self, evaluations: Evaluations) -> list[Evaluations]:
        return evaluations.repeats or [evaluations]

    def failing_runs(self, evaluations: Evaluations) -> BoolArray:
        """Return which of the R runs of each of M evaluations fail, shape (R, M). A criterion for
        the share of failing runs is none for a run.
        """
        return self.runs(evaluations)

    def number(self, evaluations: Evaluations) -> float:
        """The number of unsafe evaluations. With repeats, an evaluation adds its share of unsafe
        runs.
        """
        total = round(float(self.runs(evaluations).mean(axis=0).sum()), SHARE_DECIMALS)
        if total == int(total):
            return int(total)
        return total

    def rows(self, solutions: pd.DataFrame) -> pd.Series[bool]:
        """Return which rows of a data frame from `safevar_sumo.results.load_runs` are unsafe."""
        holds: pd.Series[bool] = self._holds(
            solutions["outcome"], lambda name: solutions[name]
        )
        return holds

    def _holds(self, outcome: Any, column: ColumnOf) -> Quantity:
        collides = outcome == COLLISION
        if not self.distance:
            return collides
        return collides | (column(F_SAFE.name) < self.limit)

    def robustness(self, evaluations: Evaluations) -> FloatArray:
        """The distance of M evaluations from the limit, in its unit, shape (M,): below 0 if unsafe,
        infinite if undefined. After a collision, a bound that does not stand alone gives minus the
        speed of the collision. With repeats, the worst run counts.
        """
        repeats = self._repeats(evaluations)
        return np.asarray(
            np.min([self._robustness(repeat) for repeat in repeats], axis=0)
        )

    def _robustness(self, evaluations: Evaluations) -> FloatArray:
        """The robustness of evaluations that are not repeated."""
        robustness = self._excess(evaluations)
        robustness = np.where(np.isnan(robustness), np.inf, robustness)
        is_unsafe = self._holds(evaluations.outcome, evaluations.column)
        return np.where(
            is_unsafe, np.minimum(robustness, -LEAST), np.maximum(robustness, 0.0)
        )

    def _excess(self, evaluations: Evaluations) -> FloatArray:
        """The distance of evaluations from the limit, positive on the safe side; NaN if
        undefined.
        """
        return evaluations.f_safe - self.limit

    def value(self, robustness: float) -> float:
        """The limited value: a clearance between bumpers [m], a safety degree or a metric."""
        return self.distance + robustness

    def value_in_words(self, value: float) -> str:
        """What a safe vehicle does, in words: `keeps 0.31 m of clearance`, `has drac 5.9`."""
        return f"keeps {value:.2f} m of clearance"

    def breach_in_words(self, vehicle: Evaluations) -> str:
        """What a single unsafe vehicle does, with its value: `has drac 6.77 > 5.3`, `collides at
        3.21 m/s`, `keeps 0.04 m of clearance, less than 0.3 m`. With repeats the text also says how
        many runs are unsafe.
        """
        breach = self._breach_in_words(vehicle)
        runs = runs_in_words(self.failing_runs(vehicle)[:, 0])
        if runs:
            return f"{breach} and {runs}"
        return breach

    def _breach_in_words(self, vehicle: Evaluations) -> str:
        """What an unsafe vehicle does, in words, without the number of runs."""
        degree = float(vehicle.f_safe[0])
        if vehicle.collided[0]:
            return f"collides at {abs(degree):.2f} m/s"
        clearance = value_on_side(degree - self.contact, self.distance, "f", 2)
        return f"keeps {clearance} m of clearance, less than {self.distance:g} m"

    @classmethod
    def parse(cls, criterion: CriterionLike) -> Unsafe:
        """The criterion that `--unsafe` or an argument `unsafe` states: a text, or a number X for
        `below=X`.

        Raises
        ------
        InputError
            If it is not a valid criterion.
        """
        if isinstance(criterion, Unsafe):
            return criterion
        if criterion == COLLISION:
            return cls()
        text = str(criterion)
        if isinstance(criterion, float | int) and not isinstance(criterion, bool):
            text = f"below={float(criterion)!r}"
        parts = re.fullmatch(r"\s*([A-Za-z]\w*)\s*(<=|>=|<|>|=)\s*(\S+)\s*", text)
        limit = math.nan
        if parts:
            with suppress(ValueError):
                limit = float(parts[3])
        if parts and math.isfinite(limit):
            quantity = parts[1]
            comparison = parts[2]
            if (quantity, comparison) == (SAFETY_DEGREE, "<"):
                return cls(degree=limit)
            if (quantity, comparison) == ("below", "="):
                if limit < 0:
                    raise InputError(
                        "unsafe",
                        f"below={limit:g} is no clearance",
                        f'a clearance of at least 0 m, or "{cls(degree=limit)}"',
                    )
                return cls(below=limit)
            if comparison in COMPARISONS:
                return cls(bound=MetricBound(quantity, comparison, limit))
        raise InputError("unsafe", repr(criterion), CRITERIA)

    @classmethod
    def default(cls, original: Tables, outcomes: TextArray | pd.Series[str]) -> Unsafe:
        """The criterion if the user states none: a collision, if any vehicle collides or the
        original vehicle has no safety degree to halve; otherwise half of the original's safety
        degree.

        Parameters
        ----------
        original
            The original vehicle's metrics by name; an undefined metric is NaN or None.
        outcomes
            Outcomes of the vehicles, as an array or a column of `Outcome`.
        """
        safety_degree = original.get(SAFETY_DEGREE) or 0.0
        if (outcomes == COLLISION).any() or not safety_degree > 0:
            return cls()
        half = float(f"{DEGREE_SHARE * safety_degree:.{CRITERION_DIGITS}g}")
        return cls(degree=half, is_half=True)

    @classmethod
    def default_among(cls, evaluations: Evaluations, original: Evaluations) -> Unsafe:
        """The default criterion for evaluated vehicles together with the original vehicle.

        Raises
        ------
        InputError
            If no vehicle can be unsafe by this criterion.
        """
        outcomes = np.concatenate([original.outcome, evaluations.outcome])
        unsafe = cls.default(original.first_metrics, outcomes)
        if unsafe == cls() and not (outcomes == COLLISION).any():
            raise InputError(
                "unsafe",
                "nothing collides, and the original vehicle has no safety degree to halve",
                CRITERIA,
            )
        return unsafe


class UnsafeStated(Unsafe):
    """A criterion that a user states, or that replaces collisions if nothing collides."""

    is_collision = False
    verbs = "is unsafe", "are unsafe"
    event = "an unsafe vehicle"
    effects = "makes the vehicle unsafe", "make the vehicle unsafe"
    option = "--unsafe"


class UnsafeClearance(UnsafeStated):
    """A collision, or a clearance below a limit."""

    below: float

    def __str__(self) -> str:
        return f"below={self.below!r}"

    @property
    def distance(self) -> float:
        """The limit [m]."""
        return self.below


class UnsafeDegree(UnsafeStated):
    """A safety degree below a limit."""

    degree: float

    def __str__(self) -> str:
        return f"{SAFETY_DEGREE} < {self.degree!r}"

    @property
    def limit(self) -> float:
        """The limit [m, or -m/s]."""
        return self.degree

    @property
    def description(self) -> str:
        """Such as `safety degree below 1.4 m, half of the original's`."""
        words = f"safety degree below {degree_in_words(self.degree)}"
        if self.is_half:
            words += ", half of the original's"
        return words

    @property
    def remark(self) -> str:
        """A sentence that says that a default limit stands in for a collision."""
        if not self.is_half:
            return ""
        return (
            "Remark: No vehicle collided, so this limit stands in for a collision; --unsafe"
            " collision counts collisions alone."
        )

    def _holds(self, outcome: Any, column: ColumnOf) -> Quantity:
        return column(F_SAFE.name) < self.degree

    def value(self, robustness: float) -> float:
        """The safety degree that has a robustness [m, or -m/s]."""
        return self.degree + robustness

    def value_in_words(self, value: float) -> str:
        """Such as `has a safety degree of 1.5 m`."""
        return f"has a safety degree of {degree_in_words(value)}"

    def _breach_in_words(self, vehicle: Evaluations) -> str:
        degree = float(vehicle.f_safe[0])
        # If the limit is a distance, every collision is beyond it, and the text states the speed.
        if degree < 0 <= self.degree:
            return super()._breach_in_words(vehicle)
        unit = unit_of_degree(degree)
        text = value_on_side(degree, self.degree, "g", 3)
        return f"has a safety degree of {text} {unit}, below {significant(self.degree, 3)} {unit}"


class UnsafeMetric(UnsafeStated):
    """A metric beyond a limit, or (unless `stands_alone`) a collision."""

    bound: MetricBound
    stands_alone = False
    """Whether only the metric decides: a collision alone is then not unsafe."""

    def __str__(self) -> str:
        return str(self.bound)

    @property
    def measure(self) -> str:
        """The metric."""
        return self.bound.measure

    @property
    def limit(self) -> float:
        """The limit, in the unit of the metric."""
        return self.bound.limit

    @property
    def worst(self) -> Callable[..., float]:
        """`max` where large values are unsafe, else `min`."""
        if self.bound.worst_is_largest:
            return max
        return min

    @property
    def description(self) -> str:
        """Such as `drac > 6, or a collision`."""
        if self.stands_alone:
            return str(self.bound)
        return f"{self.bound}, or a collision"

    def _holds(self, outcome: Any, column: ColumnOf) -> Quantity:
        if self.stands_alone:
            return self._is_beyond(column)
        return (outcome == COLLISION) | self._is_beyond(column)

    def _is_beyond(self, column: ColumnOf) -> Quantity:
        measure, comparison, limit = self.bound
        return COMPARISONS[comparison](column(measure), limit)

    def _excess(self, evaluations: Evaluations) -> FloatArray:
        excess = self.bound.sign * (evaluations.column(self.measure) - self.limit)
        if self.stands_alone:
            return excess
        return np.where(evaluations.collided, evaluations.f_safe, excess)

    def value(self, robustness: float) -> float:
        """The value of the metric that has a robustness."""
        return self.limit + self.bound.sign * robustness

    def value_in_words(self, value: float) -> str:
        """Such as `has drac 5.9`."""
        return f"has {self.measure} {significant(value, 3)}"

    def _breach_in_words(self, vehicle: Evaluations) -> str:
        if not self._is_beyond(vehicle.column)[0]:
            return super()._breach_in_words(vehicle)
        measure, comparison, limit = self.bound
        value = value_on_side(float(vehicle.column(measure)[0]), limit, "g", 3)
        return f"has {measure} {value} {comparison} {limit:.12g}"


class UnsafeImpact(UnsafeMetric):
    """A bound on the impact: an impact up to an allowed speed is safe."""

    is_of_impacts = True
    stands_alone = True

    def _breach_in_words(self, vehicle: Evaluations) -> str:
        if not vehicle.collided[0]:
            return super()._breach_in_words(vehicle)
        columns = (
            vehicle.column(name)[0] for name in (IMPACT_SPEED.name, IMPACT_EXCESS.name)
        )
        return f"has an {impact_in_words(*columns)}"


class UnsafeShare(UnsafeMetric):
    """A bound on the share of unsafe runs of a vehicle."""

    stands_alone = True

    def _repeats(self, evaluations: Evaluations) -> list[Evaluations]:
        return [evaluations]

    def failing_runs(self, evaluations: Evaluations) -> BoolArray:
        return Unsafe().runs(evaluations)


METRIC_KINDS = {IMPACT_EXCESS.name: UnsafeImpact, UNSAFE_SHARE.name: UnsafeShare}
"""The classes of criteria for metrics whose criterion is not an `UnsafeMetric`."""


CriterionLike = Unsafe | float | str
"""Values of an argument `unsafe`: `Unsafe`, a number X for a clearance below X, "collision",
"below=X" or a metric beyond a limit such as "drac > 6".
"""
