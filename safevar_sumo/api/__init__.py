"""The public library, which `import safevar_sumo` re-exports, without the questions of `safevar_sumo.questions`;
the research questions are here, as tables and figures.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from safevar_sumo.api.evaluation import evaluate as evaluate
from safevar_sumo.api.running import run as run
from safevar_sumo.api.simulation import Simulation as Simulation, simulate as simulate
from safevar_sumo.questions.subject import Results as Results, load as load

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from safevar_sumo.questions.case import Case
    from safevar_sumo.questions.research_questions.answer import TableAnswer


class Tables(dict[str, "pd.DataFrame"]):
    """Answers by name, each a tidy frame over all results; a notebook shows them in the paper's layout."""

    def __init__(self, answers: list[TableAnswer]) -> None:
        super().__init__({answer.name: answer.frame for answer in answers})
        self.answers = answers

    @property
    def notes(self) -> dict[str, tuple[str, ...]]:
        """Notes by name: what is missing or left out, and why."""
        return {answer.name: answer.notes for answer in self.answers}

    def _repr_markdown_(self) -> str:
        from safevar_sumo.questions.research_questions.formats import as_markdown

        return as_markdown(self.answers)


class Figures(dict[str, "Figure"]):
    """Figures by name; `lacking` says why some could not be drawn."""

    lacking: tuple[str, ...] = ()


def tables(*results: Results | str | Path, question: str | None = None, algorithm: str = "") -> Tables:
    """Answer the research questions.

    Parameters
    ----------
    results
        Results, or their directories, one for each case in the tables.
    question
        Answer only this question, such as "rq1".
    algorithm
        The algorithm that RQ2 compares with all others; by default NSGA-II or, without it, the study's first.

    Returns
    -------
    Tables
        Frames by name; the functions in `safevar_sumo.questions` describe the columns.

    Raises
    ------
    InputError
        If there is no such question, or no results can answer it.
    """
    from safevar_sumo.questions.research_questions.answer import answer_questions

    return Tables(answer_questions(_load_cases(results), question, algorithm))


def figures(*results: Results | str | Path) -> Figures:
    """Draw every figure that the results hold.

    Parameters
    ----------
    results
        Results, or their directories.

    Returns
    -------
    Figures
        By name, such as "pareto-fronts"; with several results, the case's name comes first: "rain-pareto-fronts".

    Raises
    ------
    InputError
        If no figure can be drawn.
    """
    from safevar_sumo.questions.research_questions.figures import draw_figures

    figures_by_name, lacking = draw_figures(_load_cases(results))
    drawn_figures = Figures(figures_by_name)
    drawn_figures.lacking = tuple(lacking)
    return drawn_figures


def _load_cases(results: tuple[Results | str | Path, ...]) -> list[Case]:
    from safevar_sumo.questions.case import load_cases

    return load_cases([source.directory if isinstance(source, Results) else source for source in results])
