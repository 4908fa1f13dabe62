"""Several characteristics together: a grid in the plane of every pair, and the largest safe box around the original."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from safevar_sumo.analysis.evaluator import CONFIDENCE, Evaluator, sobol_points
from safevar_sumo.analysis.explain.causes import Line, find_first_unsafe_shares
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.vehicles import Characteristic

GRID_VALUES = 21
"""Number of values of each of the two characteristics, evenly spaced over its domain, ends included."""
PARTS_PER_SIDE, ROUNDS, MAX_SQUARES = 4, 4, 12
"""Search for the nearest unsafe setting: number of parts of a divided square's side, of rounds (down to a 5120th of the domain),
and maximum number of squares divided in a plane in each round."""

_TRAPEZOIDAL_WEIGHTS = np.outer(*[np.where(np.isin(np.arange(GRID_VALUES), (0, GRID_VALUES - 1)), 0.5, 1.0)] * 2)


@dataclass(frozen=True, kw_only=True)
class Pair:
    """The plane of two characteristics while all others keep their original values.

    Attributes
    ----------
    values
        Values of both characteristics, shape (2, GRID_VALUES), each in its unit.
    safety_degree, unsafe, valid, infeasible
        Evaluations on the grid, shape (GRID_VALUES, GRID_VALUES), with the first characteristic on axis 0; safety degrees in m, or -m/s.
        A setting that is not valid could not be simulated, or violates a constraint (`infeasible`), and is neither safe nor unsafe.
    nearest
        The two values of the unsafe setting that is nearest to the original by distance in domain widths, exact to a 5120th of them; None
        if no setting of the grid is unsafe. Unsafe settings that lie only between safe values of the grid are not found.
    """

    characteristics: tuple[Characteristic, Characteristic]
    values: FloatArray
    safety_degree: FloatArray
    unsafe: BoolArray
    valid: BoolArray
    infeasible: BoolArray
    nearest: tuple[float, float] | None

    @property
    def unsafe_share(self) -> float:
        """Unsafe share of the simulated part of the plane, by the trapezoidal rule."""
        weight = np.sum(_TRAPEZOIDAL_WEIGHTS * self.valid)
        return float(np.sum(_TRAPEZOIDAL_WEIGHTS * self.unsafe) / weight) if weight else 0.0

    @property
    def not_simulated_share(self) -> float:
        """Share of the plane that could not be simulated, by the same rule."""
        return float(np.sum(_TRAPEZOIDAL_WEIGHTS * (~self.valid & ~self.infeasible)) / np.sum(_TRAPEZOIDAL_WEIGHTS))

    def to_dict(self) -> dict[str, Any]:
        """The entry of `pairs` in `tolerance --json`."""
        names = [characteristic.name for characteristic in self.characteristics]
        return {"characteristics": names, "unsafe_share": self.unsafe_share, "not_simulated_share": self.not_simulated_share,
                "nearest": None if self.nearest is None else dict(zip(names, self.nearest, strict=True))}


def scan_pairs(evaluator: Evaluator, columns: Sequence[int], unsafe: Unsafe) -> list[Pair]:
    """The plane of every pair of characteristics, with the plane's unsafe setting nearest to the original."""
    characteristics, original = evaluator.characteristics.members, evaluator.characteristics.original
    column_pairs = list(combinations(columns, 2))
    axes = {column: np.linspace(characteristics[column].lower, characteristics[column].upper, GRID_VALUES) for column in columns}
    settings = np.tile(original, (len(column_pairs), GRID_VALUES, GRID_VALUES, 1))
    for grid, (first, second) in zip(settings, column_pairs, strict=True):
        grid[:, :, first], grid[:, :, second] = axes[first][:, np.newaxis], axes[second]
    evaluations = evaluator.evaluate(settings.reshape(-1, len(original)), "two characteristics at a time")
    shape = (len(column_pairs), GRID_VALUES, GRID_VALUES)
    degrees, valid, infeasible = (values.reshape(shape) for values in (evaluations.f_safe, evaluations.valid, evaluations.infeasible))
    is_unsafe = unsafe.of(evaluations).reshape(shape)
    nearest = _find_nearest_unsafe(evaluator, column_pairs, is_unsafe, unsafe)
    return [Pair(characteristics=(characteristics[first], characteristics[second]), values=np.stack([axes[first], axes[second]]),
                 safety_degree=degrees[plane], unsafe=is_unsafe[plane], valid=valid[plane], infeasible=infeasible[plane],
                 nearest=nearest.get(plane)) for plane, (first, second) in enumerate(column_pairs)]


def _find_nearest_unsafe(evaluator: Evaluator, column_pairs: Sequence[tuple[int, int]], is_unsafe: BoolArray,
                         unsafe: Unsafe) -> dict[int, tuple[float, float]]:
    """The unsafe setting nearest to the original in every plane with unsafe settings; distances are in widths of the domains.

    A branch and bound search: a square with an unsafe corner is divided into smaller squares if it comes nearer to the original than
    the nearest unsafe setting so far; each round divides the `MAX_SQUARES` nearest squares of each plane.
    """
    characteristics = evaluator.characteristics
    columns = np.array(column_pairs, dtype=int).reshape(-1, 2)
    original, width = characteristics.original[columns], (characteristics.upper - characteristics.lower)[columns]
    lower, size = characteristics.lower[columns], width / (GRID_VALUES - 1)
    best_distance, best_values = np.full(len(column_pairs), np.inf), np.zeros((len(column_pairs), 2))

    def improve(plane: npt.NDArray[np.intp], values: FloatArray) -> None:
        distances = np.sqrt(np.sum(((values - original[plane]) / width[plane]) ** 2, axis=1))
        for row in np.lexsort((distances, plane)):  # the nearest of each plane first
            if distances[row] < best_distance[plane[row]]:
                best_distance[plane[row]], best_values[plane[row]] = distances[row], values[row]

    plane, i, j = np.nonzero(is_unsafe)
    improve(plane, lower[plane] + np.stack([i, j], axis=1) * size[plane])
    square_planes, i, j = np.nonzero(_with_unsafe_corner(is_unsafe))  # shape (K,), for K squares
    corner = lower[square_planes] + np.stack([i, j], axis=1) * size[square_planes]  # lower corner of every square, shape (K, 2)
    steps = np.stack(np.meshgrid(np.arange(PARTS_PER_SIDE + 1), np.arange(PARTS_PER_SIDE + 1), indexing="ij"), axis=-1).reshape(-1, 2)
    for _ in range(ROUNDS):
        offset = corner - original[square_planes]
        gap = np.maximum(np.maximum(offset, -offset - size[square_planes]), 0.0)
        least_distances = np.sqrt(np.sum((gap / width[square_planes]) ** 2, axis=1))
        rows = np.flatnonzero(least_distances < best_distance[square_planes])
        groups = [rows[square_planes[rows] == k] for k in np.unique(square_planes[rows])]
        nearest = [group[np.argsort(least_distances[group], kind="stable")[:MAX_SQUARES]] for group in groups]
        squares = np.array([row for group in nearest for row in group], dtype=np.intp)
        if not len(squares):
            break
        square_planes, corner, size = square_planes[squares], corner[squares], size / PARTS_PER_SIDE
        plane = np.repeat(square_planes, len(steps))
        values = np.minimum(np.repeat(corner, len(steps), axis=0) + np.tile(steps, (len(squares), 1)) * size[plane], (lower + width)[plane])
        settings = np.tile(characteristics.original, (len(values), 1))
        np.put_along_axis(settings, columns[plane], values, axis=1)
        new_unsafe = unsafe.of(evaluator.evaluate(settings, "nearest unsafe settings"))
        improve(plane[new_unsafe], values[new_unsafe])
        square, i, j = np.nonzero(_with_unsafe_corner(new_unsafe.reshape(len(squares), PARTS_PER_SIDE + 1, PARTS_PER_SIDE + 1)))
        square_planes, corner = square_planes[square], corner[square] + np.stack([i, j], axis=1) * size[square_planes[square]]
    return {int(k): (float(best_values[k, 0]), float(best_values[k, 1])) for k in np.flatnonzero(np.isfinite(best_distance))}


def _with_unsafe_corner(grids: BoolArray) -> BoolArray:
    """Squares of grids, shape (K, S, S), that have an unsafe corner; shape (K, S - 1, S - 1)."""
    return np.asarray(grids[:, 1:, 1:] | grids[:, :-1, 1:] | grids[:, 1:, :-1] | grids[:, :-1, :-1])


MAX_UNSAFE_SHARE = 0.003
"""Upper bound of a box's unsafe share, with 95 % confidence, if every sampled setting is safe."""
FIRST_SEARCH_POINTS, SECOND_SEARCH_POINTS = 256, 1024
"""Number of Sobol points, and of corners, in the first search of a box, and in a second search if the first finds nothing unsafe."""
MAX_LINES = 16
"""Maximum number of unsafe settings, the nearest first, from which the search goes back towards the original."""
STEP_BACK = 0.999
"""The box ends at this share of the way to the nearest unsafe setting."""
MIN_FACTOR = 1e-6
"""Smallest factor of a box; below it there is no safe box."""


class SafeBox(NamedTuple):
    """A box around the original, `factor` times as wide as the domain; no setting of a random sample in it is unsafe.

    With `confidence`, at most `unsafe_at_most` of all settings in the box are unsafe or cannot be simulated: `failed` of the `samples`
    settings could not be simulated, and count as unsafe in that bound. `attempts` boxes were tested. Only `characteristics` vary; the
    others keep their original values. If no box is safe, `factor` is 0 and the bound is 1.
    """

    factor: float
    confidence: float
    samples: int
    failed: int
    attempts: int
    unsafe_at_most: float
    characteristics: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """The entry `joint` of `tolerance --json`."""
        return {**self._asdict(), "characteristics": list(self.characteristics)}


def no_safe_box(evaluator: Evaluator, columns: Sequence[int], attempts: int = 0) -> SafeBox:
    """The result if no box is safe because the original vehicle, or a setting arbitrarily near to the original, is unsafe."""
    return SafeBox(0.0, CONFIDENCE, 0, 0, attempts, 1.0, tuple(evaluator.characteristics.names[column] for column in columns))


def find_safe_box(evaluator: Evaluator, columns: Sequence[int], unsafe: Unsafe, unsafe_settings: FloatArray) -> SafeBox:
    """The largest safe box around an original vehicle that is safe itself.

    Parameters
    ----------
    columns
        The characteristics that vary.
    unsafe_settings
        Unsafe settings, shape (K, n); the box ends before all of them.

    Notes
    -----
    The search of a box simulates Sobol points and as many corners, where all changes add up. From unsafe settings the search goes back
    towards the original, and the box shrinks to end before the first unsafe setting on the way, until the search finds nothing unsafe.
    These settings determined the box, so they prove nothing about it.

    The box is then tested with settings drawn independently and uniformly in it, by a separate random generator. If any is unsafe,
    the box shrinks and is searched and tested again. Test k, k = 1, 2, ..., may be wrong with probability alpha_k = alpha / 2^k, alpha
    = 1 - `confidence`: if test k accepts, the bound is Clopper and Pearson's upper bound at confidence 1 - alpha_k for the share of the
    box that is unsafe or cannot be simulated. Box k depends on earlier samples alone, so given box k the bound fails with probability
    at most alpha_k; all tests together fail with probability sum alpha_k <= alpha, whichever of them accepts. Later tests draw more
    settings, so that the bound stays `MAX_UNSAFE_SHARE` if all of them can be simulated.
    """
    factor = min(1.0, STEP_BACK * float(np.min(_box_factors(evaluator, unsafe_settings), initial=np.inf)))
    attempt = 0
    for search in range(10**6):
        if factor < MIN_FACTOR:
            break
        for point_count in (FIRST_SEARCH_POINTS, SECOND_SEARCH_POINTS):
            sobol = sobol_points(point_count, len(columns), evaluator.study.search.seed + search)
            points = np.concatenate([sobol, np.round(sobol)])  # and corners
            unsafe_found, _ = _unsafe_in_box(evaluator, factor, _settings_in_box(evaluator, columns, factor, points), unsafe)
            if len(unsafe_found):
                break
        else:
            attempt += 1
            error_probability = (1 - CONFIDENCE) / 2**attempt
            samples = math.ceil(math.log(error_probability) / math.log1p(-MAX_UNSAFE_SHARE))
            settings = _random_settings(evaluator, columns, factor, samples, np.random.default_rng((evaluator.study.search.seed, attempt)))
            samples = len(settings)
            unsafe_found, failed = _unsafe_in_box(evaluator, factor, settings, unsafe)
            if not len(unsafe_found):
                unsafe_at_most = 1.0
                if failed < samples:
                    unsafe_at_most = float(scipy.stats.beta.ppf(1 - error_probability, failed + 1, samples - failed))
                return SafeBox(factor, CONFIDENCE, samples, failed, attempt, unsafe_at_most,
                               tuple(evaluator.characteristics.names[column] for column in columns))
        nearest = unsafe_found[np.argsort(_box_factors(evaluator, unsafe_found), kind="stable")[:MAX_LINES]]
        lines = [Line(evaluator.characteristics.original, end, 0.0) for end in nearest]
        shares = find_first_unsafe_shares(evaluator, lines, unsafe, "nearest unsafe settings")
        edge_settings = np.stack([line.settings_at(np.array([share]))[0] for line, share in zip(lines, shares, strict=True)])
        factor = min(factor, float(np.min(_box_factors(evaluator, edge_settings)))) * STEP_BACK
    return no_safe_box(evaluator, columns, attempt)


def _settings_in_box(evaluator: Evaluator, columns: Sequence[int], factor: float, points: FloatArray) -> FloatArray:
    """Settings in a box around the original, from points of the unit cube; shape (K, n)."""
    characteristics, indices = evaluator.characteristics, list(columns)
    lower = characteristics.original - factor * (characteristics.original - characteristics.lower)
    upper = characteristics.original + factor * (characteristics.upper - characteristics.original)
    settings = np.tile(characteristics.original, (len(points), 1))
    settings[:, indices] = lower[indices] + points * (upper - lower)[indices]
    return settings


def _random_settings(evaluator: Evaluator, columns: Sequence[int], factor: float, number: int, rng: np.random.Generator) -> FloatArray:
    """Feasible settings drawn uniformly in a box; fewer than `number` where hardly any is feasible."""
    return evaluator.region.draw_feasible(
        lambda count: _settings_in_box(evaluator, columns, factor, rng.random((count, len(columns)))), number)


def _unsafe_in_box(evaluator: Evaluator, factor: float, settings: FloatArray, unsafe: Unsafe) -> tuple[FloatArray, int]:
    """The unsafe settings, shape (K, n), and the number of feasible settings that could not be simulated."""
    evaluations = evaluator.evaluate(settings, f"all characteristics within {factor:.0%} of the domain")
    return settings[unsafe.of(evaluations)], int(np.count_nonzero(~evaluations.valid & ~evaluations.infeasible))


def _box_factors(evaluator: Evaluator, settings: FloatArray) -> FloatArray:
    """Factors of the boxes on whose surfaces K settings lie, shape (K,)."""
    characteristics = evaluator.characteristics
    change = settings - characteristics.original
    room = np.where(change < 0, characteristics.original - characteristics.lower, characteristics.upper - characteristics.original)
    return np.asarray(np.max(np.divide(np.abs(change), room, out=np.zeros_like(change), where=room > 0), axis=1, initial=0.0))
