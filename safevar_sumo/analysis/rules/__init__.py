"""In which regions of the domain do failures lie, in physical units?

The options and the function of the library stand here: the help of a command reads them without loading the computation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from safevar_sumo.analysis.options import Options, option, unsafe_option
from safevar_sumo.analysis.subject import Results, answered, criterion_text, study_of
from safevar_sumo.study import StudyLike

if TYPE_CHECKING:
    from safevar_sumo.analysis.evaluator import Progress
    from safevar_sumo.analysis.rules.compute import Rules
    from safevar_sumo.metrics import Criterion
    from safevar_sumo.workers.evaluation import Pool


@dataclass(frozen=True, kw_only=True)
class RulesOptions(Options):
    """Options of the search for rules."""

    question: ClassVar[str] = "rules"
    samples: int = option(16_384, "Settings over the whole domain: half of them make the rules, the other half judges them.",
                           kind=int, low=2, high=10_000_000, metavar="N")
    unsafe: str | None = unsafe_option()


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

    options = RulesOptions(samples=samples, unsafe=criterion_text(unsafe))
    return answered(find_rules, study_of(study, as_it_is_now=as_it_is_now), options, pool, jobs, progress)
