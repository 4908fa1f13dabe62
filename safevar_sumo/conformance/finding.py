"""Findings of a check of user code, and the advice for each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

ADVICE: Mapping[str, str] = {
    "contract": "return what the base class documents: see `safevar_sumo/{base}` and the tutorials",
    "units": "give the study's table and UNITS the same names and units",
    "determinism": "draw nothing at random (an algorithm: from `rng` alone) and do not read the clock",
    "state": "keep what a vehicle remembers in the memory that is handed on, or in the instance of that vehicle: nothing in a class, a "
             "module or a model from one run to the next",
    "batch": "compute element i of a result from element i of the arguments alone: no mean, sum or maximum over the vehicles, no place in "
             "the batch",
    "inputs": "work on a copy: `values = values.copy()`, or make a new array",
    "finite": "guard divisions and roots where the domain ends: `np.maximum(value, smallest)`; infinite gaps mean that nobody is in sight",
    "reaction": "check that the code reads the quantity that it should react to, with the right sign and unit",
    "speed": "compute all vehicles at once with arrays; load files in `__init__`",
    "picklable": "give functions a name at the top of the module; open files, sockets and locks in `start`, not in `__init__`",
}
"""Advice by check."""
BLOCKING_CHECKS = ("contract", "units", "determinism", "state", "batch", "inputs", "finite")
"""Checks whose failure makes results wrong: the study does not begin. A failure of any other check is a warning."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A failed check, with the line at fault, the expected and the actual result, and advice."""

    check: str
    file: str
    line: int
    expected: str
    got: str
    advice: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.check}: {self.got}"


@dataclass(kw_only=True)
class Report:
    """The findings on a subject; `key` is its key and name in a study, `remarks` state assumptions, `speed` is a sentence."""

    subject: str
    kind: str
    key: str = ""
    findings: list[Finding] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    speed: str = ""
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        return not self.findings

    def to_dict(self) -> dict[str, Any]:
        """The JSON output of the command `check`."""
        return {"subject": self.subject, "kind": self.kind, "passed": self.passed, "findings": list(map(asdict, self.findings)),
                "seconds": round(self.seconds, 3)}
