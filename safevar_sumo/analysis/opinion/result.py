"""Result records of `opinion`, with their JSON, a frame and sentences."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any, Literal, get_args

import msgspec
import pandas as pd

from safevar_sumo.analysis.words import OUTCOME_VERBS, join_phrases, list_of_changes, number_of
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Outcome
from safevar_sumo.study import Study
from safevar_sumo.sumo.empty_road import summary_entry
from safevar_sumo.vehicles import CharacteristicSet

MODEL_IN_WORDS = "Driven again with CommonRoad's multi-body vehicle, Pacejka's tyres and anti-lock brakes"


Verdict = Literal["outside", "confirmed", "contradicted", "borderline"]
"""The second model's verdict on a cause."""


class RunEnd(msgspec.Struct, frozen=True):
    """How a run ends: outcome, and safety degree [m, or -m/s]; None if there is none, or the run was not simulated."""

    outcome: str | None = None
    safety_degree: float | None = None

    def __str__(self) -> str:
        """Such as `a collision at 3.21 m/s`."""
        if self.outcome == Outcome.COLLISION:
            return "a collision" if self.safety_degree is None else f"a collision at {-self.safety_degree:.2f} m/s"
        degree = "" if self.safety_degree is None else f", safety degree {self.safety_degree:.2f} m"
        return f"{OUTCOME_VERBS.get(Outcome(self.outcome), self.outcome)}{degree}" if self.outcome else "not driven"


class Opinion(msgspec.Struct, frozen=True, kw_only=True):
    """The second model's opinion on one minimal cause, an entry of `opinion --json`.

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
    opinion: Verdict
    because: str


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
    no_verdict
        Why the original vehicle gives no verdict; empty if it does.
    """

    study: Study
    unsafe: Unsafe
    opinions: tuple[Opinion, ...]
    original_here: RunEnd
    original_there: RunEnd
    without_cause: tuple[str, ...] = ()
    no_verdict: str = ""

    def to_dict(self) -> list[dict[str, Any]]:
        """The JSON of `opinion`."""
        return [*map(msgspec.to_builtins, self.opinions), *summary_entry(self.no_verdict)]

    def to_frame(self) -> pd.DataFrame:
        """One row for each cause: the keys of `to_dict`, with outcome and safety degree of `here` and `there`."""
        rows = [
            (
                one.solution,
                one.changes,
                one.here.outcome,
                one.here.safety_degree,
                one.there.outcome,
                one.there.safety_degree,
                one.opinion,
                one.because,
            )
            for one in self.opinions
        ]
        return pd.DataFrame(
            rows,
            columns=[
                "solution",
                "changes",
                "outcome_here",
                "safety_degree_here",
                "outcome_there",
                "safety_degree_there",
                "opinion",
                "because",
            ],
        )

    @property
    def notes(self) -> list[str]:
        """The solutions that are not unsafe, and the number of causes with each verdict."""
        words, numbers = {"outside": "outside (no answer)"}, Counter(one.opinion for one in self.opinions)
        counts = [f"{numbers[one]} {words.get(one, one)}" for one in get_args(Verdict) if one in numbers]
        total = number_of(len(self.opinions), "minimal cause")
        return [
            *(f"{handle} is not unsafe: it has no cause" for handle in self.without_cause),
            f"of {total} {join_phrases(counts)}" if counts else "there is no cause to judge",
        ]

    def sentences(self) -> list[str]:
        """The answer as lines: how many causes are confirmed, then every cause with the reason."""
        characteristics = CharacteristicSet.of(self.study.vehicle.characteristics)
        *notes, counts = self.notes
        lines = [
            f"Unsafe: {self.unsafe.description}. {MODEL_IN_WORDS}: {counts}.",
            f"The original vehicle with our model: {self.original_here}; with the second: {self.original_there}.",
            *(f"note: {note}" for note in notes),
        ]
        for one in self.opinions:
            handle = f"{one.solution}: " if one.solution else ""
            lines += [
                f"{handle}{one.opinion}: {list_of_changes(characteristics, one.changes)}",
                f"  with our model {one.here}; {one.because}",
            ]
        return lines

    def __repr__(self) -> str:
        return f"<Opinions on {self.study.name}, unsafe {self.unsafe}: {self.notes[-1]}>"
