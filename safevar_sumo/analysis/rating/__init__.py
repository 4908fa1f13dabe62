"""How many Euro NCAP points does a vehicle earn, and how many does a worn variant of it lose?

The options and the function of the library stand here: the help of a command reads them without loading the computation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from safevar_sumo.analysis.options import Options, option
from safevar_sumo.analysis.subject import Results, answered, study_or_case
from safevar_sumo.errors import InputError
from safevar_sumo.study import Study, StudyLike

if TYPE_CHECKING:
    from safevar_sumo.analysis.evaluator import Progress
    from safevar_sumo.analysis.rating.compute import Rating
    from safevar_sumo.workers.evaluation import Pool


@dataclass(frozen=True, kw_only=True)
class RatingOptions(Options):
    """Which variant is rated beside the original vehicle: characteristics that are changed, or a solution of results."""

    question: ClassVar[str] = "rating"
    changes: tuple[str, ...] = option((), "A characteristic of the variant, in its unit or as +10% of the original.", flag="--set",
                                      metavar="NAME=VALUE", form="repeated")
    solution: str | None = option(None, "The variant is the N-th solution of a run, from 0, of a results directory.",
                                  metavar="ALG:RUN:N")


def rating(study: StudyLike | Results, changes: Mapping[str, float] | None = None, *, solution: str | None = RatingOptions.solution,
           pool: Pool | None = None, jobs: int | None = None, progress: bool | Progress = False, as_it_is_now: bool = False) -> Rating:
    """Rate a vehicle as Euro NCAP does in 2026, and one variant of it beside it: crash avoidance, frontal collisions.

    Parameters
    ----------
    study
        A study, or results or their directory, whose vehicle and driving system are rated; its weather is that of the tests by day.
    changes
        Values of characteristics of the variant, in their units; the others are the original's, or the solution's.
    solution
        The variant is this solution of the results, such as "nsga2:0:3".
    pool
        Where to simulate, if not in worker processes of its own.
    jobs
        Worker processes, by default one for each core.
    progress
        True for a bar on the terminal, or a function called with the stage, how many cells are done, and how many there are.
    as_it_is_now
        Simulate with what is there now if results were computed with something else, and warn; by default that is refused.

    Raises
    ------
    InputError
        If something that is asked for is not there or cannot be used, or has changed since the results were computed.
    """
    from safevar_sumo.analysis.rating.compute import rate
    from safevar_sumo.results import SolutionId, position_of
    from safevar_sumo.vehicles import CharacteristicSet

    subject = study_or_case(study, as_it_is_now=as_it_is_now)
    base, name = None, "variant"
    if solution is not None:
        if isinstance(subject, Study):
            raise InputError("solution", f"{subject.name!r} is a study and has no solutions", "a results directory")
        row = subject.solutions.iloc[position_of(subject.solutions, SolutionId.parse(solution))]
        base, name = {one: float(row[one]) for one in subject.characteristics.names}, solution
    of_study = subject if isinstance(subject, Study) else subject.study
    characteristics = CharacteristicSet.of(of_study.vehicle.characteristics)
    values = {**(base or {}), **(changes or {})}
    variants = {name: characteristics.setting(values, "changes")} if values else {}
    return answered(lambda subject, options, **how: rate(subject, variants, **how), of_study, RatingOptions(solution=solution), pool, jobs,
                    progress)
