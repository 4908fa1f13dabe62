"""What is measured in a study and what its searches minimise."""

from __future__ import annotations

import numpy as np
from msgspec import Struct

from safevar_sumo.metrics.base import MetricFacts
from safevar_sumo.metrics.safety_degree import SAFETY_DEGREE_METRIC
from safevar_sumo.records import BoolArray, Evaluations, FloatArray


class Objective(Struct, frozen=True, kw_only=True):
    """A column of results that is minimised, or `maximised`."""

    name: str
    title: str
    unit: str
    maximised: bool = False

    @classmethod
    def of(cls, metric: MetricFacts) -> Objective:
        """A metric in its unsafe direction."""
        if metric.name == SAFETY_DEGREE_METRIC.name:
            return F_SAFE
        return cls(name=metric.name, title=metric.title, unit=metric.unit, maximised=metric.more_is_unsafe)

    @property
    def sign(self) -> float:
        """What its values are multiplied by so that less is better."""
        return -1.0 if self.maximised else 1.0


class Scoring(Struct, frozen=True, kw_only=True):
    """The metrics of a study and the objectives of its searches; results keep it beside the study."""

    metrics: tuple[MetricFacts, ...]
    objectives: tuple[Objective, ...]

    def values(self, evaluations: Evaluations) -> FloatArray:
        """The objectives, all to be minimised, shape (M, objectives)."""
        return np.stack([one.sign * evaluations.column(one.name) for one in self.objectives], axis=1)

    def valid(self, evaluations: Evaluations) -> BoolArray:
        """Where the simulation succeeded and every objective is defined; shape (M,)."""
        return np.asarray(evaluations.valid & np.isfinite(self.values(evaluations)).all(axis=1))

    def metric(self, name: str) -> MetricFacts:
        """A metric by name."""
        return next(one for one in self.metrics if one.name == name)


F_SAFE = Objective(name="f_safe", title="safety degree", unit="m, -m/s")
F_DIFF = Objective(name="f_diff", title="largest change", unit="fraction")
F_NUM_DIFF = Objective(name="f_num_diff", title="characteristics changed", unit="-")
