"""What changes from one system to another: another driving system, vehicle, weather or version?

The options and the function of the library are defined here, so that a command's help can be shown without loading the
computation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, ClassVar

from safevar_sumo.analysis.options import Options, document_options, option, unsafe_option
from safevar_sumo.analysis.subject import Results, answer_call, reduce_to_point, study_or_case
from safevar_sumo.study import StudyLike

if TYPE_CHECKING:
    from safevar_sumo.analysis.compare.answer import SystemComparison
    from safevar_sumo.campaign.pool import Pool
    from safevar_sumo.metrics import Criterion
    from safevar_sumo.terminal import Progress


@dataclass(frozen=True, kw_only=True)
class CompareOptions(Options):
    """Options of the comparison of two systems."""

    question: ClassVar[str] = "compare"
    unsafe: str | None = unsafe_option()
    samples: int = option(
        2000,
        "Number of Sobol points of the common domain that are simulated beside the solutions.",
        kind=int,
        low=1,
        high=1_000_000,
        metavar="N",
    )


@document_options(CompareOptions)
def compare(
    a: StudyLike | Results,
    b: StudyLike | Results,
    *,
    unsafe: Criterion | None = None,
    samples: int = CompareOptions.samples,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: bool | Progress = False,
    as_it_is_now: bool = False,
    point: str | None = None,
) -> SystemComparison:
    """Simulate the same settings in two systems: which settings are unsafe in one of them only, how do limits differ?

    Parameters
    ----------
    a, b
        Studies with the same characteristics, or results of such studies or their directories, whose solutions are
        simulated in both systems.
    """
    from safevar_sumo.analysis.compare.compute import compare_systems

    arguments = locals()
    other = reduce_to_point(study_or_case(b, as_it_is_now=as_it_is_now), point)
    return answer_call(partial(compare_systems, other=other), CompareOptions, arguments)
