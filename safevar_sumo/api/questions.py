"""The research questions answered, and their pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.options import Options
from safevar_sumo.analysis.risk import RiskOptions
from safevar_sumo.analysis.rules import RulesOptions
from safevar_sumo.analysis.tolerance import ToleranceOptions
from safevar_sumo.api.results import Results, study_of, study_or_case
from safevar_sumo.progress import shown
from safevar_sumo.study import Study, StudyLike

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from safevar_sumo.analysis.criterion import Criterion
    from safevar_sumo.analysis.evaluator import Progress
    from safevar_sumo.analysis.explain.result import Explained
    from safevar_sumo.analysis.research_questions.answer import Answer
    from safevar_sumo.analysis.research_questions.case import Case
    from safevar_sumo.analysis.risk.compute import Risk
    from safevar_sumo.analysis.rules.compute import Rules
    from safevar_sumo.analysis.tolerance.compute import Tolerance
    from safevar_sumo.workers.evaluation import Pool


T = TypeVar("T")


class Tables(dict[str, "pd.DataFrame"]):
    """Answers by name, each a tidy frame over all results; a notebook shows them in the paper's layout."""

    def __init__(self, answers: list[Answer]) -> None:
        super().__init__({answer.name: answer.frame for answer in answers})
        self.answers = answers

    @property
    def notes(self) -> dict[str, tuple[str, ...]]:
        """By name, notes on what is missing or left out, and why."""
        return {answer.name: answer.notes for answer in self.answers}

    def _repr_markdown_(self) -> str:
        from safevar_sumo.analysis.research_questions.tables import markdown

        return markdown(self.answers)


class Figures(dict[str, "Figure"]):
    """Figures by name; `lacking` says why some could not be drawn."""

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
    result = Figures(drawn)
    result.lacking = tuple(lacking)
    return result


def _cases(results: tuple[Results | str | Path, ...]) -> list[Case]:
    from safevar_sumo.analysis.research_questions.case import load_cases

    return load_cases([item.directory if isinstance(item, Results) else item for item in results])


def explain(source: StudyLike | Results, *, solutions: Sequence[str] = ExplainOptions.solutions, unsafe: Criterion | None = None,
            top: int = ExplainOptions.top, limit: int = ExplainOptions.limit, pool: Pool | None = None, jobs: int | None = None,
            progress: bool | Progress = False, as_it_is_now: bool = False) -> Explained:
    """Explain failures: minimal causes, their boundaries, why, and whether they are robust.

    Parameters
    ----------
    source
        Results or their directory, whose solutions are explained; or a study, of which failures all over the domain are.
    solutions
        Handles of solutions, such as "nsga2:3:0"; by default the robust failure with the fewest changes, those with the fewest and
        the smallest changes, the most severe one, and one of each distinct minimal cause, the most frequent first.
    unsafe
        "collision", or a number X for a safety degree below X [m, or minus a collision's speed in m/s]; by default a collision if
        any setting that is looked at is one, else half of the original's safety degree.
    top
        How many failures are explained in full at the most.
    limit
        Simulations, about, that the minimal causes of all failures may take; of more failures a random sample is looked into.
    pool
        Where to simulate, if not in worker processes of its own.
    jobs
        Worker processes, by default one for each core.
    progress
        True for a bar on the terminal, or a function called with the stage, how many settings are done, and how many there are.
    as_it_is_now
        Simulate with what is there now if results were computed with something else, and warn; by default that is refused.

    Raises
    ------
    InputError
        If something that is asked for is not there or cannot be used, or has changed since the results were computed.
    """
    from safevar_sumo.analysis.explain.compute import explain_failures

    options = ExplainOptions(solutions=tuple(solutions), unsafe=_text(unsafe), top=top, limit=limit)
    return _asked(explain_failures, study_or_case(source, as_it_is_now=as_it_is_now), options, pool, jobs, progress)


def tolerance(study: StudyLike | Results, *, unsafe: Criterion | None = None, characteristics: Sequence[str] | None = None,
              pairs: bool = ToleranceOptions.pairs, pool: Pool | None = None, jobs: int | None = None, progress: bool | Progress = False,
              as_it_is_now: bool = False) -> Tolerance:
    """Find how far characteristics may go: each alone, with `pairs` two together, and all together.

    Parameters
    ----------
    study
        A study, or results or their directory, whose study is asked about.
    unsafe
        "collision", or a number X for a safety degree below X [m, or minus a collision's speed in m/s]; by default a collision if
        any of many settings all over the domain is one, else half of the original's safety degree.
    characteristics
        Which ones vary, by default all: alone, in pairs, and together in the joint box; the others are the original's.
    pairs
        Whether pairs are looked at too.
    pool
        Where to simulate, if not in worker processes of its own.
    jobs
        Worker processes, by default one for each core.
    progress
        True for a bar on the terminal, or a function called with the stage, how many settings are done, and how many there are.
    as_it_is_now
        Simulate with what is there now if results were computed with something else, and warn; by default that is refused.

    Raises
    ------
    InputError
        If something that is asked for is not there or cannot be used, or has changed since the results were computed.
    """
    from safevar_sumo.analysis.tolerance.compute import find_tolerances

    names = None if characteristics is None else tuple(characteristics)
    options = ToleranceOptions(unsafe=_text(unsafe), characteristics=names, pairs=pairs)
    return _asked(find_tolerances, study_of(study, as_it_is_now=as_it_is_now), options, pool, jobs, progress)


def risk(study: StudyLike | Results, *, samples: int = RiskOptions.samples, confidence: float = RiskOptions.confidence,
         width: float | None = RiskOptions.width, unsafe: Criterion | None = None, pool: Pool | None = None, jobs: int | None = None,
         progress: bool | Progress = False, as_it_is_now: bool = False) -> Risk:
    """Estimate how likely an unsafe outcome is when vehicles vary as the study says, and which characteristic decides.

    Parameters
    ----------
    study
        A study, or results or their directory, whose study is asked about.
    samples
        Vehicles to draw at the most.
    confidence
        Of the intervals, between 0 and 1.
    width
        Stop as soon as the interval of the probability is no wider.
    unsafe
        "collision", or a number X for a safety degree below X [m, or minus a collision's speed in m/s]; by default a collision if
        any of many settings all over the domain is one, else half of the original's safety degree.
    pool
        Where to simulate, if not in worker processes of its own.
    jobs
        Worker processes, by default one for each core.
    progress
        True for a bar on the terminal, or a function called with the stage, how many settings are done, and how many there are.
    as_it_is_now
        Simulate with what is there now if results were computed with something else, and warn; by default that is refused.

    Raises
    ------
    InputError
        If something that is asked for is not there or cannot be used, or has changed since the results were computed.
    SimulationError
        If no vehicle can be simulated.
    """
    from safevar_sumo.analysis.risk.compute import estimate_risk

    options = RiskOptions(samples=samples, confidence=confidence, width=width, unsafe=_text(unsafe))
    return _asked(estimate_risk, study_of(study, as_it_is_now=as_it_is_now), options, pool, jobs, progress)


def rules(study: StudyLike | Results, *, samples: int = RulesOptions.samples, unsafe: Criterion | None = None, pool: Pool | None = None,
          jobs: int | None = None, progress: bool | Progress = False, as_it_is_now: bool = False) -> Rules:
    """Find rules in physical units that say where a study is unsafe.

    Parameters
    ----------
    study
        A study, or results or their directory, whose study is asked about.
    samples
        Settings spread over the whole domain: half of them make the rules, the other half judges them.
    unsafe
        "collision", or a number X for a safety degree below X [m, or minus a collision's speed in m/s]; by default a collision if
        any of many settings all over the domain is one, else half of the original's safety degree.
    pool
        Where to simulate, if not in worker processes of its own.
    jobs
        Worker processes, by default one for each core.
    progress
        True for a bar on the terminal, or a function called with the stage, how many settings are done, and how many there are.
    as_it_is_now
        Simulate with what is there now if results were computed with something else, and warn; by default that is refused.

    Raises
    ------
    InputError
        If something that is asked for is not there or cannot be used, or has changed since the results were computed.
    """
    from safevar_sumo.analysis.rules.compute import find_rules

    options = RulesOptions(samples=samples, unsafe=_text(unsafe))
    return _asked(find_rules, study_of(study, as_it_is_now=as_it_is_now), options, pool, jobs, progress)


def _asked(compute: Callable[..., T], subject: Study | Case, options: Options, pool: Pool | None, jobs: int | None,
           progress: bool | Progress) -> T:
    """The result that a question's computation gives, with a bar for `progress=True`."""
    with shown(progress) as show:
        return compute(subject, options, pool=pool, jobs=jobs, progress=show)


def _text(unsafe: Criterion | None) -> str | None:
    """A criterion as the options hold it and a command takes it."""
    from safevar_sumo.analysis.criterion import Unsafe

    return None if unsafe is None else str(Unsafe.parse(unsafe))
