"""Records of metrics, objectives and scorings, and functions that several metrics use."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import msgspec
import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.plugins import Legal, UserCode, quoted
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, SimulationRuns
from safevar_sumo.study import ORIGINAL_DEGREE, SAFETY_DEGREE, MetricsTable, unit_text

if TYPE_CHECKING:
    import pandas as pd

TIME_TOLERANCE = 1e-6
"""Largest difference between two times that count as equal [s]."""
STUDY_SOURCE = "study"
"""Source of errors about a study's table [metrics], in functions that do not know the study's file."""


def sampling_stride(step: float, interval: float | None) -> int:
    """Number of simulation steps between two samples that are `interval` seconds apart; 1 without an interval.

    Raises
    ------
    InputError
        If that number is not whole.
    """
    if interval is None:
        return 1
    steps = round(interval / step)
    if steps < 1 or abs(steps * step - interval) > TIME_TOLERANCE:
        raise InputError(
            STUDY_SOURCE,
            f"metrics.sampling_interval = {interval}",
            f"a whole multiple of the simulation's step, {step:g} s",
        )
    return steps


def sum_in_order(samples: FloatArray) -> FloatArray:
    """Sum over the first axis, in order.

    In numpy's own sum the order depends on the shape, so that a vehicle's result would depend on N.
    """
    return np.asarray(np.add.accumulate(samples, axis=0)[-1]) if len(samples) else np.zeros(samples.shape[1:])


MetricName = Annotated[str, Meta(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,63}\Z")]
TitleText = Annotated[str, Meta(pattern=r"^[^\x00-\x1f\x7f]{1,200}\Z")]
MetricFunction = Callable[[SimulationRuns, MetricsTable], FloatArray]


class MetricFacts(Struct, frozen=True, kw_only=True):
    """Facts about a metric for tables and figures.

    Attributes
    ----------
    name
        Name of the metric in a study, and of its column in results.
    title, unit
        Title and unit in tables.
    more_is_unsafe
        Whether larger values are more unsafe.
    over_collisions
        Whether colliding solutions count.
    description
        One sentence.
    head
        Heading of the metric's column in tables, by default title and unit.
    """

    name: MetricName
    title: TitleText
    unit: TitleText
    more_is_unsafe: bool
    over_collisions: bool = True
    description: str = ""
    head: str = ""

    @property
    def heading(self) -> str:
        """`head`, by default title and unit."""
        return self.head or self.title + unit_text(self.unit, ", {}")


class Metric(MetricFacts, frozen=True, kw_only=True):
    """A metric: `function` takes N simulation runs and thresholds and returns an array of shape (N,), NaN where it is
    undefined.

    Element i depends only on run i, bit for bit.
    """

    function: MetricFunction

    def __call__(self, runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
        return self.function(runs, thresholds)

    @property
    def facts(self) -> MetricFacts:
        """The record without the function, for results."""
        return MetricFacts(**{name: getattr(self, name) for name in MetricFacts.__struct_fields__})


def mask_collisions(runs: SimulationRuns, values: FloatArray) -> FloatArray:
    """A metric's values, shape (N,), undefined on a collision."""
    return np.where(np.isnan(runs.collision_speed), values, np.nan)


def checked_metric(code: UserCode) -> Metric:
    """A user's metric, whose values are checked.

    Raises
    ------
    InputError
        If it is not a valid record of a metric.
    """
    expected = "a safevar_sumo.metrics.Metric(name=..., title=..., unit=..., more_is_unsafe=..., function=...)"
    metric = code.target
    if not (isinstance(metric, Metric) and callable(metric.function)):
        raise UserCodeError(code.source, f"{code.name} is {quoted(metric)}", expected, code.definition())
    try:
        facts = msgspec.convert(msgspec.to_builtins(metric.facts), MetricFacts)
    except (msgspec.ValidationError, TypeError) as error:
        raise InputError(code.source, f"{code.name}: {error}", expected) from None
    legal = Legal(undefined=True)
    function = code.checked_function(metric.function, facts.name, legal, lambda runs: len(runs.outcome))
    return Metric(**msgspec.structs.asdict(facts), function=function)


class Objective(Struct, frozen=True, kw_only=True):
    """A column of results that a search minimises, or maximises if `maximised`."""

    name: str
    title: str
    unit: str
    maximised: bool = False

    @classmethod
    def of(cls, metric: MetricFacts) -> Objective:
        """The objective that makes a metric as unsafe as possible."""
        if metric.name == SAFETY_DEGREE:
            return F_SAFE
        return cls(name=metric.name, title=metric.title, unit=metric.unit, maximised=metric.more_is_unsafe)

    @property
    def sign(self) -> float:
        """Factor on the objective's values after which smaller values are better."""
        return -1.0 if self.maximised else 1.0


class Scoring(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The metrics of a study and the objectives of its searches; stored in results beside the study.

    In a study that searches its scenario, a setting is feasible if the original vehicle has at least the safety degree
    `safe_original` in the same encounter [m].
    """

    metrics: tuple[MetricFacts, ...]
    objectives: tuple[Objective, ...]
    safe_original: float | None = None

    def violation(self, evaluations: Evaluations) -> FloatArray:
        """By how much the original vehicle is not safe in each setting's encounter, shape (M,); 0 if it is, infinite if
        it could not be simulated.
        """
        if self.safe_original is None:
            return np.zeros(len(evaluations))
        shortfall = self.safe_original - evaluations.column(ORIGINAL_DEGREE)
        return np.where(np.isnan(shortfall), np.inf, np.maximum(shortfall, 0.0))

    def feasible_rows(self, frame: pd.DataFrame) -> BoolArray:
        """In which rows the original vehicle is safe in the same encounter: all, unless the study searches its
        scenario.
        """
        if self.safe_original is None or ORIGINAL_DEGREE not in frame:
            return np.ones(len(frame), dtype=bool)
        return np.asarray(frame[ORIGINAL_DEGREE] >= self.safe_original)

    def values(self, evaluations: Evaluations) -> FloatArray:
        """Values of the objectives, smaller being better; shape (M, objectives)."""
        return np.stack([objective.sign * evaluations.column(objective.name) for objective in self.objectives], axis=1)

    def valid(self, evaluations: Evaluations) -> BoolArray:
        """Whether the simulation succeeded, every objective is defined and the setting is feasible; shape (M,)."""
        is_defined = np.isfinite(self.values(evaluations)).all(axis=1)
        return np.asarray(evaluations.valid & is_defined & (self.violation(evaluations) == 0))

    def metric(self, name: str) -> MetricFacts:
        """A metric by name."""
        return next(metric for metric in self.metrics if metric.name == name)


F_SAFE = Objective(name="f_safe", title="safety degree", unit="m, -m/s")
F_DIFF = Objective(name="f_diff", title="largest change", unit="fraction")
F_NUM_DIFF = Objective(name="f_num_diff", title="characteristics changed", unit="-")
