"""The research questions answered, and their pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from safevar_sumo.analysis.explain.options import ExplainOptions
from safevar_sumo.analysis.risk.options import RiskOptions
from safevar_sumo.analysis.rules.options import RulesOptions
from safevar_sumo.api.results import Results, study_of, study_or_case
from safevar_sumo.study import StudyLike

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from safevar_sumo.analysis.explain.result import Explained
    from safevar_sumo.analysis.research_questions.answer import Answer
    from safevar_sumo.analysis.research_questions.case import Case
    from safevar_sumo.analysis.risk.compute import Risk
    from safevar_sumo.analysis.rules.compute import Rules
    from safevar_sumo.analysis.tolerance.compute import Tolerance
    from safevar_sumo.workers.evaluation import Pool


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
        from safevar_sumo.analysis.research_questions.tables import markdown

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
    from safevar_sumo.analysis.research_questions.answer import answer

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
    from safevar_sumo.analysis.research_questions.figures import draw

    drawn, lacking = draw(_cases(results))
    found = Figures(drawn)
    found.lacking = tuple(lacking)
    return found


def _cases(results: tuple[Results | str | Path, ...]) -> list[Case]:
    from safevar_sumo.analysis.research_questions.case import load_cases

    return load_cases([one.directory if isinstance(one, Results) else one for one in results])


def explain(source: StudyLike | Results, *, solutions: Sequence[str] = (), unsafe: str | None = None, top: int = ExplainOptions.top,
            limit: int = ExplainOptions.limit, pool: Pool | None = None, jobs: int | None = None,
            as_it_is_now: bool = False) -> Explained:
    """Explain failures: minimal causes, their boundaries, why, and whether they are robust.

    Parameters
    ----------
    source
        Results or their directory, whose solutions are explained; or a study, of which failures all over the domain are.
    solutions
        Handles of solutions, such as "nsga2:3:0"; by default the failures that matter.
    unsafe
        "collision" or "below=X"; by default a collision if there is one, else half of the original's safety degree.
    top
        How many failures are explained in full at the most.
    limit
        Simulations, about, that the minimal causes of all failures may take; of more failures a random sample is looked into.
    pool, jobs
        Where to simulate: a pool, or that many worker processes, by default one for each core.
    as_it_is_now
        Simulate with what is there now if results were computed with something else, and warn; by default that is refused.

    Raises
    ------
    InputError
        If something that is asked for is not there or cannot be used, or has changed since the results were computed.
    """
    from safevar_sumo.analysis.explain.compute import explain_failures

    subject = study_or_case(source, as_it_is_now=as_it_is_now)
    return explain_failures(subject, solutions=solutions, unsafe=unsafe, top=top, limit=limit, pool=pool, jobs=jobs)


def tolerance(study: StudyLike | Results, *, unsafe: str | None = None, characteristics: Sequence[str] | None = None, pairs: bool = False,
              pool: Pool | None = None, jobs: int | None = None,
              as_it_is_now: bool = False) -> Tolerance:
    """How far characteristics may go: each alone, with `pairs` two together, and all together. Otherwise as `explain`."""
    from safevar_sumo.analysis.tolerance.compute import find_tolerances

    subject = study_of(study, as_it_is_now=as_it_is_now)
    return find_tolerances(subject, unsafe=unsafe, characteristics=characteristics, pairs=pairs, pool=pool, jobs=jobs)


def risk(study: StudyLike | Results, *, samples: int = RiskOptions.samples, confidence: float = RiskOptions.confidence,
         width: float | None = None, unsafe: str | None = None, pool: Pool | None = None, jobs: int | None = None,
         as_it_is_now: bool = False) -> Risk:
    """How likely an unsafe outcome is when vehicles vary as the study says, and what decides.

    At most `samples` vehicles are drawn, fewer if the interval of the probability is no wider than `width` before.
    Otherwise as `explain`.
    """
    from safevar_sumo.analysis.risk.compute import estimate_risk

    subject = study_of(study, as_it_is_now=as_it_is_now)
    return estimate_risk(subject, samples=samples, confidence=confidence, width=width, unsafe=unsafe, pool=pool, jobs=jobs)


def rules(study: StudyLike | Results, *, samples: int = RulesOptions.samples, unsafe: str | None = None, pool: Pool | None = None,
          jobs: int | None = None, as_it_is_now: bool = False) -> Rules:
    """Rules that tell where it is unsafe, from `samples` settings spread over the whole domain. Otherwise as `explain`."""
    from safevar_sumo.analysis.rules.compute import find_rules

    subject = study_of(study, as_it_is_now=as_it_is_now)
    return find_rules(subject, samples=samples, unsafe=unsafe, pool=pool, jobs=jobs)
