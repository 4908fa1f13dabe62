"""How many Euro NCAP points does a vehicle earn, and how many does a worn variant lose?

The options and the function of the library are defined here, so that a command's help can be shown without loading the
computation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from safevar_sumo.analysis.options import Options, document_options, option
from safevar_sumo.analysis.subject import Results, answer_call
from safevar_sumo.study import StudyLike

if TYPE_CHECKING:
    from safevar_sumo.analysis.rating.compute import Rating
    from safevar_sumo.campaign.pool import Pool
    from safevar_sumo.terminal import Progress


@dataclass(frozen=True, kw_only=True)
class RatingOptions(Options):
    """The variant that is rated beside the original vehicle: a solution of results, changed characteristics, or
    both.
    """

    question: ClassVar[str] = "rating"
    changes: Mapping[str, float] | None = option(
        None,
        "A characteristic of the variant, in its unit or as +10% of the original.",
        flag="--set",
        metavar="NAME=VALUE",
        form="repeated",
        python=(
            "Values of characteristics of the variant, in their units; the others are the original's, or the "
            "solution's."
        ),
    )
    solution: str | None = option(
        None, "The variant is the N-th solution of a run, from 0, of a results directory.", metavar="ALG:RUN:N"
    )


@document_options(RatingOptions)
def rating(
    study: StudyLike | Results,
    changes: Mapping[str, float] | None = RatingOptions.changes,
    *,
    solution: str | None = RatingOptions.solution,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: bool | Progress = False,
    as_it_is_now: bool = False,
) -> Rating:
    """Rate the crash avoidance (frontal collisions) of a vehicle and of one variant as Euro NCAP does in 2026.

    Parameters
    ----------
    study
        A study, or results or their directory, whose vehicle and driving system are rated; tests by day take place in
        the study's weather.
    """
    from safevar_sumo.analysis.rating.compute import rate_variant

    return answer_call(rate_variant, RatingOptions, locals())  # the arguments by name, the subject first
