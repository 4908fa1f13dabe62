"""An engineer's questions: which changes did it, how far may each go, how likely is it, in which region."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from safevar_sumo.api.results import Results, study_of, study_or_case
from safevar_sumo.options import ExplainOptions, RiskOptions, RulesOptions
from safevar_sumo.study import StudyLike

if TYPE_CHECKING:
    from safevar_sumo.answers import Explained, Risk, Rules, Tolerance
    from safevar_sumo.computing import Pool


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
    from safevar_sumo import answers

    subject = study_or_case(source, as_it_is_now=as_it_is_now)
    return answers.explain(subject, solutions=solutions, unsafe=unsafe, top=top, limit=limit, pool=pool, jobs=jobs)


def tolerance(study: StudyLike | Results, *, unsafe: str | None = None, characteristics: Sequence[str] | None = None, pairs: bool = False,
              pool: Pool | None = None, jobs: int | None = None,
              as_it_is_now: bool = False) -> Tolerance:
    """How far characteristics may go: each alone, with `pairs` two together, and all together. Otherwise as `explain`."""
    from safevar_sumo import answers

    subject = study_of(study, as_it_is_now=as_it_is_now)
    return answers.tolerance(subject, unsafe=unsafe, characteristics=characteristics, pairs=pairs, pool=pool, jobs=jobs)


def risk(study: StudyLike | Results, *, samples: int = RiskOptions.samples, confidence: float = RiskOptions.confidence,
         width: float | None = None, unsafe: str | None = None, pool: Pool | None = None, jobs: int | None = None,
         as_it_is_now: bool = False) -> Risk:
    """How likely an unsafe outcome is when vehicles vary as the study says, and what decides.

    At most `samples` vehicles are drawn, fewer if the interval of the probability is no wider than `width` before.
    Otherwise as `explain`.
    """
    from safevar_sumo import answers

    subject = study_of(study, as_it_is_now=as_it_is_now)
    return answers.risk(subject, samples=samples, confidence=confidence, width=width, unsafe=unsafe, pool=pool, jobs=jobs)


def rules(study: StudyLike | Results, *, samples: int = RulesOptions.samples, unsafe: str | None = None, pool: Pool | None = None,
          jobs: int | None = None, as_it_is_now: bool = False) -> Rules:
    """Rules that tell where it is unsafe, from `samples` settings spread over the whole domain. Otherwise as `explain`."""
    from safevar_sumo import answers

    subject = study_of(study, as_it_is_now=as_it_is_now)
    return answers.rules(subject, samples=samples, unsafe=unsafe, pool=pool, jobs=jobs)
