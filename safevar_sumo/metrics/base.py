"""Samples of a trace, and sums over them that do not depend on how many vehicles there are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.errors import InputError
from safevar_sumo.plugins import Guard, read_only_copy
from safevar_sumo.records import FloatArray, SimulationRuns
from safevar_sumo.study import MetricsTable

ROUNDING = 1e-6
"""Two times that differ by less are the same [s]."""


def every(step: float, interval: float | None) -> int:
    """How many simulation steps lie between two samples that are `interval` seconds apart.

    Raises
    ------
    InputError
        If that is no whole number.
    """
    if interval is None:
        return 1
    steps = round(interval / step)
    if steps < 1 or abs(steps * step - interval) > ROUNDING:
        raise InputError("study", f"metrics.sampling_interval = {interval}", f"a whole multiple of the simulation's step, {step:g} s")
    return steps


def total(samples: FloatArray) -> FloatArray:
    """Sum over the first axis, one after the other: numpy's own sum would group by the shape of the array."""
    return np.asarray(np.add.accumulate(samples, axis=0)[-1]) if len(samples) else np.zeros(samples.shape[1:])


Name = Annotated[str, Meta(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,63}\Z")]
Text = Annotated[str, Meta(pattern=r"^[^\x00-\x1f\x7f]{1,200}\Z")]
Function = Callable[[SimulationRuns, MetricsTable], FloatArray]


class MetricFacts(Struct, frozen=True, kw_only=True):
    """What tables and figures need to know of a metric.

    Attributes
    ----------
    name
        Its column in results, and what a study calls it.
    title, unit
        As tables head it.
    more_is_unsafe
        Whether a larger value is the more unsafe one.
    over_collisions
        Whether solutions that are collisions count.
    description
        In one sentence.
    head
        What stands above a column, by default title and unit.
    """

    name: Name
    title: Text
    unit: Text
    more_is_unsafe: bool
    over_collisions: bool = True
    description: str = ""
    head: str = ""

    @property
    def heading(self) -> str:
        """Title and unit."""
        return self.head or (self.title if self.unit == "-" else f"{self.title}, {self.unit}")


class Metric(MetricFacts, frozen=True, kw_only=True):
    """A metric: `function` takes drives and thresholds and returns an array of shape (N,), NaN where it is undefined.

    Element i of it depends on drive i alone, to the bit.
    """

    function: Function

    def __call__(self, drives: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
        return self.function(drives, thresholds)

    @property
    def facts(self) -> MetricFacts:
        """The record without the function, as results keep it."""
        return MetricFacts(**{name: getattr(self, name) for name in MetricFacts.__struct_fields__})


def foreign_metric(metric: Any, guard: Guard) -> Metric:
    """A metric from outside the package: its record checked, its function given copies and its result checked.

    Raises
    ------
    InputError
        If it is no record of a metric.
    """
    legal = "a safevar_sumo.metrics.Metric(name=..., title=..., unit=..., more_is_unsafe=..., function=...)"
    if not isinstance(metric, Metric):
        raise InputError(guard.source, f"{guard.name} is of type {type(metric).__name__}, not Metric", legal)
    if not callable(metric.function):
        raise InputError(guard.source, f"{guard.name}: function = {metric.function!r}", "a function of drives and thresholds")
    try:
        facts = msgspec.convert(msgspec.to_builtins(metric.facts), MetricFacts)
    except (msgspec.ValidationError, TypeError) as error:
        raise InputError(guard.source, f"{guard.name}: {error}", legal) from None

    def checked(drives: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
        given = guard.call(facts.name, metric.function, read_only_copy(drives), thresholds)
        return guard.numbers(facts.name, "values", np.asarray(given) if isinstance(given, list) else given, (len(drives.outcome),),
                             undefined=True)

    return Metric(**{name: getattr(facts, name) for name in MetricFacts.__struct_fields__}, function=checked)
