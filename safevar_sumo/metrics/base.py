"""Records of measures (columns of results) and scorings (the objectives of a search), and functions
that several metrics use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType
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
from safevar_sumo.study import ORIGINAL_DEGREE, MetricsTable, Table

if TYPE_CHECKING:
    import pandas as pd

TIME_TOLERANCE = 1e-6
"""Largest difference between two times that count as equal [s]."""
OF_EVERY_TRACE = "speed", "separation"
"""Quantities that every trace of a run has."""


def sampling_stride(step: float, interval: float | None) -> int:
    """The number of simulation steps between two samples that are `interval` seconds apart; 1 if
    the interval is None.

    Raises
    ------
    InputError
        If the interval is no whole multiple of the step.
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
    """Sum over the first axis, in the order of its elements.

    numpy's own sum chooses an order that depends on the shape of the array. A vehicle's result
    would then depend on the number of vehicles.
    """
    if not len(samples):
        return np.zeros(samples.shape[1:])
    return np.asarray(np.add.accumulate(samples, axis=0)[-1])


MeasureName = Annotated[str, Meta(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,63}\Z")]
TitleText = Annotated[str, Meta(pattern=r"^[^\x00-\x1f\x7f]{1,200}\Z")]


class Measure(Table, frozen=True, kw_only=True):
    """A measure is a column of results: a metric of simulation runs, or a measure of change of
    settings. A search may minimise it, or maximise it if larger values are more unsafe.

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
        A description in one sentence.
    of
        The arguments of the function: `runs` or `settings`.
    function
        The function that computes the measure; None in results, and for columns that all results
        have. A function of `runs` takes N simulation runs and thresholds. A function of `settings`
        takes simulated settings, shape (N, n), and the characteristics. Both return values of shape
        (N,), for undefined metrics NaN. Element i depends only on run or setting i, bit for bit.
    needs
        The quantities (of `QUANTITIES`) that a function of runs reads, by default `OF_EVERY_TRACE`.
        The metric is undefined for runs that lack one of these quantities. Results do not store the
        needs.
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
        """The quantities that the function of runs reads, by default the quantities of every
        trace.
        """
        if self.needs is UNSET:
            return OF_EVERY_TRACE
        return self.needs

    @property
    def sign(self) -> float:
        """The factor by which a search multiplies values, so that it can minimise them: -1 or 1."""
        if self.more_is_unsafe:
            return -1.0
        return 1.0

    @property
    def facts(self) -> Measure:
        """The record without the function and its needs, as results store it."""
        return replace(self, function=None, needs=UNSET)

    def of_runs(self, runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
        """The metric of N runs, shape (N,). A value that a run states itself wins over the value of
        the function. NaN if a run lacks a quantity that the function needs.
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
    """The values of a metric, shape (N,), with NaN for runs with a collision."""
    return np.where(np.isnan(runs.collision_speed), values, np.nan)


def checked_measure(code: UserCode) -> Measure:
    """A user's measure, with a function that checks its own results.

    Raises
    ------
    UserCodeError
        If the object is no measure with a function.
    InputError
        If a field of the measure has an illegal value.
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
    function = code.checked_function(measure.function, facts.name, legal)
    return replace(facts, function=function)


class Scoring(Table, frozen=True, kw_only=True, omit_defaults=True):
    """The metrics of a study, and the objectives of its searches. Results store the scoring beside
    the study.

    `safe_original` is the safety degree [m] that the original vehicle must have at least in the
    same encounter, if encounters are ranges; None otherwise. Settings in other encounters are
    infeasible.
    """

    metrics: tuple[Measure, ...]
    objectives: tuple[Measure, ...]
    safe_original: float | None = None

    def violation(self, evaluations: Evaluations) -> FloatArray:
        """The part of `safe_original` that the original vehicle lacks in the encounter of each
        setting, shape (M,). 0 if the original vehicle is safe, infinite if its safety degree is
        undefined.
        """
        if self.safe_original is None:
            return np.zeros(len(evaluations))
        shortfall = self.safe_original - evaluations.column(ORIGINAL_DEGREE)
        return np.where(np.isnan(shortfall), np.inf, np.maximum(shortfall, 0.0))

    def feasible_rows(self, frame: pd.DataFrame) -> BoolArray:
        """In which rows of a data frame the original vehicle is safe in the same encounter. All
        rows, unless encounters are ranges.
        """
        if self.safe_original is None or ORIGINAL_DEGREE not in frame:
            return np.ones(len(frame), bool)
        return np.asarray(frame[ORIGINAL_DEGREE] >= self.safe_original)

    def values(self, evaluations: Evaluations) -> FloatArray:
        """The values of the objectives, shape (M, objectives). Smaller values are better."""
        return np.stack(
            [
                objective.sign * evaluations.column(objective.name)
                for objective in self.objectives
            ],
            axis=1,
        )

    def valid(self, evaluations: Evaluations) -> BoolArray:
        """Which settings are valid, shape (M,): the simulation succeeded, every objective is
        defined, and the original vehicle is safe in the encounter.
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
