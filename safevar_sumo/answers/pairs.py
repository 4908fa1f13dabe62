"""Two characteristics together: the plane of their domains on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from safevar_sumo.answers.bench import Bench
from safevar_sumo.answers.boundary import Line, first_unsafe
from safevar_sumo.answers.unsafe import Unsafe
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.vehicles import Characteristic

SIDE = 21
"""Values of each of the two, evenly spaced over its domain, ends included."""


@dataclass(frozen=True, kw_only=True)
class Pair:
    """The plane of two characteristics while all others are the original's.

    Attributes
    ----------
    values
        Of either, shape (2, SIDE), in its unit.
    safety_degree, unsafe
        On the grid, shape (SIDE, SIDE): the first characteristic down, the second across [m, or -m/s].
    nearest
        The two values of the unsafe setting that is nearest to the original, in widths of the domains; None if there is none.
    """

    characteristics: tuple[Characteristic, Characteristic]
    values: FloatArray
    safety_degree: FloatArray
    unsafe: BoolArray
    nearest: tuple[float, float] | None

    @property
    def unsafe_share(self) -> float:
        """Share of the plane that is unsafe, by the trapezoidal rule."""
        weight = np.ones(SIDE)
        weight[[0, -1]] = 0.5
        return float(np.sum(np.outer(weight, weight) * self.unsafe) / np.sum(weight) ** 2)

    def record(self) -> dict[str, Any]:
        """As `tolerance --json` prints it."""
        names = [member.name for member in self.characteristics]
        return {"characteristics": names, "unsafe_share": self.unsafe_share,
                "nearest": None if self.nearest is None else dict(zip(names, self.nearest, strict=True))}


def planes(bench: Bench, columns: Sequence[int], unsafe: Unsafe) -> list[Pair]:
    """Every pair of some characteristics; where one is unsafe, with its nearest unsafe setting."""
    members, original = bench.characteristics.members, bench.characteristics.original
    chosen = list(combinations(columns, 2))
    axes = {column: np.linspace(members[column].lower, members[column].upper, SIDE) for column in columns}
    settings = np.tile(original, (len(chosen), SIDE, SIDE, 1))
    for of_it, (first, second) in zip(settings, chosen, strict=True):
        of_it[:, :, first], of_it[:, :, second] = axes[first][:, np.newaxis], axes[second]
    evaluations = bench.evaluate(settings.reshape(-1, len(original)), "two characteristics at a time")
    degrees = evaluations.f_safe.reshape(len(chosen), SIDE, SIDE)
    is_unsafe = unsafe.of(evaluations).reshape(len(chosen), SIDE, SIDE)
    nearest = _nearest(bench, settings, is_unsafe, unsafe)
    return [Pair(characteristics=(members[first], members[second]), values=np.stack([axes[first], axes[second]]), safety_degree=degrees[i],
                 unsafe=is_unsafe[i], nearest=None if nearest[i] is None else (float(nearest[i][first]), float(nearest[i][second])))
            for i, (first, second) in enumerate(chosen)]


def _nearest(bench: Bench, settings: FloatArray, is_unsafe: BoolArray, unsafe: Unsafe) -> dict[int, Any]:
    """For every plane the unsafe setting nearest to the original: the nearest of the grid, taken back as far as it stays unsafe."""
    members = bench.characteristics
    distances = np.sum(((settings - members.original) / (members.upper - members.lower)) ** 2, axis=-1)
    distances = np.where(is_unsafe, distances, np.inf).reshape(len(settings), SIDE * SIDE)
    found = [i for i in range(len(settings)) if is_unsafe[i].any()]
    ends = [settings[i].reshape(-1, len(members))[np.argmin(distances[i])] for i in found]
    lines = [Line(members.original, end, 0.0) for end in ends]
    shares = first_unsafe(bench, lines, unsafe, "nearest unsafe settings")
    shrunk = {i: line.at(np.array([share]))[0] for i, line, share in zip(found, lines, shares, strict=True)}
    return {i: shrunk.get(i) for i in range(len(settings))}
