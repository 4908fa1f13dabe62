"""Scans of the domains of characteristics one at a time, and of the plane of two; all others keep their original
values.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.analysis.evaluator import Evaluator, Interval
from safevar_sumo.metrics import RATING_POINTS, Unsafe
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, JsonObject, finite_or_none
from safevar_sumo.study import SAFETY_DEGREE
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

SCAN_VALUES, RATED_SCAN_VALUES = 201, 33
"""Number of values over the domain, besides the original; fewer in a rated study: each takes a whole test matrix."""
PARTS_PER_ROUND, ROUNDS, RATED_ROUNDS = 8, 4, 1
"""Parts into which a round divides each interval with a change of state; rounds, and rounds in a rated study."""
WHOLE_POINT_LOSS = 1 - 1e-6
"""A loss of more rating points than this counts as a whole point."""
POINT_ROUNDING = 1e-9
"""A loss of at most so many rating points is a rounding error."""
GRID_VALUES = 21
"""Number of values of each of two characteristics, evenly spaced over its domain, ends included."""
PARTS_PER_SIDE, PLANE_ROUNDS, MAX_SQUARES = 4, 4, 12
"""Search for the nearest unsafe setting of a plane: number of parts of a divided square's side, of rounds (down to a
5120th of the domain), and maximum number of squares divided in each round."""


class EndsAcrossFits(NamedTuple):
    """Ranges of the two ends of a safe interval over `sets` parameter sets of [spread], the study's own among them."""

    sets: int
    range: tuple[Interval, Interval]


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
        sections = self.profile["value"][states == state].groupby((states != states.shift()).cumsum())
        return list(zip(sections.min().tolist(), sections.max().tolist(), strict=True))

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

    def first_loss(self, points: float = 0.0) -> float | None:
        """The value nearest to the original that loses more than `points` rating points; None if no value does."""
        kept, original = self.points or {}, self.characteristic.original
        limit = kept.get(original, math.nan) - points - POINT_ROUNDING
        return min(
            (value for value in kept if kept[value] < limit), key=lambda value: abs(value - original), default=None
        )

    def to_dict(self) -> JsonObject:
        """An entry of `alone` in `tolerance --json`; in a rated study with points, and where points are first lost."""
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


def scan(
    evaluator: Evaluator, columns: Sequence[int], unsafe: Unsafe, others: FloatArray | None = None
) -> list[OneAtATimeScan]:
    """Scan the domains of some characteristics, one at a time; each with the other values of its row of `others`, shape
    (K, n), by default as in the original.
    """
    if others is None:
        others = np.tile(evaluator.characteristics.original, (len(columns), 1))
    scanned, rated = [evaluator.characteristics.members[column] for column in columns], is_rated(evaluator.study)
    number = RATED_SCAN_VALUES if rated else SCAN_VALUES
    values = [np.union1d(np.linspace(one.lower, one.upper, number), one.original) for one in scanned]
    profiles = _evaluate_profiles(evaluator, columns, others, values, unsafe)
    for _ in range(RATED_ROUNDS if rated else ROUNDS):
        values = [_values_between_states(profile) for profile in profiles]
        if not any(map(len, values)):
            break
        finer_profiles = _evaluate_profiles(evaluator, columns, others, values, unsafe)
        profiles = [
            pd.concat(both, ignore_index=True).sort_values("value", ignore_index=True)
            for both in zip(profiles, finer_profiles, strict=True)
        ]
    return [OneAtATimeScan(characteristic=one, profile=profile) for one, profile in zip(scanned, profiles, strict=True)]


def scan_with_sets(evaluator: Evaluator, columns: Sequence[int], unsafe: Unsafe, fits: int) -> list[OneAtATimeScan]:
    """Scan with the study's own parameters, and with its other sets, whose safe intervals give ranges of the ends."""
    own, *others = [scan(one, columns, unsafe) for one in evaluator.for_sets(fits) or [evaluator]]
    scans = []
    for one, *same in zip(own, *others, strict=True):
        ends = [each.safe for each in (one, *same) if each.safe is not None]
        if others and ends:
            lows, highs = zip(*ends, strict=True)
            across = EndsAcrossFits(len(ends), ((min(lows), max(lows)), (min(highs), max(highs))))
            one = replace(one, across_fits=across)
        scans.append(one)
    return scans


def _values_between_states(profile: pd.DataFrame) -> FloatArray:
    """New values between neighbouring values of different states."""
    values, states = profile["value"].to_numpy(), profile["state"].to_numpy()
    rows = np.flatnonzero(states[1:] != states[:-1])[:, np.newaxis]
    inner = values[rows] + (values[rows + 1] - values[rows]) * np.arange(1, PARTS_PER_ROUND) / PARTS_PER_ROUND
    return np.setdiff1d(inner, values)


def _evaluate_profiles(
    evaluator: Evaluator, columns: Sequence[int], others: FloatArray, values: Sequence[FloatArray], unsafe: Unsafe
) -> list[pd.DataFrame]:
    """The profile of each characteristic at its `values`."""
    ends = np.cumsum([len(its_values) for its_values in values])[:-1]
    settings = np.concatenate(
        [
            _settings_with(row, [column], its_values[:, np.newaxis])
            for row, column, its_values in zip(others, columns, values, strict=True)
        ]
    )
    evaluations = evaluator.evaluate(settings, "one characteristic at a time")
    state = np.select(
        [evaluations.infeasible, ~evaluations.valid, unsafe.of(evaluations)],
        ["infeasible", "not_simulated", "unsafe"],
        "safe",
    )
    points = {name: degrees for name, degrees in evaluations.metrics.items() if name == RATING_POINTS.name}
    frame = pd.DataFrame({"value": np.concatenate(values), SAFETY_DEGREE: evaluations.f_safe, "state": state, **points})
    return [frame.iloc[rows].reset_index(drop=True) for rows in np.split(np.arange(len(frame)), ends)]


def _settings_with(setting: FloatArray, columns: Sequence[int], values: FloatArray) -> FloatArray:
    """A setting with K rows of values in some columns, shape (K, n)."""
    settings = np.tile(setting, (len(values), 1))
    settings[:, list(columns)] = values
    return settings


class Pair(NamedTuple):
    """The plane of two characteristics.

    Attributes
    ----------
    unsafe_share, not_simulated_share
        Unsafe share of the simulated part of the plane, and the share that could not be simulated, by the trapezoidal
        rule on the grid. A setting that could not be simulated, or violates a constraint, is neither safe nor unsafe.
    nearest
        The two values of the unsafe setting that is nearest to the original by distance in domain widths, exact to a
        5120th of them; None if no setting of the grid is unsafe. Unsafe settings that lie only between safe values of
        the grid are not found.
    """

    characteristics: list[str]
    unsafe_share: float
    not_simulated_share: float
    nearest: dict[str, float] | None


def scan_pairs(evaluator: Evaluator, columns: Sequence[int], unsafe: Unsafe) -> list[Pair]:
    """The plane of every pair of characteristics, with the plane's unsafe setting nearest to the original."""
    characteristics, planes = evaluator.characteristics, [list(plane) for plane in combinations(columns, 2)]
    axes = np.linspace(characteristics.lower, characteristics.upper, GRID_VALUES).T
    grids = [np.stack(np.meshgrid(*axes[plane], indexing="ij"), axis=-1).reshape(-1, 2) for plane in planes]

    def evaluate(values: Sequence[FloatArray], stage: str) -> Evaluations:
        settings = [_settings_with(characteristics.original, *pair) for pair in zip(planes, values, strict=True)]
        return evaluator.evaluate(np.concatenate(settings), stage)

    evaluations = evaluate(grids, "two characteristics at a time")
    is_unsafe, is_valid, is_lost = (
        flags.reshape(len(planes), GRID_VALUES, GRID_VALUES)
        for flags in (unsafe.of(evaluations), evaluations.valid, ~evaluations.valid & ~evaluations.infeasible)
    )
    searches = [_search_nearest(grid, characteristics, plane) for grid, plane in zip(is_unsafe, planes, strict=True)]
    values = [next(search) for search in searches]
    for _ in range(PLANE_ROUNDS):
        found = unsafe.of(evaluate(values, "nearest unsafe settings"))
        parts = np.split(found, np.cumsum(list(map(len, values)))[:-1])
        values = [search.send(part) for search, part in zip(searches, parts, strict=True)]
    ends = np.where(np.isin(np.arange(GRID_VALUES), (0, GRID_VALUES - 1)), 0.5, 1.0)
    unsafe_area, valid_area, lost_area = (
        np.sum(np.outer(ends, ends) * flags, axis=(1, 2)) for flags in (is_unsafe, is_valid, is_lost)
    )
    names = [[characteristics.names[column] for column in plane] for plane in planes]
    return [
        Pair(
            characteristics=names[k],
            unsafe_share=float(unsafe_area[k] / valid_area[k]) if valid_area[k] else 0.0,
            not_simulated_share=float(lost_area[k] / ends.sum() ** 2),
            nearest=dict(zip(names[k], nearest[0].tolist(), strict=True)) if len(nearest) else None,
        )
        for k, nearest in enumerate(values)
    ]


def _search_nearest(
    grid: BoolArray, characteristics: CharacteristicSet, plane: list[int]
) -> Generator[FloatArray, BoolArray]:
    """Find the unsafe setting of a plane nearest to the original, from where its grid is unsafe; distances are in
    domain widths.

    Yields values of the two characteristics, shape (K, 2), and is sent which are unsafe; at last, after `PLANE_ROUNDS`,
    yields the setting's values, shape (1, 2), or (0, 2) if there is none. A branch and bound search: a square with an
    unsafe corner is divided into smaller squares if it comes nearer to the original than the nearest unsafe setting so
    far; each round divides the `MAX_SQUARES` nearest squares.
    """

    def distances(offset: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(np.sum((offset / width) ** 2, axis=-1)))

    original, lower, upper = (
        ends[plane] for ends in (characteristics.original, characteristics.lower, characteristics.upper)
    )
    width = upper - lower
    size = width / (GRID_VALUES - 1)
    values = lower + np.argwhere(np.ones_like(grid)) * size
    steps = np.argwhere(np.ones((PARTS_PER_SIDE + 1,) * 2))
    nearest, corners, grids = np.zeros((0, 2)), lower[np.newaxis], grid[np.newaxis]
    for round_number in range(PLANE_ROUNDS + 1):
        known = np.concatenate([nearest, values[grids.ravel()]])
        nearest = known[np.argsort(distances(known - original), kind="stable")[:1]]
        if round_number == PLANE_ROUNDS:
            break
        square, i, j = np.nonzero(grids[:, 1:, 1:] | grids[:, :-1, 1:] | grids[:, 1:, :-1] | grids[:, :-1, :-1])
        corners = corners[square] + np.stack([i, j], axis=1) * size
        offset = corners - original
        gaps = distances(np.maximum(np.maximum(offset, -offset - size), 0.0))
        order = np.argsort(gaps, kind="stable")
        order = order[gaps[order] < np.min(distances(nearest - original), initial=math.inf)][:MAX_SQUARES]
        corners, size = corners[order], size / PARTS_PER_SIDE
        values = np.minimum(corners[:, np.newaxis] + steps * size, lower + width).reshape(-1, 2)
        grids = (yield values).reshape(-1, PARTS_PER_SIDE + 1, PARTS_PER_SIDE + 1)
    yield nearest
