"""Reads results as tables, without SUMO; and finds single solutions, by their handles or by a
choice such as `most_severe`.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import JsonObject
from safevar_sumo.results.journal import read_journal
from safevar_sumo.results.manifest import read_manifest
from safevar_sumo.results.store import (
    RunName,
    evaluations_frame,
    read_imported,
    solutions_frame,
    stored_journals,
)
from safevar_sumo.study import Study, convert_table

if TYPE_CHECKING:
    import pandas as pd


def failure_lines(failures: Sequence[tuple[str, str]]) -> list[str]:
    """A line for each distinct reason in `failures` (see `StoredResults.failures`): the first
    failure with this reason, and the number of further failures with the same reason.
    """
    firsts = {reason: place for place, reason in reversed(failures)}
    counts = Counter(reason for _, reason in failures)
    return [
        f"{firsts[reason]}: {reason} (and {count - 1} more)".removesuffix(
            " (and 0 more)"
        )
        for reason, count in counts.items()
    ]


class StoredResults(NamedTuple):
    """The contents of a results directory.

    Attributes
    ----------
    manifest
        The study as run, versions, seed, the original vehicle's evaluation.
    evaluations
        One row per simulated setting of every run, in the order of the first requests; columns of
        `safevar_sumo.results.evaluations_frame`, and `evaluation`, the position in that order from
        0.
    solutions
        One row per solution of every finished run; the same columns except `evaluation`. Imported
        solutions belong to no run.
    finished
        Algorithm and number of every finished run.
    failures
        For every setting that could not be simulated, the run with its position in the run (from
        0), and the reason.
    """

    manifest: JsonObject
    evaluations: pd.DataFrame
    solutions: pd.DataFrame
    finished: tuple[RunName, ...] = ()
    failures: tuple[tuple[str, str], ...] = ()


def load_runs(directory: str | Path) -> StoredResults:
    """Read the runs and evaluations of a results directory's study, which may be unfinished.

    Raises
    ------
    InputError
        If the directory holds no results, or a file in it is damaged or belongs to another study.
    """
    # Imported solutions have no journals.
    folder = Path(directory)
    manifest = read_manifest(folder)
    study = convert_table(manifest["study"], Study)
    characteristics = list(study.domains)
    if "imported" in manifest:
        return StoredResults(
            manifest,
            evaluations_frame(characteristics, []).assign(evaluation=0),
            read_imported(folder, characteristics),
        )

    evaluations_of_runs = []
    solutions_of_runs = []
    all_positions = []
    failures = []
    budget = study.search.evaluations
    for key, path, head in stored_journals(folder, manifest):
        content = read_journal(path, head)
        positions, evaluations = content.requested_within(budget)
        evaluations_of_runs.append((key, evaluations))
        all_positions += positions
        for row in np.flatnonzero(evaluations.failed).tolist():
            place = f"{key[0]}:{key[1]}, evaluation {positions[row]}"
            failures.append((place, evaluations.reason(row)))
        if budget in content.solutions:
            solutions_of_runs.append(
                (key, content.take_positions(content.solutions[budget]))
            )

    # Both lists have the order of the runs, so that rows of the frame and positions match.
    frame = evaluations_frame(characteristics, evaluations_of_runs)
    frame.insert(2, "evaluation", all_positions)
    return StoredResults(
        manifest,
        frame,
        solutions_frame(characteristics, solutions_of_runs),
        tuple(dict(solutions_of_runs)),
        tuple(failures),
    )


HANDLE_FORMAT = "ALGORITHM:RUN:N, the N-th row of that run in solutions.csv, from 0"
MAX_EXAMPLES = 6
"""Largest number of handles that an error names."""


class SolutionId(NamedTuple):
    """The handle of a solution: the `row`-th of its run's solutions in the order of solutions.csv,
    from 0.

    Imported solutions belong to no run; their run number is 0.
    """

    algorithm: str
    run: int
    row: int

    def __str__(self) -> str:
        return f"{self.algorithm}:{self.run}:{self.row}"

    @classmethod
    def parse(cls, text: str) -> SolutionId:
        """Read a handle.

        Raises
        ------
        InputError
            If the text is no handle.
        """
        match = re.fullmatch(r"([^:]+):([0-9]{1,9}):([0-9]{1,9})", text)
        if match is None:
            raise InputError("solution", repr(text), HANDLE_FORMAT)
        return cls(match[1], int(match[2]), int(match[3]))


def handles_of(solutions: pd.DataFrame) -> list[SolutionId]:
    """The handle of every row of `solutions`, a frame of solutions from
    `safevar_sumo.results.load_runs`.
    """
    import pandas as pd

    runs = solutions.get("run", pd.Series(0, index=solutions.index))
    rows = solutions.groupby([solutions["algorithm"], runs], sort=False).cumcount()
    return [
        SolutionId(algorithm, run, row)
        for algorithm, run, row in zip(solutions["algorithm"], runs, rows, strict=True)
    ]


def row_of_handle(solutions: pd.DataFrame, handle: SolutionId) -> int:
    """The row number, in the frame, of the solution with this handle.

    Raises
    ------
    InputError
        If there is no such solution.
    """
    all_handles = handles_of(solutions)
    if handle in all_handles:
        return all_handles.index(handle)
    # The dictionary keeps the last handle of each run: it shows how many solutions the run has.
    last_handles = {solution[:2]: str(solution) for solution in all_handles}
    examples = ", ".join(list(last_handles.values())[:MAX_EXAMPLES])
    raise InputError(
        "solution",
        f"there is no solution {handle}",
        f"{HANDLE_FORMAT}; the last ones are {examples}",
    )


CHOICES = {
    "most_severe": ["f_safe", "f_num_diff", "f_diff"],
    "fewest": ["f_num_diff", "f_safe", "f_diff"],
    "smallest": ["f_diff", "f_safe", "f_num_diff"],
}
"""Objectives by which a choice ranks solutions, the most important first: the solution with the
smallest values is chosen.
"""


def choose_handle(solutions: pd.DataFrame, unsafe: Unsafe, choice: str) -> SolutionId:
    """The handle of the solution that a choice selects. `most_severe` selects among all solutions,
    any other choice among the unsafe solutions.

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
    table = solutions.reset_index(drop=True)
    candidates = table
    if choice != "most_severe":
        candidates = table[unsafe.rows(table)]
    if candidates.empty:
        problem = "these results hold no unsafe solution"
        if table.empty:
            problem = "these results hold no solution"
        raise InputError(
            "",
            problem,
            "other results, the most severe solution, or a solution by its handle",
        )
    position = candidates.sort_values(CHOICES[choice], kind="stable").index[0]
    return handles_of(table)[int(position)]
