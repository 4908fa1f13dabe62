"""Identifiers of solutions, `ALGORITHM:RUN:N`, and the choice of a solution by its severity or size."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import RATING_POINTS, Unsafe

if TYPE_CHECKING:
    import pandas as pd

LEGAL = "ALGORITHM:RUN:N, the N-th row of that run in solutions.csv, from 0"


class SolutionId(NamedTuple):
    """One solution: the `row`-th of a run's solutions in the order of solutions.csv, from 0.

    Imported solutions belong to no run; theirs count as run 0.
    """

    algorithm: str
    run: int
    row: int

    def __str__(self) -> str:
        return f"{self.algorithm}:{self.run}:{self.row}"

    @classmethod
    def parse(cls, text: str, source: object = "solution") -> SolutionId:
        """Read a handle.

        Raises
        ------
        InputError
            If the text is no handle.
        """
        algorithm, _, rest = text.partition(":")
        run, _, row = rest.partition(":")
        if not (algorithm and all(number.isascii() and number.isdecimal() and len(number) < 10 for number in (run, row))):
            raise InputError(source, repr(text), LEGAL)
        return cls(algorithm, int(run), int(row))


def handles(solutions: pd.DataFrame) -> list[SolutionId]:
    """The handle of every row of a frame of solutions, as `safevar_sumo.results.load_runs` gives it."""
    import pandas as pd

    run = solutions["run"] if "run" in solutions else pd.Series(0, index=solutions.index)
    row = solutions.groupby([solutions["algorithm"], run], sort=False).cumcount()
    return [SolutionId(str(algorithm), int(number), int(place))
            for algorithm, number, place in zip(solutions["algorithm"], run, row, strict=True)]


def position_of(solutions: pd.DataFrame, handle: SolutionId, source: object = "solution") -> int:
    """The row of a handle's solution in the frame.

    Raises
    ------
    InputError
        If there is no such solution.
    """
    all_handles = handles(solutions)
    if handle in all_handles:
        return all_handles.index(handle)
    last = {(other.algorithm, other.run): other.row for other in all_handles}
    if (handle.algorithm, handle.run) in last:
        legal = f"N from 0 to {last[handle.algorithm, handle.run]}"
    else:
        runs = [f"{algorithm}:{run}" for algorithm, run in last]
        legal = f"a run with solutions: {', '.join(runs[:6])}{', ...' if len(runs) > 6 else ''}" if runs else "results with a solution"
    raise InputError(source, f"there is no solution {handle}", legal)


CHOICES = {
    "most_severe": ["f_safe", "f_num_diff", "f_diff"],
    "fewest": ["f_num_diff", "f_safe", "f_diff"],
    "smallest": ["f_diff", "f_safe", "f_num_diff"],
    "most_points": [RATING_POINTS.name, "f_num_diff", "f_diff"],
}
"""Objectives that decide a choice, in order; smaller values first."""


def chosen_handle(solutions: pd.DataFrame, unsafe: Unsafe, choice: str, source: object) -> SolutionId:
    """The most severe of all solutions, or the unsafe one with the fewest or the smallest changes.

    Parameters
    ----------
    unsafe
        The criterion.
    choice
        A name of `CHOICES`.

    Raises
    ------
    InputError
        If there is no such solution.
    """
    named = solutions.assign(handle=list(map(str, handles(solutions))))
    candidates = named if choice == "most_severe" else named[unsafe.rows(named)]
    if candidates.empty:
        if named.empty:
            raise InputError(source, "these results hold no solution", "results with a solution")
        raise InputError(source, "these results hold no unsafe solution", "the most severe one, or a solution by its handle")
    return SolutionId.parse(candidates.sort_values(CHOICES[choice], kind="stable")["handle"].iloc[0], source)
