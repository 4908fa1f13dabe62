"""Two characteristics together: a grid in the plane of every pair, and the plane's unsafe setting nearest to the original."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

from safevar_sumo.analysis.evaluator import Evaluator
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
