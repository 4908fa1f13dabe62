"""How likely is an unsafe outcome when vehicles vary as a study says, and which characteristic decides?

The options stand here, where the help of a command reads them without loading the computation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from safevar_sumo.analysis.options import Options, option, unsafe_option


@dataclass(frozen=True, kw_only=True)
class RiskOptions(Options):
    """How a risk is estimated."""

    question: ClassVar[str] = "risk"
    samples: int = option(10_000, "Maximum number of vehicles to sample.", kind=int, low=1, high=100_000_000, metavar="N")
    confidence: float = option(0.95, "Confidence of the intervals.", kind=float, low=0, high=1, is_open=(True, True))
    width: float | None = option(
        None, "Stop as soon as the interval of the probability is no wider.", kind=float, low=0, high=1, is_open=(True, False))
    unsafe: str | None = unsafe_option()
