"""How far may each characteristic go, alone, in pairs, and all together?

The options stand here, where the help of a command reads them without loading the computation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from safevar_sumo.analysis.options import Options, option, unsafe_option


@dataclass(frozen=True, kw_only=True)
class ToleranceOptions(Options):
    """How tolerances are looked for."""

    question: ClassVar[str] = "tolerance"
    unsafe: str | None = unsafe_option()
    characteristics: tuple[str, ...] | None = option(
        None, "These characteristics alone, separated by commas.  [default: all]", metavar="A,B", form="commas")
    pairs: bool = option(False, "Look at every pair too.", kind=bool)
