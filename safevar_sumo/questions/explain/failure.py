"""One explained failure: its causes, how it ends beside the original, whether it is robust; in JSON and in words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from rich.table import Table

from safevar_sumo.questions.explain.causes import Cause, Robustness
from safevar_sumo.questions.words import ending_in_words, join_phrases, list_of_changes, number_of, simulate_command
from safevar_sumo.records import KMH_PER_MS, JsonObject, Outcome
from safevar_sumo.results import SolutionId
from safevar_sumo.scenarios import distance_in_words
from safevar_sumo.study import unit_text
from safevar_sumo.terminal import WholeTable, meanings
from safevar_sumo.vehicles import CharacteristicSet

ROBUST = "smallest robust"
"""The reason for choosing the robust failure with the fewest changes."""
REASONS = {"fewest": "fewest changes", "most_severe": "most severe", "smallest": "smallest changes"}
"""The other reasons for choosing a failure, by the name of the choice in `CHOICES`; the JSON contains these texts."""
DISTINCT_CAUSE = "a cause of its own"
"""The reason for choosing the simplest failure with a cause that no other chosen failure has."""
MAX_CAUSES = 3
"""Maximum number of minimal causes printed for a failure."""


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """The explanation of one failure.

    Attributes
    ----------
    characteristics
        All characteristics of the vehicle.
    handle
        The handle of the solution; None if the setting was drawn from the study's domain.
    reasons
        Why this failure was chosen to be explained, such as `most severe`.
    setting
        The value of each characteristic, in its unit.
    outcome, safety_degree
        Outcome, and safety degree [m, or -m/s].
    contact
        The safety degree at which bodies touch [m].
    causes
        All minimal causes; none if the setting is not unsafe.
    robustness
        Whether the neighbours of the setting are unsafe too.
    endings
        How the runs of the original vehicle and of this one end, in a sentence.
    preventable
        The weakest reference driver who avoids a collision, in words; empty without a collision and in a rated study.
    points
        Names of the test points at which the setting is unsafe; in a rated study, of the cells whose colour is worse
        than the original's.
    """

    characteristics: CharacteristicSet = field(repr=False)
    handle: SolutionId | None
    reasons: tuple[str, ...]
    setting: dict[str, float]
    outcome: str
    safety_degree: float | None
    contact: float
    causes: tuple[Cause, ...]
    robustness: Robustness
    endings: str
    preventable: str = ""
    points: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return str(self.handle or "a sampled setting")

    @property
    def title(self) -> str:
        """The reasons for choosing this failure, as a title."""
        return "; ".join(self.reasons)

    @property
    def changed(self) -> tuple[str, ...]:
        return tuple(item.name for item in self.characteristics if self.setting[item.name] != item.original)

    @property
    def cause(self) -> Cause | None:
        """The cause that a sentence names: the most robust one; the first one if the robustness is unknown, as in a
        rated study; None if the setting is not unsafe.
        """
        return max(self.causes, key=lambda cause: cause.robustness or 0.0, default=None)

    @property
    def effect(self) -> str:
        """What happens, such as `a collision at 1.5 m/s, 5 km/h`."""
        if self.safety_degree is None:
            return self.outcome
        if self.outcome == Outcome.COLLISION:
            return f"a collision at {speed_in_words(self.safety_degree)}"
        return f"a safety degree of only {distance_in_words(self.safety_degree, self.contact)}"

    def finding(self, verb: str) -> str:
        """The limits of its cause and what was found, such as `With sensor range below 21.4 m the vehicle collides
        (robust: ...). Found with 3 changes: a collision at 1.5 m/s, 5 km/h, robust: ....`
        """
        boundary = self.cause.boundary if self.cause else {}
        limits = [
            f"{item.short_name} {'above' if boundary[item.name] > item.original else 'below'} "
            f"{item.text(boundary[item.name])}{item.suffix}"
            for item in self.characteristics
            if item.name in boundary
        ]
        return (
            f"With {join_phrases(limits)} the vehicle {verb}{self.cause.notes if self.cause else ''}. "
            f"Found with {number_of(len(self.changed), 'change')}: {self.effect}, {self.robustness}."
        )

    def to_dict(self) -> JsonObject:
        """An entry for a failure in `explain --json`."""
        algorithm, run, index = self.handle or (None, None, None)
        return {
            "algorithm": algorithm,
            "run": run,
            "index": index,
            "setting": self.setting,
            "outcome": self.outcome,
            "safety_degree": self.safety_degree,
            "changed": list(self.changed),
            "minimal_causes": [cause.to_dict() for cause in self.causes],
            "robustness": self.robustness.share,
            "avoided_by": self.preventable or None,
            "reasons": list(self.reasons),
            "points": list(self.points),
        }

    def details(self, subject: str, point: str) -> Iterator[str | Table]:
        """Everything about the failure, as sentences and tables; printed commands name `subject` and `point`."""
        yield f"\n{self.name} ({self.title})"
        yield f"{self.endings} {list_of_changes(self.characteristics, self.setting)}. It is {self.robustness}."
        for cause in self.causes[:MAX_CAUSES]:
            table = WholeTable(
                "minimal cause", right=("original", "here", "limit (all scaled)", "limit (this one only)")
            )
            changed = [item for item in self.characteristics if item.name in cause.changes]
            for item in changed:
                texts = (item.text(values[item.name]) for values in (cause.changes, cause.boundary, cause.alone))
                table.add_row(item.name + unit_text(item.unit, " [{}]"), f"{item.original:g}", *texts)
            yield from (table, meanings(changed))
            ending = ending_in_words(cause.outcome, cause.safety_degree, self.contact)
            yield f"Alone it {ending}{cause.notes}: {simulate_command(subject, cause.changes, point)}. {cause.limit}"
        if len(self.causes) > MAX_CAUSES:
            yield f"... and {len(self.causes) - MAX_CAUSES} more of the same number of changes (--json has all)."
        if self.points:
            yield f"Fails at {number_of(len(self.points), 'point')}: {'; '.join(self.points)}."
        if self.preventable:
            yield f"In the same vehicle: {self.preventable}."


def speed_in_words(degree: float) -> str:
    """The collision speed that a safety degree states, in m/s and in km/h; below 3 km/h with a decimal."""
    speed = -degree * KMH_PER_MS
    return f"{-degree:.1f} m/s, {speed:.{1 if speed < 3 else 0}f} km/h"
