"""Result records of `opinion`, with their JSON and a frame."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import pandas as pd

from safevar_sumo.analysis.words import OUTCOME_VERBS
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Outcome
from safevar_sumo.study import SAFETY_DEGREE, Study


class OpinionVerdict(StrEnum):
    """The second model's verdict on a cause."""

    CONFIRMED = "confirmed"
    CONTRADICTED = "contradicted"
    BORDERLINE = "borderline"
    OUTSIDE = "outside"


class RunEnd(NamedTuple):
    """How a run ends: outcome and safety degree [m, or -m/s]; None if the run was not driven or has no safety degree."""

    outcome: str | None = None
    safety_degree: float | None = None

    def __str__(self) -> str:
        """Such as `a collision at 3.21 m/s`."""
        if self.outcome == Outcome.COLLISION:
            return "a collision" if self.safety_degree is None else f"a collision at {-self.safety_degree:.2f} m/s"
        degree = "" if self.safety_degree is None else f", safety degree {self.safety_degree:.2f} m"
        return "not driven" if self.outcome is None else f"{OUTCOME_VERBS.get(Outcome(self.outcome), self.outcome)}{degree}"

    def to_dict(self) -> dict[str, Any]:
        return {"outcome": self.outcome, SAFETY_DEGREE: self.safety_degree}


@dataclass(frozen=True, kw_only=True)
class Opinion:
    """The second model's opinion on one minimal cause.

    Attributes
    ----------
    solution
        The handle of the failure with this cause; None for a cause without a failure.
    changes
        The cause: values by name, in their units.
    here, there
        How the run with these changes ends: `here` with our model, `there` with the second model.
    opinion, because
        The verdict, and its reason in a sentence or two.
    """

    solution: str | None
    changes: dict[str, float]
    here: RunEnd
    there: RunEnd
    opinion: OpinionVerdict
    because: str

    def to_dict(self) -> dict[str, Any]:
        """An entry of `opinion --json`."""
        return {"solution": self.solution, "changes": self.changes, "here": self.here.to_dict(), "there": self.there.to_dict(),
                "opinion": str(self.opinion), "because": self.because}


@dataclass(frozen=True, kw_only=True)
class Opinions:
    """Opinions on the minimal causes of failures.

    Attributes
    ----------
    opinions
        One for each minimal cause of each failure.
    original_here, original_there
        How the original vehicle's run ends: `original_here` with our model, `original_there` with the second model.
    without_cause
        Requested solutions that have no cause, because they are not unsafe.
    """

    study: Study
    unsafe: Unsafe
    opinions: tuple[Opinion, ...]
    original_here: RunEnd
    original_there: RunEnd
    without_cause: tuple[str, ...] = ()

    def count(self, verdict: OpinionVerdict) -> int:
        """Number of causes with this verdict."""
        return sum(opinion.opinion == verdict for opinion in self.opinions)

    def to_dict(self) -> list[dict[str, Any]]:
        """The JSON of `opinion`."""
        return [opinion.to_dict() for opinion in self.opinions]

    def to_frame(self) -> pd.DataFrame:
        """One row for each cause: `solution`, `changes`, outcome and safety degree `here` and `there`, `opinion`, `because`."""
        rows = [(opinion.solution, opinion.changes, *opinion.here, *opinion.there, str(opinion.opinion), opinion.because)
                for opinion in self.opinions]
        return pd.DataFrame(rows, columns=["solution", "changes", "outcome_here", "safety_degree_here", "outcome_there",
                                           "safety_degree_there", "opinion", "because"])

    def __repr__(self) -> str:
        counts = ", ".join(f"{self.count(verdict)} {verdict}" for verdict in OpinionVerdict)
        return f"<Opinions on {self.study.name}, unsafe {self.unsafe}: {counts}>"
