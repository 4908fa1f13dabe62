"""Where a failure fails: at which points of a study, and beside the original's drive at the one where it comes off worst."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.answers.braking_comparison import BrakingComparison, compare, course
from safevar_sumo.answers.unsafe import Unsafe
from safevar_sumo.records import FloatArray
from safevar_sumo.simulation import AtPoint, System, at_every_point, worst_points

NAMED = 6
"""How many of the points that fail are named in a sentence."""


class Where(NamedTuple):
    """A failure at the points of a study.

    Attributes
    ----------
    because
        Original and failure side by side at the point at which the failure comes off worst.
    points
        Names of the points of a matrix at which it is unsafe, in the study's order.
    """

    because: BrakingComparison
    points: tuple[str, ...]


def where(system: System, original: FloatArray, settings: FloatArray, unsafe: Unsafe) -> tuple[list[Where], float]:
    """Settings, shape (M, n), beside the original, shape (1, n); and the time step that they were simulated with [s]."""
    found = at_every_point(system, np.concatenate([original, settings]))
    names, worst = points_of(system, found, unsafe)[1:], worst_points(found)[1:]
    told = []
    for row, (failing, at) in enumerate(zip(names, worst.tolist(), strict=True), 1):
        one = found[at]
        first, other = (course(one.drives, column, float(one.evaluations.f_safe[column])) for column in (0, row))
        told.append(Where(compare(first, other, one.point.name), failing))
    return told, found[0].drives.trace.step


def points_of(system: System, found: list[AtPoint], unsafe: Unsafe) -> list[tuple[str, ...]]:
    """For every setting the names of a matrix's points at which it is unsafe; none of a study without one."""
    if not system.matrix:
        return [() for _ in found[0].evaluations.settings]
    at = np.stack([unsafe.of(one.evaluations) for one in found])
    return [tuple(one.point.name for one, is_unsafe in zip(found, column, strict=True) if is_unsafe) for column in at.T]


def points_in_words(points: tuple[str, ...], number: int, most: int = NAMED) -> str:
    """Such as `Fails at 2 of 72 points: CPNA, speed 40, impact_location 25, night; CPLA, speed 60, clear.`"""
    first, more = "; ".join(points[:most]), len(points) - most
    others = f" and {more} more" if more > 0 else ""
    return f"Fails at {len(points)} of {number} points{': ' + first if points else ''}{others}."
