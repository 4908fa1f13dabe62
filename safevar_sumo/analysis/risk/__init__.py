"""How likely is an unsafe outcome when vehicles vary as a study specifies, and which characteristic decides?

The options and the function of the library are defined here, so that a command's help can be shown without loading the
computation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from safevar_sumo.analysis.options import Options, document_options, option, unsafe_option
from safevar_sumo.analysis.subject import Results, answer_call
from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.study import StudyLike

if TYPE_CHECKING:
    from safevar_sumo.analysis.risk.answer import Risk
    from safevar_sumo.campaign.pool import Pool
    from safevar_sumo.metrics import Criterion
    from safevar_sumo.terminal import Progress

METHODS = ("auto", "monte_carlo", "subset_simulation", "cross_entropy")
"""Methods that estimate a probability."""
RARE_BELOW = 1e-2
"""Probability below which a method for rare failures is more efficient than plain Monte Carlo."""
PILOT_VEHICLES = 1000
"""Number of vehicles first drawn by plain Monte Carlo, whose outcomes decide the method."""
ENOUGH_FAILURES = 100
"""Plain Monte Carlo is kept if, by the pilot, at least so many of `samples` vehicles are expected to fail."""


@dataclass(frozen=True, kw_only=True)
class RiskOptions(Options):
    """Options for the estimate of a risk."""

    question: ClassVar[str] = "risk"
    samples: int = option(
        10_000,
        "Maximum number of vehicles that plain Monte Carlo samples.",
        kind=int,
        low=1,
        high=100_000_000,
        metavar="N",
    )
    confidence: float = option(0.95, "Confidence of the intervals.", kind=float, low=0, high=1, is_open=(True, True))
    width: float | None = option(
        None,
        "Stop as soon as the confidence interval of the probability is at most this wide.",
        kind=float,
        low=0,
        high=1,
        is_open=(True, False),
    )
    unsafe: str | None = unsafe_option()
    method: str = option(
        "auto",
        "Method: monte_carlo, subset_simulation, cross_entropy or auto. For a study with [variation], auto draws "
        f"{PILOT_VEHICLES:,} vehicles. It then takes subset_simulation if OpenTURNS is installed, the probability is "
        f"below {RARE_BELOW:g} and --samples vehicles would have fewer than {ENOUGH_FAILURES} failures.",
        metavar="METHOD",
        kind=str,
    )
    rare: bool = option(
        False,
        "For rare failures, 1e-3 to 1e-8: as auto, but requires OpenTURNS and computes no sensitivities.",
        kind=bool,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method not in METHODS:
            raise unknown_name("method", repr(self.method), self.method, METHODS)
        if self.rare and self.method == "monte_carlo":
            raise InputError("rare", "cannot be combined with method = 'monte_carlo'", "either rare or method")

    @property
    def requires_rare_method(self) -> bool:
        """Whether a method for rare failures is required, not merely allowed."""
        return self.rare or self.method in ("subset_simulation", "cross_entropy")


@document_options(RiskOptions)
def risk(
    study: StudyLike | Results,
    *,
    samples: int = RiskOptions.samples,
    confidence: float = RiskOptions.confidence,
    width: float | None = RiskOptions.width,
    unsafe: Criterion | None = None,
    method: str = RiskOptions.method,
    rare: bool = RiskOptions.rare,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: bool | Progress = False,
    as_it_is_now: bool = False,
    point: str | None = None,
) -> Risk:
    """Estimate how likely an unsafe outcome is when vehicles vary as the study says, and which characteristic decides
    whether one occurs.

    Parameters
    ----------
    study
        A study; or results or their directory, whose study is examined.
    """
    from safevar_sumo.analysis.risk.compute import estimate_risk

    return answer_call(estimate_risk, RiskOptions, locals())
