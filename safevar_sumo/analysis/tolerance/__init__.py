"""How far may each characteristic go, alone, in pairs, and all together?

The options and the function of the library stand here: the help of a command reads them without loading the computation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from safevar_sumo.analysis.options import Options, option, unsafe_option
from safevar_sumo.analysis.subject import Results, answered, criterion_text, study_of
from safevar_sumo.study import StudyLike

if TYPE_CHECKING:
    from safevar_sumo.analysis.evaluator import Progress
    from safevar_sumo.analysis.tolerance.compute import Tolerance
    from safevar_sumo.metrics import Criterion
    from safevar_sumo.workers.evaluation import Pool


@dataclass(frozen=True, kw_only=True)
class ToleranceOptions(Options):
    """Options of the search for tolerances."""

    question: ClassVar[str] = "tolerance"
    unsafe: str | None = unsafe_option()
    characteristics: tuple[str, ...] | None = option(
        None, "These characteristics alone, separated by commas.  [default: all]", metavar="A,B", form="commas")
    pairs: bool = option(False, "Look at every pair too.", kind=bool)


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
    options = ToleranceOptions(unsafe=criterion_text(unsafe), characteristics=names, pairs=pairs)
    return answered(find_tolerances, study_of(study, as_it_is_now=as_it_is_now), options, pool, jobs, progress)
