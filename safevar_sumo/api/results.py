"""Results of a study, read back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safevar_sumo.results import read_manifest
from safevar_sumo.study import Study

if TYPE_CHECKING:
    import pandas as pd

    from safevar_sumo.analysis import Case


@dataclass(frozen=True)
class Results:
    """What a results directory holds, finished or not.

    Attributes
    ----------
    directory
        Where it is.
    case
        The same as the research questions take it.
    """

    directory: Path
    case: Case

    @property
    def study(self) -> Study:
        """As it was run."""
        return self.case.study

    @cached_property
    def original(self) -> Mapping[str, Any]:
        """The original vehicle's outcome, metrics and objectives as plain values; what is undefined is None."""
        return dict(read_manifest(self.directory)["original"])

    @property
    def solutions(self) -> pd.DataFrame:
        """One row per solution of every finished run.

        Columns: algorithm, run (not of imported ones), the characteristics in their table units, f_safe [m or -m/s],
        f_diff [fraction], f_num_diff, the metrics in their units (NaN where undefined), outcome.
        """
        return self.case.solutions

    @property
    def evaluations(self) -> pd.DataFrame:
        """One row per simulated setting of every run, in the order in which the run asked; columns as of `solutions`."""
        return self.case.evaluations

    @property
    def finished(self) -> tuple[tuple[str, int], ...]:
        """Algorithm and number of every finished run."""
        return self.case.finished

    def __repr__(self) -> str:
        return f"<Results of {self.case.name} in {self.directory}: {len(self.finished)} runs, {len(self.solutions)} solutions>"


def load(directory: str | Path) -> Results:
    """Read a results directory as `run` or a command has left it, finished or not.

    Raises
    ------
    InputError
        If it is none, or a file in it is damaged.
    """
    from safevar_sumo.analysis import load_cases

    return Results(Path(directory), load_cases([directory])[0])
