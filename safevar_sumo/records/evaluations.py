"""Evaluated settings: what a batch returns to the search."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from safevar_sumo.records.driving import (
    BoolArray,
    FloatArray,
    IntArray,
    NamedValues,
    TextArray,
    nans,
)
from safevar_sumo.records.runs import Outcome
from safevar_sumo.study import SAFETY_DEGREE

COLUMNS = ("settings", "outcome", "collision_speed", "f_diff", "f_num_diff")
"""The arrays of `Evaluations` that all evaluations have, with one row for each setting."""
ResultColumns = Mapping[str, npt.NDArray[np.generic]]
"""Results by name, one element for each setting."""
ROUNDING = 1e-9
"""Largest accepted difference between a result in a recorded scene and in SUMO."""


@dataclass(frozen=True, kw_only=True)
class Evaluations:
    """M evaluated settings with their outcomes, metrics and objectives.

    `settings` has shape (M, n) and holds the simulated values in their table units; all other
    arrays have shape (M,). `metrics` holds `safevar_sumo.metrics.METRICS` and the study's further
    metrics; an undefined value is NaN. `collision_speed` is in m/s, `f_diff` a fraction,
    `f_num_diff` a count, both of the filtered values. `reasons` says, by the bytes of a setting,
    why the setting could not be simulated. `worst_points` are the numbers of the points at which
    the settings were worst, None without a matrix.
    """

    settings: FloatArray
    outcome: TextArray
    collision_speed: FloatArray
    metrics: Mapping[str, FloatArray]
    f_diff: FloatArray
    f_num_diff: FloatArray
    reasons: Mapping[bytes, str] = field(default_factory=dict)
    worst_points: IntArray | None = None

    def __len__(self) -> int:
        return len(self.settings)

    @property
    def f_safe(self) -> FloatArray:
        """First objective: the safety degree (method section 3) [m, or -m/s on a collision]."""
        return self.metrics[SAFETY_DEGREE]

    @property
    def points(self) -> IntArray:
        """`worst_points`; without a matrix the only point, 0."""
        if self.worst_points is None:
            return np.zeros(len(self), np.intp)
        return self.worst_points

    @property
    def results(self) -> ResultColumns:
        """Outcomes and metrics by name."""
        return {
            "outcome": self.outcome,
            "collision_speed": self.collision_speed,
            **self.metrics,
        }

    def gaps(self, contact: float) -> FloatArray:
        """Least distances between bodies during the encounter [m], shape (M,); 0 on a collision,
        NaN where undefined.

        Bodies touch at a safety degree of `contact` [m].
        """
        return np.where(self.collided, 0.0, self.f_safe - contact)

    def column(self, name: str) -> FloatArray:
        """A metric, f_safe, f_diff or f_num_diff by name; shape (M,). A metric without values is
        NaN everywhere.
        """
        if name in ("f_safe", "f_diff", "f_num_diff"):
            return np.asarray(getattr(self, name))
        return self.metrics.get(name, nans(len(self)))

    @property
    def collided(self) -> BoolArray:
        return np.asarray(self.outcome == Outcome.COLLISION)

    @property
    def valid(self) -> BoolArray:
        """Where the setting can be scored: it is feasible, the test was valid, and the simulator
        reported no error.
        """
        return np.asarray(
            ~self.failed & (self.outcome != Outcome.INVALID_TEST) & ~self.infeasible
        )

    @property
    def infeasible(self) -> BoolArray:
        """Where a constraint of the study is violated, so that nothing was simulated."""
        return np.asarray(self.outcome == Outcome.INFEASIBLE)

    @property
    def failed(self) -> BoolArray:
        """Where the simulation failed."""
        return np.asarray(self.outcome == Outcome.SIMULATOR_ERROR)

    def reason(self, row: int) -> str:
        """Why a setting that is not valid could not be scored."""
        return self.reasons.get(self.settings[row].tobytes(), "no reason was recorded")

    @property
    def rounds(self) -> list[Evaluations]:
        """The evaluations of each repeat, where settings are repeated: their outcomes as far as
        they collide, and the metrics that are kept of each.
        """
        rounds = list[Evaluations]()
        while (
            end := f"_{len(rounds) + 1}"
        ) and f"{SAFETY_DEGREE}{end}" in self.metrics:
            metrics = {
                name: self.metrics[f"{name}{end}"]
                for name in self.metrics
                if f"{name}{end}" in self.metrics
            }
            outcome = np.where(
                metrics[SAFETY_DEGREE] < 0,
                Outcome.COLLISION.value,
                np.where(self.collided, "", self.outcome),
            )
            rounds.append(
                replace(self, outcome=outcome, metrics={**self.metrics, **metrics})
            )
        return rounds

    @property
    def first_metrics(self) -> NamedValues:
        """The metrics of the first setting."""
        return {name: float(values[0]) for name, values in self.metrics.items()}

    def take(self, rows: Sequence[int] | IntArray | BoolArray) -> Evaluations:
        """The evaluations of `rows`, in that order."""
        columns = {name: getattr(self, name)[rows] for name in COLUMNS}
        columns["metrics"] = {
            name: values[rows] for name, values in self.metrics.items()
        }
        if self.worst_points is not None:
            columns["worst_points"] = self.worst_points[rows]
        # User code has a view of the reasons, which no process can send.
        return replace(self, **columns, reasons=dict(self.reasons))

    def where(self, is_kept: BoolArray, outcome: str) -> Evaluations:
        """Evaluations, undefined and with this outcome where they are not kept, shape (M,)."""
        return replace(
            self,
            outcome=np.where(is_kept, self.outcome, str(outcome)),
            collision_speed=np.where(is_kept, self.collision_speed, np.nan),
            metrics={
                name: np.where(is_kept, values, np.nan)
                for name, values in self.metrics.items()
            },
        )

    @classmethod
    def none(cls, n: int, metrics: Iterable[str]) -> Evaluations:
        """Empty evaluations, for settings of `n` characteristics."""
        no_changes = dict.fromkeys(("f_diff", "f_num_diff"), np.zeros(0))
        return cls.undefined(np.zeros((0, n)), "", metrics, **no_changes)

    @classmethod
    def undefined(
        cls, settings: FloatArray, outcome: str, metrics: Iterable[str], **further: Any
    ) -> Evaluations:
        """Evaluations of settings that were not simulated, all with one outcome."""
        undefined = nans(len(settings))
        return cls(
            settings=settings,
            outcome=np.full(len(settings), outcome, "U16"),
            collision_speed=undefined,
            metrics=dict.fromkeys(metrics, undefined),
            **further,
        )

    @classmethod
    def concatenate(cls, batches: Sequence[Evaluations]) -> Evaluations:
        """Join batches of evaluations in order; a metric that a batch lacks is undefined in its
        rows.

        The worst point of a batch without `worst_points` is the first.
        """
        columns = {}
        for name in COLUMNS:
            columns[name] = np.concatenate([getattr(batch, name) for batch in batches])
        reasons = dict[bytes, str]()
        names = dict[str, None]()
        for batch in batches:
            reasons |= batch.reasons
            names |= dict.fromkeys(batch.metrics)
        metrics = {}
        for name in names:
            metrics[name] = np.concatenate([batch.column(name) for batch in batches])
        worst_points = None
        if any(batch.worst_points is not None for batch in batches):
            worst_points = np.concatenate([batch.points for batch in batches])
        return cls(
            **columns, metrics=metrics, reasons=reasons, worst_points=worst_points
        )


def differences(
    outputs: ResultColumns, references: ResultColumns, tolerance: float = 0.0
) -> Iterator[tuple[int, str]]:
    """Yield, for each result that differs, the first row where it does, and both values in
    words.
    """
    for name, values in outputs.items():
        reference = references[name]
        is_same = values == reference
        if values.dtype.kind == "f":
            is_same |= np.isclose(
                values, reference, rtol=0, atol=tolerance, equal_nan=True
            )
        if not is_same.all():
            row = int(np.argmin(is_same))
            yield row, f"{name} is {reference[row]} instead of {values[row]}"
