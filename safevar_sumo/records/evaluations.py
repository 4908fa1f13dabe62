"""Evaluations: the results of simulated settings, which a search receives for its request."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ("settings", "outcome", "collision_speed", "f_diff", "f_num_diff")
"""The arrays that all evaluations have. Each array has a row for each setting."""
OF_SOME = {"worst_points": "points", "stands": "standing"}
"""Further arrays, which only some evaluations have, and the properties that all evaluations have
in place of these arrays.
"""
ResultColumns = Mapping[str, npt.NDArray[np.generic]]
"""Results by name, as arrays with an element for each setting."""
RESULT_ROUNDING = 1e-9
"""Largest difference between a result in a recorded scene and the same result in SUMO that counts
as rounding.
"""


@dataclass(frozen=True, kw_only=True)
class Evaluations:
    """M evaluated settings with their outcomes, metrics and objectives. Arrays have shape (M,).

    Attributes
    ----------
    settings
        The simulated values in their table units, shape (M, n).
    outcome
        Values of `Outcome`.
    collision_speed
        Speed of the vehicle at the collision [m/s]; NaN without a collision.
    metrics
        The metrics of `safevar_sumo.metrics.METRICS`, and the study's further metrics; an undefined
        value is NaN.
    f_diff, f_num_diff
        The largest change, as a fraction, and the number of changes (small changes reset).
    reasons
        For the bytes of a setting: the reason why it could not be simulated.
    worst_points
        The numbers of the points at which the settings were worst; None without a matrix.
    stands
        Which vehicles never moved, although the original vehicle moves in the same encounter. Only
        questions ask this; None in a search, where such a vehicle counts like others.
    """

    settings: FloatArray
    outcome: TextArray
    collision_speed: FloatArray
    metrics: Mapping[str, FloatArray]
    f_diff: FloatArray
    f_num_diff: FloatArray
    reasons: Mapping[bytes, str] = field(default_factory=dict)
    worst_points: IntArray | None = None
    stands: BoolArray | None = None

    def __len__(self) -> int:
        return len(self.settings)

    @property
    def f_safe(self) -> FloatArray:
        """First objective: the safety degree (method section 3) [m]. On a collision it is the
        negative speed of the collision [m/s].
        """
        return self.metrics[SAFETY_DEGREE]

    @property
    def points(self) -> IntArray:
        """The numbers of the points at which the settings were worst. Without a matrix, the only
        point is 0.
        """
        if self.worst_points is None:
            return np.zeros(len(self), np.intp)
        return self.worst_points

    @property
    def results(self) -> ResultColumns:
        """The outcomes, collision speeds and metrics by name."""
        return {
            "outcome": self.outcome,
            "collision_speed": self.collision_speed,
            **self.metrics,
        }

    def gaps(self, contact: float) -> FloatArray:
        """The least clearances between bodies during the encounter [m], shape (M,); 0 on a
        collision, NaN if undefined.

        `contact` is the safety degree of bodies that touch [m].
        """
        return np.where(self.collided, 0.0, self.f_safe - contact)

    def column(self, name: str) -> FloatArray:
        """A metric, f_safe, f_diff or f_num_diff by name, shape (M,). A metric without values is
        NaN for all settings.
        """
        if name in ("f_safe", "f_diff", "f_num_diff"):
            return np.asarray(getattr(self, name))
        return self.metrics.get(name, nans(len(self)))

    @property
    def collided(self) -> BoolArray:
        return np.asarray(self.outcome == Outcome.COLLISION)

    @property
    def valid(self) -> BoolArray:
        """Which settings can be scored: they are feasible, their test is valid, their simulation
        did not fail, and the vehicle does not stand where the original vehicle moves.
        """
        is_scored = ~self.failed & (self.outcome != Outcome.INVALID_TEST)
        return np.asarray(is_scored & ~self.infeasible & ~self.standing)

    @property
    def standing(self) -> BoolArray:
        """`stands`, or no vehicle if nobody has asked."""
        if self.stands is None:
            return np.zeros(len(self), bool)
        return self.stands

    @property
    def infeasible(self) -> BoolArray:
        """Which settings violate a constraint of the study. They were not simulated."""
        return np.asarray(self.outcome == Outcome.INFEASIBLE)

    @property
    def failed(self) -> BoolArray:
        """Which simulations failed."""
        return np.asarray(self.outcome == Outcome.SIMULATOR_ERROR)

    def reason(self, row: int) -> str:
        """The reason why a setting could not be simulated."""
        return self.reasons.get(self.settings[row].tobytes(), "no reason was recorded")

    @property
    def repeats(self) -> list[Evaluations]:
        """The evaluations of each repeat, if settings are repeated; else an empty list. A repeat
        has its own outcome (as far as collisions are concerned), and the metrics that are kept for
        each repeat.
        """
        repeats = list[Evaluations]()
        while f"{SAFETY_DEGREE}_{len(repeats) + 1}" in self.metrics:
            end = f"_{len(repeats) + 1}"
            metrics = {
                name: self.metrics[f"{name}{end}"]
                for name in self.metrics
                if f"{name}{end}" in self.metrics
            }
            # A repeat without a collision, of a setting that collides in another repeat, has no
            # recorded outcome.
            outcome = np.where(
                metrics[SAFETY_DEGREE] < 0,
                Outcome.COLLISION.value,
                np.where(self.collided, "", self.outcome),
            )
            repeats.append(
                replace(self, outcome=outcome, metrics={**self.metrics, **metrics})
            )
        return repeats

    @property
    def first_metrics(self) -> NamedValues:
        """The metrics of the first setting, by name."""
        return {name: float(values[0]) for name, values in self.metrics.items()}

    def take(self, rows: Sequence[int] | IntArray | BoolArray | slice) -> Evaluations:
        """The evaluations of `rows`, in this order."""
        columns = {name: getattr(self, name)[rows] for name in COLUMNS}
        columns["metrics"] = {
            name: values[rows] for name, values in self.metrics.items()
        }
        for name in OF_SOME:
            if getattr(self, name) is not None:
                columns[name] = getattr(self, name)[rows]
        # User code gets the reasons as a read-only view, which cannot be sent to another process.
        return replace(self, **columns, reasons=dict(self.reasons))

    def keep_only(self, is_kept: BoolArray, outcome: str) -> Evaluations:
        """The evaluations with undefined results and this outcome for all settings that are not
        kept. `is_kept` has shape (M,).
        """
        return replace(
            self,
            outcome=np.where(is_kept, self.outcome, outcome),
            collision_speed=np.where(is_kept, self.collision_speed, np.nan),
            metrics={
                name: np.where(is_kept, values, np.nan)
                for name, values in self.metrics.items()
            },
        )

    @classmethod
    def none(cls, n: int, metrics: Iterable[str]) -> Evaluations:
        """Evaluations without any setting. Settings would have `n` characteristics."""
        no_changes = dict.fromkeys(("f_diff", "f_num_diff"), np.zeros(0))
        return cls.undefined(np.zeros((0, n)), "", metrics, **no_changes)

    @classmethod
    def undefined(
        cls, settings: FloatArray, outcome: str, metrics: Iterable[str], **further: Any
    ) -> Evaluations:
        """Evaluations of settings that were not simulated. All have the same outcome and undefined
        metrics.
        """
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
        """Join batches of evaluations in order. A metric that a batch lacks is undefined for its
        settings.

        In a batch without `worst_points`, the worst point of all settings is point 0.
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
        for name, complete in OF_SOME.items():
            if any(getattr(batch, name) is not None for batch in batches):
                columns[name] = np.concatenate(
                    [getattr(batch, complete) for batch in batches]
                )
        return cls(**columns, metrics=metrics, reasons=reasons)


def differences(
    expected: ResultColumns, actual: ResultColumns
) -> Iterator[tuple[int, str]]:
    """Yield the first row with a difference for each result that differs, and both values in
    words.
    """
    for name, expected_values in expected.items():
        values = actual[name]
        is_same = values == expected_values
        if values.dtype.kind == "f":
            is_same |= np.isnan(values) & np.isnan(expected_values)
        if not is_same.all():
            row = int(np.argmin(is_same))
            yield row, f"{name} is {values[row]} instead of {expected_values[row]}"


def csv_text(frame: pd.DataFrame) -> str:
    """The rows of a frame as CSV, with all digits of each number, whatever user code has set for
    the printing of numbers.
    """
    with np.printoptions(legacy=False):
        return frame.to_csv(index=False, lineterminator="\n")
