"""Does another vehicle model confirm the failures: is each minimal cause unsafe with that model too?

Options and the Python function `opinion` are defined here, so that help can be shown without loading the computation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from safevar_sumo.analysis.options import Options, document_options, option, unsafe_option
from safevar_sumo.analysis.subject import Results, answer_call

if TYPE_CHECKING:
    from safevar_sumo.analysis.opinion.compute import Opinions
    from safevar_sumo.campaign.pool import Pool
    from safevar_sumo.metrics import Criterion
    from safevar_sumo.terminal import Progress


@dataclass(frozen=True, kw_only=True)
class OpinionOptions(Options):
    """Options for the failures that the second vehicle model simulates again."""

    question: ClassVar[str] = "opinion"
    solutions: tuple[str, ...] = option(
        (),
        "Drive the N-th solution of a run, from 0; may be repeated.  [default: the failures a report explains]",
        flag="--solution",
        metavar="ALG:RUN:N",
        form="repeated",
        python='Handles of solutions, such as "nsga2:3:0". By default the failures that a report explains.',
    )
    unsafe: str | None = unsafe_option()


@document_options(OpinionOptions)
def opinion(
    source: str | Path | Results,
    *,
    solutions: Sequence[str] = OpinionOptions.solutions,
    unsafe: Criterion | None = None,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: bool | Progress = False,
    as_it_is_now: bool = False,
    point: str | None = None,
) -> Opinions:
    """Drive minimal causes of failures again with CommonRoad's multi-body vehicle with Pacejka's tyres.

    Parameters
    ----------
    source
        Results or their directory.
    """
    from safevar_sumo.analysis.opinion.compute import ask_for_opinions

    return answer_call(ask_for_opinions, OpinionOptions, locals(), results_only=True)  # by name, the subject first
