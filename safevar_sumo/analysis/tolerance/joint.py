"""Several characteristics together: the plane of every pair on a grid, and the largest safe box of all around the original."""

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
from safevar_sumo.analysis.explain.causes import Line, first_unsafe
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.vehicles import Characteristic

SIDE = 21
"""Number of values of each of the two characteristics, evenly spaced over its domain, ends included."""
PARTS, ROUNDS, SQUARES = 4, 4, 12
"""Search for the nearest unsafe setting: parts of a divided square's side, rounds of division (down to a 5120th of the domain), and maximum
number of squares divided per plane and round."""

_WEIGHT = np.outer(*[np.where(np.isin(np.arange(SIDE), (0, SIDE - 1)), 0.5, 1.0)] * 2)


@dataclass(frozen=True, kw_only=True)
class Pair:
    """The plane of two characteristics while all others are the original's.

    Attributes
    ----------
    values
        Values of both characteristics, shape (2, SIDE), each in its unit.
    safety_degree, unsafe, valid
        On the grid [m, or -m/s], shape (SIDE, SIDE), with the first characteristic on axis 0. A setting that is not valid could
        not be simulated, or is `infeasible`, and is neither safe nor unsafe.
    nearest
        The two values of the unsafe setting that is nearest to the original by distance in domain widths, exact to a 5120th of them; None
        if the grid has none. Unsafe settings that lie only between safe values of the grid are not found.
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
        simulated = np.sum(_WEIGHT * self.valid)
        return float(np.sum(_WEIGHT * self.unsafe) / simulated) if simulated else 0.0

    @property
    def not_simulated_share(self) -> float:
        """Share of the plane that could not be simulated, by the same rule."""
        return float(np.sum(_WEIGHT * (~self.valid & ~self.infeasible)) / np.sum(_WEIGHT))

    def to_dict(self) -> dict[str, Any]:
        """The entry of `pairs` in `tolerance --json`."""
        names = [member.name for member in self.characteristics]
        return {"characteristics": names, "unsafe_share": self.unsafe_share, "not_simulated_share": self.not_simulated_share,
                "nearest": None if self.nearest is None else dict(zip(names, self.nearest, strict=True))}


def planes(evaluator: Evaluator, columns: Sequence[int], unsafe: Unsafe) -> list[Pair]:
    """The plane of every pair of characteristics, with its nearest unsafe setting if it has one."""
    members, original = evaluator.characteristics.members, evaluator.characteristics.original
    chosen = list(combinations(columns, 2))
    axes = {column: np.linspace(members[column].lower, members[column].upper, SIDE) for column in columns}
    settings = np.tile(original, (len(chosen), SIDE, SIDE, 1))
    for group, (first, second) in zip(settings, chosen, strict=True):
        group[:, :, first], group[:, :, second] = axes[first][:, np.newaxis], axes[second]
    evaluations = evaluator.evaluate(settings.reshape(-1, len(original)), "two characteristics at a time")
    shape = (len(chosen), SIDE, SIDE)
    degrees, valid, infeasible = (values.reshape(shape) for values in (evaluations.f_safe, evaluations.valid, evaluations.infeasible))
    is_unsafe = unsafe.of(evaluations).reshape(shape)
    nearest = _nearest(evaluator, chosen, is_unsafe, unsafe)
    return [Pair(characteristics=(members[first], members[second]), values=np.stack([axes[first], axes[second]]), safety_degree=degrees[i],
                 unsafe=is_unsafe[i], valid=valid[i], infeasible=infeasible[i], nearest=nearest.get(i))
            for i, (first, second) in enumerate(chosen)]


def _nearest(evaluator: Evaluator, chosen: Sequence[tuple[int, int]], is_unsafe: BoolArray,
             unsafe: Unsafe) -> dict[int, tuple[float, float]]:
    """The unsafe setting nearest to the original, in widths of the domains, of every plane that has one.

    A branch and bound search: squares with an unsafe corner are divided into smaller ones, as long as a point in them is nearer than
    the nearest unsafe setting so far; each round divides the `SQUARES` nearest squares of each plane.
    """
    members = evaluator.characteristics
    columns = np.array(chosen, dtype=int).reshape(-1, 2)
    original, width = members.original[columns], (members.upper - members.lower)[columns]
    lower, size = members.lower[columns], width / (SIDE - 1)
    best, place = np.full(len(chosen), np.inf), np.zeros((len(chosen), 2))

    def improve(plane: npt.NDArray[np.intp], values: FloatArray) -> None:
        distances = np.sqrt(np.sum(((values - original[plane]) / width[plane]) ** 2, axis=1))
        for row in np.lexsort((distances, plane)):  # the nearest of each plane first
            if distances[row] < best[plane[row]]:
                best[plane[row]], place[plane[row]] = distances[row], values[row]

    plane, i, j = np.nonzero(is_unsafe)
    improve(plane, lower[plane] + np.stack([i, j], axis=1) * size[plane])
    plane_of, i, j = np.nonzero(_with_unsafe_corner(is_unsafe))  # the plane of every square, shape (K,)
    corner = lower[plane_of] + np.stack([i, j], axis=1) * size[plane_of]  # its lower corner, shape (K, 2)
    steps = np.stack(np.meshgrid(np.arange(PARTS + 1), np.arange(PARTS + 1), indexing="ij"), axis=-1).reshape(-1, 2)
    for _ in range(ROUNDS):
        beyond = corner - original[plane_of]
        gap = np.maximum(np.maximum(beyond, -beyond - size[plane_of]), 0.0)
        bound = np.sqrt(np.sum((gap / width[plane_of]) ** 2, axis=1))
        rows = np.flatnonzero(bound < best[plane_of])
        groups = [rows[plane_of[rows] == k] for k in np.unique(plane_of[rows])]
        kept = np.array([row for group in groups for row in group[np.argsort(bound[group], kind="stable")[:SQUARES]]], dtype=np.intp)
        if not len(kept):
            break
        plane_of, corner, size = plane_of[kept], corner[kept], size / PARTS
        plane = np.repeat(plane_of, len(steps))
        values = np.minimum(np.repeat(corner, len(steps), axis=0) + np.tile(steps, (len(kept), 1)) * size[plane], (lower + width)[plane])
        settings = np.tile(members.original, (len(values), 1))
        np.put_along_axis(settings, columns[plane], values, axis=1)
        hits = unsafe.of(evaluator.evaluate(settings, "nearest unsafe settings"))
        improve(plane[hits], values[hits])
        square, i, j = np.nonzero(_with_unsafe_corner(hits.reshape(len(kept), PARTS + 1, PARTS + 1)))
        plane_of, corner = plane_of[square], corner[square] + np.stack([i, j], axis=1) * size[plane_of[square]]
    return {int(k): (float(place[k, 0]), float(place[k, 1])) for k in np.flatnonzero(np.isfinite(best))}


def _with_unsafe_corner(grids: BoolArray) -> BoolArray:
    """Squares of grids, shape (K, S, S), that have an unsafe corner; shape (K, S - 1, S - 1)."""
    return np.asarray(grids[:, 1:, 1:] | grids[:, :-1, 1:] | grids[:, 1:, :-1] | grids[:, :-1, :-1])


UNSAFE_AT_MOST = 0.003
"""Share of a box that may be unsafe, with 95 % confidence, if every sampled setting is safe."""
PROBE, SEARCHED = 256, 1024
"""Number of Sobol points, and of corners, in the first search of a box, and in the second if the first has nothing unsafe."""
FOLLOWED = 16
"""Number of unsafe settings, the nearest ones, that are followed back towards the original."""
STEP_BACK = 0.999
"""The box ends at this share of the way to the nearest unsafe setting."""
SMALLEST = 1e-6
"""Smallest factor of a box; below it there is no safe box."""


class SafeBox(NamedTuple):
    """Within `factor` times the domain around the original, no setting of a random sample is unsafe.

    With `confidence`, at most `unsafe_at_most` of all settings in the box are unsafe or cannot be simulated: `failed` of the `samples`
    settings could not be simulated, and count as unsafe in that bound. `attempts` boxes were tested. Only `characteristics` vary, the
    others are the original's. If no box is safe, `factor` is 0 and the bound 1.
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


def no_box(evaluator: Evaluator, columns: Sequence[int], attempts: int = 0) -> SafeBox:
    """The result if the original vehicle itself is unsafe, or settings arbitrarily near to it are."""
    return SafeBox(0.0, CONFIDENCE, 0, 0, attempts, 1.0, tuple(evaluator.characteristics.names[column] for column in columns))


def safe_box(evaluator: Evaluator, columns: Sequence[int], unsafe: Unsafe, beyond: FloatArray) -> SafeBox:
    """The largest safe box around an original vehicle that is safe itself.

    Parameters
    ----------
    columns
        The characteristics that vary.
    beyond
        Unsafe settings, shape (K, n); the box ends before all of them.

    Notes
    -----
    A box is searched with Sobol points and with as many corners, where all changes add up. Unsafe points are followed back towards the
    original, and the box shrinks to end before them, until it has none. These points chose the box: they prove nothing about it.

    The box is then tested with settings drawn independently and uniformly in it, by a separate random generator. If one is unsafe,
    the box shrinks and is searched and tested again. Test k, k = 1, 2, ..., may be wrong with probability alpha_k = alpha / 2^k, alpha
    = 1 - `confidence`: if test k accepts, the bound is Clopper and Pearson's upper one at confidence 1 - alpha_k for the share of the
    box that is unsafe or cannot be simulated. Box k depends on earlier samples alone, so given box k the bound fails with probability
    alpha_k at the most; all tests together fail with probability sum alpha_k <= alpha, whichever of them accepts. Later tests draw more
    settings, so that the bound stays `UNSAFE_AT_MOST` if all of them can be simulated.
    """
    factor = min(1.0, STEP_BACK * float(np.min(_factor_reaching(evaluator, beyond), initial=np.inf)))
    attempt = 0
    for search in range(10**6):
        if factor < SMALLEST:
            break
        for number in (PROBE, SEARCHED):
            sobol = sobol_points(number, len(columns), evaluator.study.search.seed + search)
            points = np.concatenate([sobol, np.round(sobol)])  # and corners
            hits, _ = _unsafe_of(evaluator, factor, _in_box(evaluator, columns, factor, points), unsafe)
            if len(hits):
                break
        else:
            attempt += 1
            error = (1 - CONFIDENCE) / 2**attempt
            samples = math.ceil(math.log(error) / math.log1p(-UNSAFE_AT_MOST))
            settings = _drawn_in_box(evaluator, columns, factor, samples, np.random.default_rng((evaluator.study.search.seed, attempt)))
            samples = len(settings)
            hits, failed = _unsafe_of(evaluator, factor, settings, unsafe)
            if not len(hits):
                share = float(scipy.stats.beta.ppf(1 - error, failed + 1, samples - failed)) if failed < samples else 1.0
                return SafeBox(factor, CONFIDENCE, samples, failed, attempt, share,
                               tuple(evaluator.characteristics.names[column] for column in columns))
        near = hits[np.argsort(_factor_reaching(evaluator, hits), kind="stable")[:FOLLOWED]]
        lines = [Line(evaluator.characteristics.original, end, 0.0) for end in near]
        shares = first_unsafe(evaluator, lines, unsafe, "nearest unsafe settings")
        edge = np.stack([line.at(np.array([share]))[0] for line, share in zip(lines, shares, strict=True)])
        factor = min(factor, float(np.min(_factor_reaching(evaluator, edge)))) * STEP_BACK
    return no_box(evaluator, columns, attempt)


def _in_box(evaluator: Evaluator, columns: Sequence[int], factor: float, points: FloatArray) -> FloatArray:
    """Settings in a box around the original, from points of the unit cube; shape (K, n)."""
    members, indices = evaluator.characteristics, list(columns)
    lower = members.original - factor * (members.original - members.lower)
    upper = members.original + factor * (members.upper - members.original)
    settings = np.tile(members.original, (len(points), 1))
    settings[:, indices] = lower[indices] + points * (upper - lower)[indices]
    return settings


def _drawn_in_box(evaluator: Evaluator, columns: Sequence[int], factor: float, number: int, rng: np.random.Generator) -> FloatArray:
    """Feasible settings drawn uniformly in a box; fewer than `number` where hardly any is feasible."""
    return evaluator.region.sampled(lambda count: _in_box(evaluator, columns, factor, rng.random((count, len(columns)))), number)


def _unsafe_of(evaluator: Evaluator, factor: float, settings: FloatArray, unsafe: Unsafe) -> tuple[FloatArray, int]:
    """The unsafe settings, shape (K, n), and the number of feasible ones that could not be simulated."""
    evaluations = evaluator.evaluate(settings, f"all characteristics within {factor:.0%} of the domain")
    return settings[unsafe.of(evaluations)], int(np.count_nonzero(~evaluations.valid & ~evaluations.infeasible))


def _factor_reaching(evaluator: Evaluator, settings: FloatArray) -> FloatArray:
    """Factor of the box that has a setting on its surface, shape (K,)."""
    members = evaluator.characteristics
    change = settings - members.original
    largest = np.where(change < 0, members.original - members.lower, members.upper - members.original)
    return np.asarray(np.max(np.divide(np.abs(change), largest, out=np.zeros_like(change), where=largest > 0), axis=1, initial=0.0))
