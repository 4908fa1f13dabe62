"""How far may each characteristic go alone, and together with all others?

The options and the function of the library are defined here, so that a command's help can be shown without loading the
computation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from safevar_sumo.questions.options import Options, document_options, margin_option, option, unsafe_option
from safevar_sumo.questions.subject import Results, answer_call
from safevar_sumo.study import StudyLike

if TYPE_CHECKING:
    from safevar_sumo.campaign.pool import Pool
    from safevar_sumo.metrics import Criterion
    from safevar_sumo.questions.tolerance.answer import Tolerance
    from safevar_sumo.terminal import Progress


@dataclass(frozen=True, kw_only=True)
class ToleranceOptions(Options):
    """Options of the search for tolerances."""

    question: ClassVar[str] = "tolerance"
    unsafe: str | None = unsafe_option()
    characteristics: tuple[str, ...] | None = option(
        None,
        "Only these characteristics, separated by commas.  [default: all]",
        metavar="A,B",
        form="commas",
        python=(
            "Characteristics that vary, alone and together in the joint box; the others keep their values. By default "
            "all."
        ),
    )
    margin: float | None = margin_option()
    fits: int = option(
        8,
        "Number of vehicle models that fit the published data about as well (sets of [spread]) with which each "
        "characteristic is scanned again; 0 leaves this out.",
        kind=int,
        low=0,
        high=1000,
        metavar="N",
    )
    limits: tuple[str, ...] = option(
        (),
        "A limit in the characteristic's unit, beside those of [limits] in STUDY: find how far all others may go then, "
        "and end with exit code 3 if a limit is not kept; may be repeated.",
        metavar='"NAME >= X"',
        form="repeated",
        python=(
            'Limits such as `"treadDepth >= 3"`, in the unit of the characteristic, beside those of `[limits]` in the '
            "study: all other characteristics get the largest box that is safe with these."
        ),
    )


@document_options(ToleranceOptions)
def tolerance(
    study: StudyLike | Results,
    *,
    unsafe: Criterion | None = None,
    characteristics: Sequence[str] | None = None,
    margin: float | None = ToleranceOptions.margin,
    fits: int = ToleranceOptions.fits,
    limits: Sequence[str] = ToleranceOptions.limits,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: bool | Progress = False,
    as_it_is_now: bool = False,
    point: str | None = None,
) -> Tolerance:
    """Find how far characteristics may go: each alone, and all together.

    Parameters
    ----------
    study
        A study; or results or their directory: their study is examined, and the joint box holds none of their unsafe
        solutions.
    """
    from safevar_sumo.questions.tolerance.compute import find_tolerances

    return answer_call(find_tolerances, ToleranceOptions, locals())
