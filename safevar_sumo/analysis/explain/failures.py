"""Which settings there are to explain: solutions of results, or settings all over the domain of a study without any."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.criterion import Unsafe, spread
from safevar_sumo.analysis.evaluator import Bench
from safevar_sumo.analysis.explain.braking_comparison import BrakingComparison, compare, course
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.errors import InputError
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import CHOICES, UNKNOWN, SolutionId, handles, position_of
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import AtPoint, at_every_point, worst_points
from safevar_sumo.sumo.system import System

LOOKED_AT = 4096
"""Settings over the whole domain in which the failures of a study without results are looked for."""


class Failures(NamedTuple):
    """Settings looked at, as they are evaluated today.

    Attributes
    ----------
    evaluations
        Of filtered settings; solutions of several runs that are the same setting are there once.
    handles
        What they are called as solutions; None for what did not come from results.
    unsafe
        What counts as unsafe.
    rows
        Those to explain: the unsafe ones, or the ones asked for by name.
    otherwise
        How many of them do not end as the results say.
    """

    evaluations: Evaluations
    handles: list[SolutionId | None]
    unsafe: Unsafe
    rows: list[int]
    otherwise: int

    def least(self, choice: str) -> int:
        """The row asked for by a name of `CHOICES`: fewest, smallest or most_severe."""
        among = self.evaluations.take(self.rows)
        return self.rows[int(np.lexsort([getattr(among, name) for name in reversed(CHOICES[choice])])[0])]


def failures_of(source: Study | Case, bench: Bench, original: Evaluations, named: Sequence[SolutionId], unsafe: Unsafe | None) -> Failures:
    """Look at all solutions of results and evaluate them, or at settings all over a study's domain.

    Raises
    ------
    InputError
        If `named` holds what is no solution of the results.
    """
    if isinstance(source, Study):
        if named:
            raise InputError("solution", f"{source.name!r} is a study and has no solutions", "a results directory")
        settings = bench.characteristics.filter(spread(bench.characteristics, LOOKED_AT, source.search.seed))
        called: list[SolutionId | None] = [None] * len(settings)
        recorded = None
        rows = None
    else:
        solutions = source.solutions
        every, whole = handles(solutions), solutions[list(bench.characteristics.names)].to_numpy(dtype=float)
        asked = list(dict.fromkeys(position_of(solutions, handle) for handle in named))
        kept = [*asked, *(row for row in _each_once(whole) if row not in set(asked))]
        settings, called = whole[kept], [every[row] for row in kept]
        recorded = solutions["outcome"].to_numpy(dtype=str)[kept]
        rows = list(range(len(asked))) if named else None
    evaluations = bench.evaluate(settings, "settings to explain")
    means = unsafe or Unsafe.usual(evaluations, original)
    if rows is None:
        rows = np.flatnonzero(means.of(evaluations)).tolist()
    otherwise = 0 if recorded is None else int(np.count_nonzero((evaluations.outcome != recorded) & (recorded != UNKNOWN)))
    return Failures(evaluations, called, means, rows, otherwise)


def _each_once(settings: np.ndarray) -> list[int]:
    """The first row of every distinct setting, in their order."""
    return sorted(np.unique(settings, axis=0, return_index=True)[1].tolist())


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
