"""Why does a vehicle fail: which changes cause it, how little of them is enough, is the failure robust?

The options stand here, where the help of a command reads them without loading the computation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from safevar_sumo.analysis.options import Options, option, unsafe_option


@dataclass(frozen=True, kw_only=True)
class ExplainOptions(Options):
    """How failures are explained."""

    question: ClassVar[str] = "explain"
    solutions: tuple[str, ...] = option(
        (), "Explain the N-th solution of a run, from 0; may be repeated.  [default: the failures that matter]",
        flag="--solution", metavar="ALG:RUN:N", form="repeated")
    unsafe: str | None = unsafe_option()
    top: int = option(8, "How many failures are explained in full.", kind=int, low=1, high=1000)
    limit: int = option(40_000, "Simulations, about, for the minimal causes of all failures; of more failures a random sample is looked "
                                 "into.", kind=int, low=1, metavar="N")
