"""Scans of the domains of characteristics one at a time; all others keep their original values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.metrics import RATING_POINTS, Unsafe
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.questions.evaluator import Evaluator, Interval
from safevar_sumo.records import FloatArray, JsonObject, finite_or_none
from safevar_sumo.study import SAFETY_DEGREE
from safevar_sumo.vehicles import Characteristic

SCAN_VALUES, RATED_SCAN_VALUES = 201, 33
"""Number of values over the domain, besides the original; fewer in a rated study: each takes a whole test matrix."""
PARTS_PER_ROUND = 8
"""Number of parts into which a round divides each interval with a change of state."""
ROUNDS, RATED_ROUNDS = 4, 1
"""Number of such rounds; fewer in a rated study."""
WHOLE_POINT_LOSS = 1 - 1e-6
"""A loss of more rating points than this counts as a whole point."""
POINT_ROUNDING = 1e-9
"""A loss of at most so many rating points is a rounding error."""


class EndsAcrossFits(NamedTuple):
    """How the ends of a safe interval move with the parameter sets of a study's table [spread].

    Attributes
    ----------
    sets
        Number of sets in which the interval exists, the study's own among them.
    range
        The least and the greatest lower end, and the least and the greatest upper end.
    unsafe_as_new
        Number of further sets with which the original itself is unsafe, so that there is no interval.
    """

    sets: int
    range: tuple[Interval, Interval]
    unsafe_as_new: int


@dataclass(frozen=True, kw_only=True)
class OneAtATimeScan:
    """The scan of one characteristic.

    Attributes
    ----------
    profile
        Columns `value` [unit], `safety_degree` [m, or -m/s], `state` ("safe", "unsafe", "not_simulated" or
        "infeasible"), and in a rated study `rating_points`, in the order of the values, which are closer together where
        the state changes.
    across_fits
        How the ends of the safe interval move over the study's parameter sets; None without any.
    """

    characteristic: Characteristic
    profile: pd.DataFrame
    across_fits: EndsAcrossFits | None = None

    def intervals(self, state: str) -> list[Interval]:
        """All intervals of a state, each from its first to its last value."""
        states = self.profile["state"]
        interval_numbers = (states != states.shift()).cumsum()  # the number rises where the state changes
        intervals = self.profile["value"][states == state].groupby(interval_numbers)
        return list(zip(intervals.min().tolist(), intervals.max().tolist(), strict=True))

    @property
    def safe(self) -> Interval | None:
        """The safe interval around the original; None if the original itself is unsafe."""
        original = self.characteristic.original
        return next((ends for ends in self.intervals("safe") if ends[0] <= original <= ends[1]), None)

    @property
    def unsafe(self) -> list[Interval]:
        """All unsafe intervals."""
        return self.intervals("unsafe")

    @property
    def margins(self) -> list[float | None]:
        """Safety degrees at the ends of the safe interval [m]."""
        degrees = self.profile.set_index("value")[SAFETY_DEGREE]
        return [None, None] if self.safe is None else [finite_or_none(degrees[end]) for end in self.safe]

    @property
    def points(self) -> dict[float, float] | None:
        """The vehicle's rating points at each value, in ascending order; None if the study is not rated."""
        if RATING_POINTS.name not in self.profile:
            return None
        return dict(zip(self.profile["value"].tolist(), self.profile[RATING_POINTS.name].tolist(), strict=True))

    def first_loss(self, loss: float = 0.0) -> float | None:
        """The value nearest to the original that loses more than `loss` rating points; None if no value does."""
        points, original = self.points or {}, self.characteristic.original
        allowed = points.get(original, math.nan) - loss - POINT_ROUNDING
        values = [value for value in points if points[value] < allowed]
        return min(values, key=lambda value: abs(value - original), default=None)

    def to_dict(self) -> JsonObject:
        """An entry for a characteristic in `alone` of `tolerance --json`; in a rated study with points, and where they
        are first lost.
        """
        rating_entries = (
            {}
            if self.points is None
            else {
                "points": [list(pair) for pair in self.points.items()],
                "any_lost": self.first_loss(),
                "first_point_lost": self.first_loss(WHOLE_POINT_LOSS),
            }
        )
        infeasible = self.intervals("infeasible")
        return {
            **rating_entries,
            "characteristic": self.characteristic.name,
            "unit": self.characteristic.unit,
            "original": self.characteristic.original,
            "safe": self.safe,
            "unsafe": self.unsafe,
            "not_simulated": self.intervals("not_simulated"),
            **({"infeasible": infeasible} if infeasible else {}),
            **({} if self.across_fits is None else {"across_fits": self.across_fits._asdict()}),
        }


def scan(evaluator: Evaluator, columns: Sequence[int], unsafe: Unsafe) -> list[OneAtATimeScan]:
    """Scan the domains of some characteristics, one at a time."""
    scanned = [evaluator.characteristics.members[column] for column in columns]
    number, rounds = (RATED_SCAN_VALUES, RATED_ROUNDS) if is_rated(evaluator.study) else (SCAN_VALUES, ROUNDS)
    values = [np.union1d(np.linspace(item.lower, item.upper, number), item.original) for item in scanned]
    profiles = _evaluate_profiles(evaluator, columns, values, unsafe)
    for _ in range(rounds):
        values = [_values_between_states(profile) for profile in profiles]
        if not any(map(len, values)):
            break
        finer_profiles = _evaluate_profiles(evaluator, columns, values, unsafe)
        profiles = [
            pd.concat(coarse_and_fine, ignore_index=True).sort_values("value", ignore_index=True)
            for coarse_and_fine in zip(profiles, finer_profiles, strict=True)
        ]
    return [
        OneAtATimeScan(characteristic=item, profile=profile) for item, profile in zip(scanned, profiles, strict=True)
    ]


def scan_with_sets(evaluator: Evaluator, columns: Sequence[int], unsafe: Unsafe, fits: int) -> list[OneAtATimeScan]:
    """Scan with the study's own parameters, and state how far the ends of the safe intervals move with its other
    parameter sets.
    """
    evaluators = evaluator.for_sets(fits) or [evaluator]
    scans = []
    for of_characteristic in zip(*(scan(with_set, columns, unsafe) for with_set in evaluators), strict=True):
        own_scan, intervals = of_characteristic[0], [each.safe for each in of_characteristic if each.safe is not None]
        if len(evaluators) > 1 and intervals:
            lows, highs = zip(*intervals, strict=True)
            across_fits = EndsAcrossFits(
                sets=len(intervals),
                range=((min(lows), max(lows)), (min(highs), max(highs))),
                unsafe_as_new=len(evaluators) - len(intervals),
            )
            own_scan = replace(own_scan, across_fits=across_fits)
        scans.append(own_scan)
    return scans


def _values_between_states(profile: pd.DataFrame) -> FloatArray:
    """New values that divide the intervals between neighbouring values of different states."""
    values, states = profile["value"].to_numpy(), profile["state"].to_numpy()
    rows = np.flatnonzero(states[1:] != states[:-1])[:, np.newaxis]
    inner = values[rows] + (values[rows + 1] - values[rows]) * np.arange(1, PARTS_PER_ROUND) / PARTS_PER_ROUND
    return np.setdiff1d(inner, values)


def _evaluate_profiles(
    evaluator: Evaluator, columns: Sequence[int], values: Sequence[FloatArray], unsafe: Unsafe
) -> list[pd.DataFrame]:
    """The profile of each characteristic at its `values`."""
    sizes = list(map(len, values))
    ends = np.cumsum(sizes)[:-1]
    settings = np.tile(evaluator.characteristics.original, (sum(sizes), 1))
    settings[np.arange(len(settings)), np.repeat(columns, sizes)] = np.concatenate(values)
    evaluations = evaluator.evaluate(settings, "one characteristic at a time")
    state = np.select(
        [evaluations.infeasible, ~evaluations.valid, unsafe.of(evaluations)],
        ["infeasible", "not_simulated", "unsafe"],
        "safe",
    )
    points = {name: column for name, column in evaluations.metrics.items() if name == RATING_POINTS.name}
    frame = pd.DataFrame({"value": np.concatenate(values), SAFETY_DEGREE: evaluations.f_safe, "state": state, **points})
    return [frame.iloc[rows].reset_index(drop=True) for rows in np.split(np.arange(len(frame)), ends)]
