"""Two characteristics together: the plane of their domains on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from safevar_sumo.analysis.criterion import Unsafe
from safevar_sumo.analysis.evaluator import Bench
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.vehicles import Characteristic

SIDE = 21
"""Values of each of the two, evenly spaced over its domain, ends included."""
FINER, ROUNDS, SQUARES = 4, 4, 12
"""Into how many parts a side of a square is divided on the way to the nearest unsafe setting, how often (to a 5120th of the domain), and
how many squares of a plane at a time."""

_WEIGHT = np.outer(*[np.where(np.isin(np.arange(SIDE), (0, SIDE - 1)), 0.5, 1.0)] * 2)


@dataclass(frozen=True, kw_only=True)
class Pair:
    """The plane of two characteristics while all others are the original's.

    Attributes
    ----------
    values
        Of either, shape (2, SIDE), in its unit.
    safety_degree, unsafe, valid
        On the grid, shape (SIDE, SIDE): the first characteristic down, the second across [m, or -m/s]. What is not valid could not be
        simulated and is neither safe nor unsafe.
    nearest
        The two values of the unsafe setting that is nearest to the original, in widths of the domains, to a 5120th of each; None if the
        grid has none. What is unsafe between safe values of the grid alone is not seen.
    """

    characteristics: tuple[Characteristic, Characteristic]
    values: FloatArray
    safety_degree: FloatArray
    unsafe: BoolArray
    valid: BoolArray
    nearest: tuple[float, float] | None

    @property
    def unsafe_share(self) -> float:
        """Share of the plane that is unsafe, of what could be simulated of it, by the trapezoidal rule."""
        simulated = np.sum(_WEIGHT * self.valid)
        return float(np.sum(_WEIGHT * self.unsafe) / simulated) if simulated else 0.0

    @property
    def not_simulated_share(self) -> float:
        """Share of the plane that could not be simulated, by the same rule."""
        return float(np.sum(_WEIGHT * ~self.valid) / np.sum(_WEIGHT))

    def record(self) -> dict[str, Any]:
        """As `tolerance --json` prints it."""
        names = [member.name for member in self.characteristics]
        return {"characteristics": names, "unsafe_share": self.unsafe_share, "not_simulated_share": self.not_simulated_share,
                "nearest": None if self.nearest is None else dict(zip(names, self.nearest, strict=True))}


def planes(bench: Bench, columns: Sequence[int], unsafe: Unsafe) -> list[Pair]:
    """Every pair of some characteristics; where one is unsafe, with its nearest unsafe setting."""
    members, original = bench.characteristics.members, bench.characteristics.original
    chosen = list(combinations(columns, 2))
    axes = {column: np.linspace(members[column].lower, members[column].upper, SIDE) for column in columns}
    settings = np.tile(original, (len(chosen), SIDE, SIDE, 1))
    for group, (first, second) in zip(settings, chosen, strict=True):
        group[:, :, first], group[:, :, second] = axes[first][:, np.newaxis], axes[second]
    evaluations = bench.evaluate(settings.reshape(-1, len(original)), "two characteristics at a time")
    shape = (len(chosen), SIDE, SIDE)
    degrees, valid = evaluations.f_safe.reshape(shape), evaluations.valid.reshape(shape)
    is_unsafe = unsafe.of(evaluations).reshape(shape)
    nearest = _nearest(bench, chosen, is_unsafe, unsafe)
    return [Pair(characteristics=(members[first], members[second]), values=np.stack([axes[first], axes[second]]), safety_degree=degrees[i],
                 unsafe=is_unsafe[i], valid=valid[i], nearest=nearest.get(i)) for i, (first, second) in enumerate(chosen)]


class _Squares(NamedTuple):
    """Squares of several planes: the plane's number, shape (K,), and both values of the lower corner, shape (K, 2)."""

    plane: npt.NDArray[np.intp]
    corner: FloatArray


def _nearest(bench: Bench, chosen: Sequence[tuple[int, int]], is_unsafe: BoolArray, unsafe: Unsafe) -> dict[int, tuple[float, float]]:
    """Of every plane that has one, the unsafe setting nearest to the original, in widths of the domains.

    A branch and bound search: squares with an unsafe corner are divided into smaller ones, as long as a place in them is nearer than
    the nearest unsafe setting that is known; of each plane the `SQUARES` nearest ones at a time.
    """
    members = bench.characteristics
    which = np.array(chosen, dtype=int).reshape(-1, 2)
    original, width = members.original[which], (members.upper - members.lower)[which]
    lower, size = members.lower[which], width / (SIDE - 1)
    best, place = np.full(len(chosen), np.inf), np.zeros((len(chosen), 2))

    def improve(plane: npt.NDArray[np.intp], values: FloatArray) -> None:
        distances = np.sqrt(np.sum(((values - original[plane]) / width[plane]) ** 2, axis=1))
        for row in np.lexsort((distances, plane)):  # of each plane the nearest first
            if distances[row] < best[plane[row]]:
                best[plane[row]], place[plane[row]] = distances[row], values[row]

    plane, i, j = np.nonzero(is_unsafe)
    improve(plane, lower[plane] + np.stack([i, j], axis=1) * size[plane])
    touched = is_unsafe[:, 1:, 1:] | is_unsafe[:, :-1, 1:] | is_unsafe[:, 1:, :-1] | is_unsafe[:, :-1, :-1]
    plane, i, j = np.nonzero(touched)
    squares = _Squares(plane, lower[plane] + np.stack([i, j], axis=1) * size[plane])
    for _ in range(ROUNDS):
        beyond = squares.corner - original[squares.plane]
        gap = np.maximum(np.maximum(beyond, -beyond - size[squares.plane]), 0.0)
        bound = np.sqrt(np.sum((gap / width[squares.plane]) ** 2, axis=1))
        kept = _first_of_each(squares.plane, bound, np.flatnonzero(bound < best[squares.plane]))
        squares = _Squares(squares.plane[kept], squares.corner[kept])
        if not len(kept):
            break
        steps = np.stack(np.meshgrid(np.arange(FINER + 1), np.arange(FINER + 1), indexing="ij"), axis=-1).reshape(-1, 2)
        size = size / FINER
        plane = np.repeat(squares.plane, len(steps))
        values = np.minimum(np.repeat(squares.corner, len(steps), axis=0) + np.tile(steps, (len(kept), 1)) * size[plane],
                            (lower + width)[plane])
        settings = np.tile(members.original, (len(values), 1))
        np.put_along_axis(settings, which[plane], values, axis=1)
        found = unsafe.of(bench.evaluate(settings, "nearest unsafe settings"))
        improve(plane[found], values[found])
        grid = found.reshape(len(kept), FINER + 1, FINER + 1)
        square, i, j = np.nonzero(grid[:, 1:, 1:] | grid[:, :-1, 1:] | grid[:, 1:, :-1] | grid[:, :-1, :-1])
        squares = _Squares(squares.plane[square], squares.corner[square] + np.stack([i, j], axis=1) * size[squares.plane[square]])
    return {int(k): (float(place[k, 0]), float(place[k, 1])) for k in np.flatnonzero(np.isfinite(best))}


def _first_of_each(plane: npt.NDArray[np.intp], bound: FloatArray, rows: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Of some rows, the `SQUARES` with the least bound of each plane."""
    kept: list[int] = []
    for number in np.unique(plane[rows]):
        group = rows[plane[rows] == number]
        kept += group[np.argsort(bound[group], kind="stable")[:SQUARES]].tolist()
    return np.array(kept, dtype=np.intp)
