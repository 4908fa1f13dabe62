"""The records of measures and scorings, and functions that several metrics use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType
from msgspec.structs import replace

from safevar_sumo.errors import InputError, UserCodeError, check_name
from safevar_sumo.plugins import FINITE, Legal, UserCode, quoted
from safevar_sumo.records import (
    QUANTITIES,
    BoolArray,
    Evaluations,
    FloatArray,
    SimulationRuns,
    nans,
)
from safevar_sumo.study import ORIGINAL_DEGREE, MetricsTable

if TYPE_CHECKING:
    import pandas as pd

TIME_TOLERANCE = 1e-6
"""Largest difference between two times that count as equal [s]."""
OF_EVERY_TRACE = "speed", "separation"
"""Quantities that every trace has."""


def sampling_stride(step: float, interval: float | None) -> int:
    """Number of simulation steps between two samples that are `interval` seconds apart; 1 without
    an interval.

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
            "",
            f"metrics.sampling_interval = {interval}",
            f"a whole multiple of the simulation's step, {step:g} s",
        )
    return steps


def sum_in_order(samples: FloatArray) -> FloatArray:
    """Sum over the first axis, in order.

    In numpy's own sum the order depends on the shape, so that a vehicle's result would depend on N.
    """
    if not len(samples):
        return np.zeros(samples.shape[1:])
    return np.asarray(np.add.accumulate(samples, axis=0)[-1])


MeasureName = Annotated[str, Meta(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,63}\Z")]
TitleText = Annotated[str, Meta(pattern=r"^[^\x00-\x1f\x7f]{1,200}\Z")]


class Measure(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A column of results: a metric of simulation runs, or a measure of change of settings. A
    search may minimise it, or maximise it if larger values are more unsafe.

    Attributes
    ----------
    name
        Name of the measure in a study, and of its column in results.
    title, unit
        Title and unit in tables.
    more_is_unsafe
        Whether larger values are more unsafe.
    over_collisions
        Whether colliding solutions count.
    description
        One sentence.
    of
        What it measures: `runs` or `settings`.
    function
        Takes N simulation runs and thresholds, or settings as simulated, shape (N, n), and the
        characteristics; returns shape (N,), of runs NaN where it is undefined. Element i depends
        only on run or setting i, bit for bit. None in results, and for columns that all results
        have.
    needs
        Quantities that the function of runs reads, of `QUANTITIES`; without them `OF_EVERY_TRACE`.
        It is not called with runs that lack one, where the metric is undefined. Not in results.
    """

    name: MeasureName
    title: TitleText
    unit: TitleText
    more_is_unsafe: bool = False
    over_collisions: bool = True
    description: str = ""
    of: Literal["runs", "settings"] = "runs"
    function: Any = None
    needs: tuple[str, ...] | UnsetType = UNSET

    @property
    def quantities(self) -> tuple[str, ...]:
        """The quantities that it needs, by default those of every trace."""
        if self.needs is UNSET:
            return OF_EVERY_TRACE
        return self.needs

    @property
    def sign(self) -> float:
        """Factor on the values after which a search minimises them."""
        if self.more_is_unsafe:
            return -1.0
        return 1.0

    @property
    def facts(self) -> Measure:
        """The record without the function and its needs, for results."""
        return replace(self, function=None, needs=UNSET)

    def of_runs(self, runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
        """The metric of N runs, shape (N,): what a run states itself, or else what the function
        says; NaN where a run lacks what it needs.
        """
        rows = np.flatnonzero(~runs.lacking(*self.quantities))
        values = nans(len(runs))
        if len(rows) == len(values):
            values = self.function(runs, thresholds)
        elif len(rows):
            values[rows] = self.function(runs.of(rows), thresholds)
        stated = runs.stated.get(self.name, values)
        return np.where(np.isnan(stated), values, stated)


def mask_collisions(runs: SimulationRuns, values: FloatArray) -> FloatArray:
    """A metric's values, shape (N,), undefined on a collision."""
    return np.where(np.isnan(runs.collision_speed), values, np.nan)


def checked_measure(code: UserCode) -> Measure:
    """A user's measure, whose values are checked.

    Raises
    ------
    InputError
        If it is not a valid record of a measure.
    """
    expected = (
        "a safevar_sumo.metrics.Measure(name=..., title=..., unit=..., function=...)"
    )
    measure = code.target
    if not (isinstance(measure, Measure) and callable(measure.function)):
        raise UserCodeError(
            "", f"{code.name} is {quoted(measure)}", expected, code.definition()
        )
    try:
        facts = msgspec.convert(
            msgspec.to_builtins(replace(measure, function=None)), Measure
        )
    except (msgspec.ValidationError, TypeError) as error:
        raise InputError("", f"{code.name}: {error}", expected) from None
    for need in facts.quantities:
        check_name("", f"{code.name}: needs = {measure.needs!r}", need, QUANTITIES)
    legal = FINITE
    if facts.of == "runs":
        legal = Legal(undefined=True)
    function = code.checked_function(measure.function, facts.name, legal, len)
    return replace(facts, function=function)


class Scoring(
    Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True
):
    """The metrics of a study and the objectives of its searches; stored in results beside the
    study.

    Where encounters are ranges, a setting is feasible if the original vehicle has at
    least the safety degree `safe_original` in the same encounter [m].
    """

    metrics: tuple[Measure, ...]
    objectives: tuple[Measure, ...]
    safe_original: float | None = None

    def violation(self, evaluations: Evaluations) -> FloatArray:
        """By how much the original vehicle is not safe in each setting's encounter, shape (M,); 0
        if it is, infinite if it could not be simulated.
        """
        if self.safe_original is None:
            return np.zeros(len(evaluations))
        shortfall = self.safe_original - evaluations.column(ORIGINAL_DEGREE)
        return np.where(np.isnan(shortfall), np.inf, np.maximum(shortfall, 0.0))

    def feasible_rows(self, frame: pd.DataFrame) -> BoolArray:
        """In which rows the original vehicle is safe in the same encounter: all, unless encounters
        are ranges.
        """
        if self.safe_original is None or ORIGINAL_DEGREE not in frame:
            return np.ones(len(frame), bool)
        return np.asarray(frame[ORIGINAL_DEGREE] >= self.safe_original)

    def values(self, evaluations: Evaluations) -> FloatArray:
        """Values of the objectives, smaller being better; shape (M, objectives)."""
        return np.stack(
            [
                objective.sign * evaluations.column(objective.name)
                for objective in self.objectives
            ],
            axis=1,
        )

    def valid(self, evaluations: Evaluations) -> BoolArray:
        """Whether the simulation succeeded, every objective is defined and the setting is feasible;
        shape (M,).
        """
        is_defined = np.isfinite(self.values(evaluations)).all(axis=1)
        return np.asarray(
            evaluations.valid & is_defined & (self.violation(evaluations) == 0)
        )


F_SAFE = Measure(name="f_safe", title="safety degree", unit="m, -m/s")
F_DIFF = Measure(name="f_diff", title="largest change", unit="fraction", of="settings")
F_NUM_DIFF = Measure(
    name="f_num_diff", title="characteristics changed", unit="-", of="settings"
)
