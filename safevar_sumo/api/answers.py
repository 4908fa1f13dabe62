"""The research questions answered, and their pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from safevar_sumo.api.results import Results

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from safevar_sumo.analysis import Answer, Case


class Tables(dict[str, "pd.DataFrame"]):
    """Answers by name, each a tidy frame over all results; a notebook shows them as the paper lays them out."""

    def __init__(self, answers: list[Answer]) -> None:
        super().__init__({one.name: one.frame for one in answers})
        self.answers = answers

    @property
    def notes(self) -> dict[str, tuple[str, ...]]:
        """By name, what a reader should know: what is missing or left out, and why."""
        return {one.name: one.notes for one in self.answers}

    def _repr_markdown_(self) -> str:
        from safevar_sumo.analysis.tables import markdown

        return markdown(self.answers)


class Figures(dict[str, "Figure"]):
    """Figures by name; `lacking` tells why some could not be drawn."""

    lacking: tuple[str, ...] = ()


def tables(*results: Results | str | Path, question: str | None = None) -> Tables:
    """Answer the research questions.

    Parameters
    ----------
    results
        Results, or their directories: one for each case that stands in the tables.
    question
        This question alone, such as "rq1".

    Returns
    -------
    Tables
        Frames by name; their columns are those of the functions in `safevar_sumo.analysis`.

    Raises
    ------
    InputError
        If there is no such question, or no results hold what it asks for.
    """
    from safevar_sumo.analysis import answer

    return Tables(answer(_cases(results), question))


def figures(*results: Results | str | Path) -> Figures:
    """Draw every figure that the results hold.

    Parameters
    ----------
    results
        Results, or their directories.

    Returns
    -------
    Figures
        By name, such as "pareto-fronts"; with several results, with the case's name in front: "rain-pareto-fronts".

    Raises
    ------
    InputError
        If none can be drawn.
    """
    from safevar_sumo.analysis import draw

    drawn, lacking = draw(_cases(results))
    found = Figures(drawn)
    found.lacking = tuple(lacking)
    return found


def _cases(results: tuple[Results | str | Path, ...]) -> list[Case]:
    from safevar_sumo.analysis import load_cases

    return load_cases([one.directory if isinstance(one, Results) else one for one in results])
