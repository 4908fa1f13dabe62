"""Which smallest change of the driving system survives the wear that the user promises, and what does it cost?

The options and the function of the library are defined here, so that a command's help can be shown without loading the
computation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from safevar_sumo.analysis.options import Options, document_options, margin_option, option
from safevar_sumo.analysis.subject import Results, answer_call
from safevar_sumo.study import StudyLike

if TYPE_CHECKING:
    from safevar_sumo.analysis.repair.answer import Repairs
    from safevar_sumo.campaign.pool import Pool
    from safevar_sumo.terminal import Progress


@dataclass(frozen=True, kw_only=True)
class RepairOptions(Options):
    """Options of the repair of a driving system."""

    question: ClassVar[str] = "repair"
    promise: tuple[str, ...] = option(
        (),
        'Wear that is promised, such as "treadDepth >= 3"; may be repeated. Characteristics that no promise names stay '
        'as in the original; "all" promises the whole domain.  [default: the study\'s [repair.promise]]',
        metavar='"NAME >= X"',
        form="repeated",
    )
    margin: float | None = margin_option()
    change: tuple[str, ...] = option(
        (),
        "Parameter of the driving system that may change; may be repeated.  [default: those under [repair], else those "
        "that come with a shipped driving system]",
        metavar="PARAMETER",
        form="repeated",
    )


@document_options(RepairOptions)
def repair(
    source: StudyLike | Results,
    *,
    promise: Sequence[str] = RepairOptions.promise,
    margin: float | None = RepairOptions.margin,
    change: Sequence[str] = RepairOptions.change,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: bool | Progress = False,
    as_it_is_now: bool = False,
    point: str | None = None,
) -> Repairs:
    """Find the smallest changes of a driving system that survive the promised wear, and their price on a new vehicle.

    Parameters
    ----------
    source
        A study; or results or their directory: their failures within the promise are survived, too.
    """
    from safevar_sumo.analysis.repair.compute import find_repairs

    return answer_call(find_repairs, RepairOptions, locals())
