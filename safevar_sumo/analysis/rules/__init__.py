"""In which regions of the domain do failures lie, in physical units?

The options stand here, where the help of a command reads them without loading the computation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from safevar_sumo.analysis.options import Options, option, unsafe_option


@dataclass(frozen=True, kw_only=True)
class RulesOptions(Options):
    """How rules are looked for."""

    question: ClassVar[str] = "rules"
    samples: int = option(16_384, "Settings over the whole domain: half of them make the rules, the other half judges them.",
                           kind=int, low=2, high=10_000_000, metavar="N")
    unsafe: str | None = unsafe_option()
