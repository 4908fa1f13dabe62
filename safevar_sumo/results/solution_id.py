"""Handles, `ALGORITHM:RUN:N`, which identify solutions; and the choice of a solution by its severity or size."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import RATING_POINTS, Unsafe

if TYPE_CHECKING:
    import pandas as pd

HANDLE_FORMAT = "ALGORITHM:RUN:N, the N-th row of that run in solutions.csv, from 0"


class SolutionId(NamedTuple):
    """The handle of a solution: the `row`-th of its run's solutions in the order of solutions.csv, from 0.

    Imported solutions belong to no run; their run number is 0.
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
        algorithm, _, remainder = text.partition(":")
        run, _, row = remainder.partition(":")
        if not (
            algorithm and all(number.isascii() and number.isdecimal() and len(number) < 10 for number in (run, row))
        ):
            raise InputError(source, repr(text), HANDLE_FORMAT)
        return cls(algorithm, int(run), int(row))


def handles_of(solutions: pd.DataFrame) -> list[SolutionId]:
    """The handle of every row of `solutions`, a frame of solutions from `safevar_sumo.results.load_runs`."""
    import pandas as pd

    runs = solutions["run"] if "run" in solutions else pd.Series(0, index=solutions.index)
    rows = solutions.groupby([solutions["algorithm"], runs], sort=False).cumcount()
    return [
        SolutionId(str(algorithm), int(run), int(row))
        for algorithm, run, row in zip(solutions["algorithm"], runs, rows, strict=True)
    ]


def row_of_handle(solutions: pd.DataFrame, handle: SolutionId, source: object = "solution") -> int:
    """The row number, in the frame, of the solution with this handle.

    Raises
    ------
    InputError
        If there is no such solution.
    """
    all_handles = handles_of(solutions)
    if handle in all_handles:
        return all_handles.index(handle)
    last_rows = {(other.algorithm, other.run): other.row for other in all_handles}
    if (handle.algorithm, handle.run) in last_rows:
        expected = f"N from 0 to {last_rows[handle.algorithm, handle.run]}"
    else:
        runs = [f"{algorithm}:{run}" for algorithm, run in last_rows]
        expected = (
            f"a run with solutions: {', '.join(runs[:6])}{', ...' if len(runs) > 6 else ''}"
            if runs
            else "results with a solution"
        )
    raise InputError(source, f"there is no solution {handle}", expected)


CHOICES = {
    "most_severe": ["f_safe", "f_num_diff", "f_diff"],
    "fewest": ["f_num_diff", "f_safe", "f_diff"],
    "smallest": ["f_diff", "f_safe", "f_num_diff"],
    "most_points": [RATING_POINTS.name, "f_num_diff", "f_diff"],
}
"""Objectives that decide a choice, in order; smaller values first."""


def choose_handle(solutions: pd.DataFrame, unsafe: Unsafe, choice: str, source: object) -> SolutionId:
    """The handle of the solution that a choice selects: `most_severe` among all solutions, any other choice among the
    unsafe ones.

    Parameters
    ----------
    unsafe
        The criterion for unsafe.
    choice
        A name of `CHOICES`.

    Raises
    ------
    InputError
        If there is no such solution.
    """
    table = solutions.assign(handle=list(map(str, handles_of(solutions))))
    candidates = table if choice == "most_severe" else table[unsafe.rows(table)]
    if candidates.empty:
        if table.empty:
            raise InputError(source, "these results hold no solution", "results with a solution")
        raise InputError(
            source, "these results hold no unsafe solution", "the most severe one, or a solution by its handle"
        )
    return SolutionId.parse(candidates.sort_values(CHOICES[choice], kind="stable")["handle"].iloc[0], source)
