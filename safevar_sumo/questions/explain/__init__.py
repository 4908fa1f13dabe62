"""Why does a vehicle fail? Which changes cause the failure, how small a change is enough, and is the failure robust?

The options and the function of the library are defined here, so that a command's help can be shown without loading the
computation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from safevar_sumo.questions.options import Options, document_options, option, unsafe_option
from safevar_sumo.questions.subject import Results, answer_call
from safevar_sumo.study import StudyLike

if TYPE_CHECKING:
    from safevar_sumo.campaign.pool import Pool
    from safevar_sumo.metrics import Criterion
    from safevar_sumo.questions.explain.answer import Explained
    from safevar_sumo.terminal import Progress


@dataclass(frozen=True, kw_only=True)
class ExplainOptions(Options):
    """Options of the explanation of failures."""

    question: ClassVar[str] = "explain"
    solutions: tuple[str, ...] = option(
        (),
        "Explain the N-th solution of a run, from 0; may be repeated.  [default: the failures that matter]",
        flag="--solution",
        metavar="ALG:RUN:N",
        form="repeated",
        python='Handles of solutions, such as "nsga2:3:0". By default the robust failure with the fewest changes, '
        "the failures with the "
        "fewest changes and with the smallest largest change, the most severe failure, and one failure of "
        "each distinct cause, the "
        "most frequent first.",
    )
    unsafe: str | None = unsafe_option()
    top: int = option(8, "Maximum number of failures explained in full.", kind=int, low=1, high=1000)
    limit: int = option(
        40_000,
        "Approximate number of simulations for the minimal causes of all failures; if all failures would take "
        "more, a random sample is analysed.",
        kind=int,
        low=1,
        metavar="N",
    )
    fits: int = option(
        20,
        "Number of vehicle models that fit the published data about as well (sets of [spread]) with which each "
        "conclusion is drawn again; 0 leaves this out.",
        kind=int,
        low=0,
        high=1000,
        metavar="N",
    )


@document_options(ExplainOptions)
def explain(
    source: StudyLike | Results,
    *,
    solutions: Sequence[str] = ExplainOptions.solutions,
    unsafe: Criterion | None = None,
    top: int = ExplainOptions.top,
    limit: int = ExplainOptions.limit,
    fits: int = ExplainOptions.fits,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: bool | Progress = False,
    as_it_is_now: bool = False,
    point: str | None = None,
) -> Explained:
    """Explain failures: their minimal causes with boundaries, the reason in words, and the robustness.

    Parameters
    ----------
    source
        Results or their directory: their solutions are explained. A study: failures drawn from its whole domain are
        explained.
    """
    from safevar_sumo.questions.explain.compute import explain_failures

    return answer_call(explain_failures, ExplainOptions, locals())
