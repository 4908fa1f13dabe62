"""Criteria of an unsafe vehicle: a collision, a safety degree or a metric beyond a limit."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.metrics.base import F_SAFE
from safevar_sumo.metrics.legal import IMPACT_EXCESS, IMPACT_SPEED
from safevar_sumo.metrics.measures import UNSAFE_SHARE
from safevar_sumo.records import (
    KMH_PER_MS,
    BoolArray,
    Evaluations,
    FloatArray,
    Outcome,
    Quantity,
    TextArray,
)
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.study.schema import Tables

if TYPE_CHECKING:
    import pandas as pd

CRITERIA = (
    "collision, below=X with a clearance X [m] of at least 0, or a metric with <, <=, > or >= and a"
    ' number, such as "drac > 6"'
)
COMPARISONS: Mapping[str, Callable[[Quantity, float], Quantity]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
COLLISION = str(Outcome.COLLISION)
DEGREE_SHARE, LIMIT_DIGITS = 0.5, 6
"""The default limit if nothing collides: this share of the original's safety degree, to this many
significant digits.
"""
DEFAULT_MARGIN = 0.3
"""Distance to keep in a study that states no error of its model [m]."""
SHARE_DECIMALS = 9
"""Decimals of a sum of shares."""
LEAST = 1e-9
"""The least by which what is unsafe is beyond a limit, in its unit."""
ALLOWED_ROUNDING = 0.01
"""Allowed speed of an impact below which none is allowed [km/h]."""


class MetricBound(NamedTuple):
    """A measure, one of `COMPARISONS`, and a number: `drac > 6`."""

    measure: str
    comparison: str
    limit: float

    def __str__(self) -> str:
        return f"{self.measure} {self.comparison} {self.limit:.12g}"

    @property
    def worst_is_largest(self) -> bool:
        return self.comparison.startswith(">")


@dataclass(frozen=True)
class Unsafe:
    """A criterion of an unsafe vehicle: a collision, or less distance than `keep` [m]; with
    `below`, a collision, or a clearance below this limit [m]; with a `degree`, a safety degree of
    the study below this limit [m, or -m/s]; with a `bound`, another metric beyond a limit, or a
    collision.

    `contact` is the safety degree at which bodies touch [m]: 0, or how far middles are apart then.
    """

    below: float | None = None
    keep: float = 0.0
    contact: float = 0.0
    bound: MetricBound | None = None
    degree: float | None = None
    is_half: bool = field(default=False, compare=False, repr=False)
    """Whether `degree` is half of the original's safety degree, the default if nothing collides."""

    def __str__(self) -> str:
        if self.bound is not None:
            return str(self.bound)
        if self.degree is not None:
            return f"{SAFETY_DEGREE} < {self.degree!r}"
        if self.below is not None:
            return f"below={self.below!r}"
        return COLLISION

    @property
    def measure(self) -> str:
        """The column that decides: a metric, or the safety degree."""
        if self.bound is None:
            return F_SAFE.name
        return self.bound.measure

    @property
    def is_collision(self) -> bool:
        """Whether a collision alone, or less distance than `keep`, is unsafe."""
        return self.below is None and self.degree is None and self.bound is None

    @property
    def distance(self) -> float:
        """The clearance below which a vehicle is unsafe [m], between bumpers; 0 if a collision
        alone is.
        """
        if self.below is None:
            return self.keep
        return self.below

    @property
    def limit(self) -> float:
        """What is limited: a safety degree, or the value of a metric."""
        if self.bound is not None:
            return self.bound.limit
        if self.degree is not None:
            return self.degree
        return self.contact + self.distance

    @property
    def is_of_impacts(self) -> bool:
        """Whether a bound on the impact decides, which may be allowed."""
        return self.measure == IMPACT_EXCESS.name

    @property
    def _stands_alone(self) -> bool:
        """Whether a collision is not unsafe in itself."""
        return self.is_of_impacts or self._is_of_shares

    @property
    def _is_of_shares(self) -> bool:
        """Whether a bound on the share of unsafe runs decides."""
        return self.measure == UNSAFE_SHARE.name

    @property
    def worst(self) -> Callable[..., float]:
        """Which of several values is the worst: `min`, or `max` where a bound forbids large
        ones.
        """
        if self._worst_is_largest:
            return max
        return min

    @property
    def _worst_is_largest(self) -> bool:
        return self.bound is not None and self.bound.worst_is_largest

    @property
    def description(self) -> str:
        """The criterion in words, rounded: `collision, or clearance below 0.3 m`, `safety degree
        below 1.4 m, half of the original's`, `drac > 6, or a collision`.
        """
        if self._stands_alone:
            return str(self.bound)
        if self.bound is not None:
            return f"{self.bound}, or a collision"
        if self.degree is not None:
            words = f"safety degree below {_degree_in_words(self.degree)}"
            if self.is_half:
                words += ", half of the original's"
            return words
        if not self.distance:
            return COLLISION
        words = f"collision, or clearance below {self.distance:g} m"
        if self.contact:
            words += ", from bumper to bumper"
        return words

    @property
    def verbs(self) -> tuple[str, str]:
        """What an unsafe vehicle does, and what several do, in short."""
        if self.is_collision:
            return "collides", "collide"
        return "is unsafe", "are unsafe"

    def number_in_words(self, number: float) -> str:
        """How many vehicles are unsafe: `1,234 collide`, `none is unsafe (drac > 6, or a
        collision)`.
        """
        counted = f"{number:,}"
        if not number:
            counted = "none"
        elif number != int(number):
            counted = f"{number:,.1f}"
        if self.is_collision and not self.keep:
            return f"{counted} {self.verbs[number > 1]}"
        verb = ("is", "are")[number > 1]
        return f"{counted} {verb} unsafe ({self.description})"

    @property
    def remark(self) -> str:
        """What to know of a screening limit, in a sentence; empty for any other criterion."""
        if not self.is_half:
            return ""
        return (
            "Remark: No vehicle collided, so this limit stands in for a collision; --unsafe"
            " collision counts collisions alone."
        )

    def smaller_demand(self, original: Evaluations) -> str:
        """What to do where the original does not meet the criterion; "" if it collides, and a
        collision is what counts.
        """
        if self.is_collision and (not self.keep or original.collided[0]):
            return ""
        option = "--unsafe"
        if self.is_collision:
            option = "--margin"
        return f"Ask again with a weaker criterion ({option})."

    @property
    def in_words(self) -> str:
        """What an unsafe vehicle does: `collides`, `has drac > 6`."""
        if self.bound is not None:
            return f"has {self.bound}"
        if self.below is not None:
            return f"keeps less than {self.below:.3g} m of clearance"
        if self.degree is not None:
            return f"has a safety degree below {self.degree:.3g}"
        return "collides"

    def of(self, evaluations: Evaluations) -> BoolArray:
        """Which evaluations are unsafe; shape (M,). An undefined measure is not, a collision is by
        every bound.
        """
        return np.asarray(self.runs(evaluations).any(axis=0))

    def runs(self, evaluations: Evaluations) -> BoolArray:
        """Which of M evaluations are unsafe in which of their R repeats; shape (R, M), R is 1
        without repeats.
        """
        rounds = self._rounds(evaluations)
        return np.stack([self._holds(repeat.outcome, repeat.column) for repeat in rounds])

    def _rounds(self, evaluations: Evaluations) -> list[Evaluations]:
        if self._is_of_shares:
            return [evaluations]
        return evaluations.rounds or [evaluations]

    def number(self, evaluations: Evaluations) -> float:
        """How many evaluations are unsafe; each counts by the share of its repeats."""
        total = round(float(self.runs(evaluations).mean(axis=0).sum()), SHARE_DECIMALS)
        if total == int(total):
            return int(total)
        return total

    def rows(self, solutions: pd.DataFrame) -> pd.Series[bool]:
        """Which rows of `solutions`, a data frame from `safevar_sumo.results.load_runs`, are
        unsafe.
        """
        return self._holds(solutions["outcome"], solutions.__getitem__)  # type: ignore[no-any-return]

    def _holds(self, outcome: Any, column: Callable[[str], Quantity]) -> Quantity:
        if self.degree is not None:
            return column(F_SAFE.name) < self.degree
        collides = outcome == COLLISION
        if self.bound is not None:
            name, comparison, limit = self.bound
            is_beyond = COMPARISONS[comparison](column(name), limit)
            if self._stands_alone:
                return is_beyond
            return collides | is_beyond
        if not self.distance:
            return collides
        return collides | (column(F_SAFE.name) < self.limit)

    def robustness(self, evaluations: Evaluations) -> FloatArray:
        """How far evaluations are from the limit, in its unit, shape (M,): below 0 where they are
        unsafe; infinite where the measure is undefined; on a collision by a bound, minus the speed
        of the collision.
        """
        rounds = self._rounds(evaluations)
        return np.asarray(np.min([self._robustness(repeat) for repeat in rounds], axis=0))

    def _robustness(self, evaluations: Evaluations) -> FloatArray:
        if self.bound is None:
            robustness = evaluations.f_safe - self.limit
        else:
            robustness = evaluations.column(self.bound.measure) - self.limit
            if self._worst_is_largest:
                robustness = -robustness
            if not self._stands_alone:
                robustness = np.where(evaluations.collided, evaluations.f_safe, robustness)
        robustness = np.where(np.isnan(robustness), np.inf, robustness)
        is_unsafe = self._holds(evaluations.outcome, evaluations.column)
        return np.where(is_unsafe, np.minimum(robustness, -LEAST), np.maximum(robustness, 0.0))

    def value(self, robustness: float) -> float:
        """What has a robustness: a distance between bumpers [m], or the value that is
        limited.
        """
        if self._worst_is_largest:
            return self.limit - robustness
        if self.bound is None and self.degree is None:
            return self.distance + robustness
        return self.limit + robustness

    def value_in_words(self, value: float) -> str:
        """What a safe vehicle has: `keeps 0.31 m of clearance`, `has drac 5.9`."""
        if self.bound is not None:
            return f"has {self.bound.measure} {value:.3g}"
        if self.degree is not None:
            return f"has a safety degree of {_degree_in_words(value)}"
        return f"keeps {value:.2f} m of clearance"

    def breach_in_words(self, vehicle: Evaluations) -> str:
        """What a single unsafe vehicle does, with its value: `has drac 6.77 > 5.3`, `collides at
        3.21 m/s`, `keeps 0.04 m of clearance, less than 0.3 m`; with repeats, in how many runs.
        """
        return f"{self._breach_in_words(vehicle)}{runs_in_words(self.runs(vehicle)[:, 0])}"

    def _breach_in_words(self, vehicle: Evaluations) -> str:
        degree = float(vehicle.f_safe[0])

        if self.is_of_impacts and vehicle.collided[0]:
            columns = (vehicle.column(name)[0] for name in (IMPACT_SPEED.name, IMPACT_EXCESS.name))
            return f"has an {impact_in_words(*columns)}"
        if self.bound is not None:
            measure, comparison, limit = self.bound
            value = float(vehicle.column(measure)[0])
            if COMPARISONS[comparison](value, limit):
                text = _on_its_side(value, limit, "g", 3)
                return f"has {measure} {text} {comparison} {limit:.12g}"
        if self.degree is not None and (degree >= 0 or self.degree < 0):
            unit = _unit_of(degree)
            text = _on_its_side(degree, self.degree, "g", 3)
            return f"has a safety degree of {text} {unit}, below {self.degree:.3g} {unit}"
        if vehicle.collided[0]:
            return f"collides at {abs(degree):.2f} m/s"
        clearance = _on_its_side(degree - self.contact, self.distance, "f", 2)
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
        if isinstance(criterion, float | int):
            text = f"below={float(criterion)!r}"
        parts = re.fullmatch(r"\s*([A-Za-z]\w*)\s*(<=|>=|<|>|=)\s*(\S+)\s*", text)
        limit = math.nan
        if parts:
            with suppress(ValueError):
                limit = float(parts[3])
        if parts and math.isfinite(limit):
            quantity, comparison = parts[1], parts[2]
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
        """The criterion if none is stated.

        It is a collision if any vehicle collides or the original has no safety degree to halve;
        otherwise, a safety degree below half of the original's safety degree.

        Parameters
        ----------
        original
            The original vehicle's metrics by name; an undefined metric is NaN or None.
        outcomes
            Outcomes of the other vehicles, as an array or a column of `Outcome`.
        """
        safety_degree = original.get(SAFETY_DEGREE) or 0.0
        if (outcomes == COLLISION).any() or not safety_degree > 0:
            return cls()
        half = float(f"{DEGREE_SHARE * safety_degree:.{LIMIT_DIGITS}g}")
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
        metrics = {name: float(values[0]) for name, values in original.metrics.items()}
        unsafe = cls.default(metrics, outcomes)
        if unsafe == cls() and not (outcomes == COLLISION).any():
            raise InputError(
                "unsafe",
                "nothing collides, and the original vehicle has no safety degree to halve",
                CRITERIA,
            )
        return unsafe


def runs_in_words(fails: BoolArray) -> str:
    """In how many runs of a setting it is unsafe, shape (R,), with the exact interval (Clopper and
    Pearson) of their share; "" if there is a single run.
    """
    # This module takes a second to load.
    import scipy

    if len(fails) < 2:
        return ""
    count = int(fails.sum())
    low, high = scipy.stats.binomtest(count, len(fails)).proportion_ci(method="exact")
    interval = f"95 % confidence interval {100 * low:.0f} to {100 * high:.0f} %"
    return f" in {count} of {len(fails)} runs ({interval})"


def impact_in_words(speed: float, excess: float) -> str:
    """An impact [m/s] and its excess, such as `impact at 12 km/h where 15 is allowed`."""
    allowed_speed = KMH_PER_MS * (speed - excess)
    words = "none"
    if allowed_speed >= ALLOWED_ROUNDING:
        words = f"{allowed_speed:.3g}"
    return f"impact at {KMH_PER_MS * speed:.3g} km/h where {words} is allowed"


def _unit_of(degree: float) -> str:
    """The unit of a safety degree, which is minus a speed on a collision."""
    if degree >= 0:
        return "m"
    return "m/s"


def _degree_in_words(degree: float) -> str:
    """A safety degree with its unit."""
    return f"{degree:.3g} {_unit_of(degree)}"


def _on_its_side(value: float, limit: float, kind: str, digits: int) -> str:
    """A value with so many digits, or as few more as keep it on its side of a limit."""
    side = np.sign(value - limit)
    for number in range(digits, 17):
        text = f"{value:.{number}{kind}}"
        if np.sign(float(text) - limit) == side:
            return text
    return repr(value)


def margin_of(study: Study, margin: float | None) -> float:
    """The distance to keep [m]: the stated one, else the study's error of its model, else
    `DEFAULT_MARGIN`.
    """
    if margin is None:
        return study.model_error.get(SAFETY_DEGREE, DEFAULT_MARGIN)
    return margin


CriterionLike = Unsafe | float | str
"""Values of an argument `unsafe`: `Unsafe`, a number X for a clearance below X, "collision",
"below=X" or a metric beyond a limit such as "drac > 6".
"""
