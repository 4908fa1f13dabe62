"""In which regions of the domain do failures lie, in physical units?

The options and the function of the library are defined here, so that a command's help can be shown without loading the
computation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from safevar_sumo.analysis.options import Options, document_options, option, unsafe_option
from safevar_sumo.analysis.subject import Results, answer_call
from safevar_sumo.study import StudyLike

if TYPE_CHECKING:
    from safevar_sumo.analysis.rules.compute import Rules
    from safevar_sumo.campaign.pool import Pool
    from safevar_sumo.metrics import Criterion
    from safevar_sumo.terminal import Progress


@dataclass(frozen=True, kw_only=True)
class RulesOptions(Options):
    """Options of the search for rules."""

    question: ClassVar[str] = "rules"
    samples: int = option(
        16_384,
        "Number of settings over the whole domain; one half yields the rules, the other half tests them.",
        kind=int,
        low=2,
        high=10_000_000,
        metavar="N",
    )
    unsafe: str | None = unsafe_option()


@document_options(RulesOptions)
def rules(
    study: StudyLike | Results,
    *,
    samples: int = RulesOptions.samples,
    unsafe: Criterion | None = None,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: bool | Progress = False,
    as_it_is_now: bool = False,
    point: str | None = None,
) -> Rules:
    """Find rules in physical units that say where a study is unsafe.

    Parameters
    ----------
    study
        A study; or results or their directory, whose study is examined.
    """
    from safevar_sumo.analysis.rules.compute import find_rules

    return answer_call(find_rules, RulesOptions, locals())
