"""The answer of `explain`: its records, their JSON and their frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, TypeVar

import msgspec
import pandas as pd

from safevar_sumo.analysis.explain.braking_comparison import BrakingComparison, sentence
from safevar_sumo.analysis.explain.causes import BoundaryState
from safevar_sumo.analysis.explain.robustness import Robustness
from safevar_sumo.analysis.preventability import Preventability, PreventedShares
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Evaluations
from safevar_sumo.results import SolutionId
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.vehicles import CharacteristicSet

ROBUST = "smallest robust"
"""The reason for choosing the robust failure with the fewest changes."""
REASONS = {"fewest": "fewest changes", "smallest": "smallest changes", "most_severe": "most severe"}
"""The other reasons for choosing a failure, by the name of the choice in `CHOICES`; the JSON contains these texts."""
DISTINCT_CAUSE = "a cause of its own"
"""The reason for choosing the simplest failure with a cause that no other chosen failure has."""
LABELS = {ROBUST: "robust with the fewest changes", REASONS["smallest"]: "smallest largest change", DISTINCT_CAUSE: "distinct cause"}
"""Titles of failures by the reason for their choice; any other reason is itself the title."""


class CauseEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A minimal cause in the JSON of `explain`; fields as in `Cause`, which also explains `end`."""

    changes: dict[str, float]
    boundary: dict[str, float]
    fraction: float
    outcome: str
    safety_degree: float | None
    end: BoundaryState
    robustness: float | None = None


class FailureEntry(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A failure in the JSON of `explain`; fields as in `Explanation`, but `because` is its comparison as a sentence.

    `algorithm`, `run` and `index` form the handle, None if the setting is no solution; `robustness` is the unsafe share of the neighbours.
    """

    algorithm: str | None
    run: int | None
    index: int | None
    setting: dict[str, float]
    outcome: str
    safety_degree: float | None
    changed: list[str]
    minimal_causes: list[CauseEntry]
    robustness: float
    because: str
    reasons: list[str]
    points: list[str] = []

    @property
    def handle(self) -> str:
        """The handle of the solution; empty if the setting is no solution."""
        return "" if self.algorithm is None else f"{self.algorithm}:{self.run}:{self.index}"


class SummaryEntry(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The last entry in the JSON of `explain`.

    `necessary` and `changed` are shares of the analysed failures by characteristic; `necessary_interval` has 95 % intervals of `necessary`.
    """

    necessary: dict[str, float]
    changed: dict[str, float]
    necessary_interval: dict[str, list[float]]
    preventable: PreventedShares
    driven: bool = True


@dataclass(frozen=True, kw_only=True)
class Cause:
    """A smallest subset of a failure's changes that is unsafe by itself, all else as in the original vehicle.

    Attributes
    ----------
    changes
        The failure's values of these characteristics, in their units.
    boundary
        The values after every change is multiplied by `fraction`, the smallest factor at which the vehicle stays unsafe.
    alone
        For each characteristic, the value to which it can return towards the original while the other values stay as in `changes`.
    outcome, safety_degree
        Outcome, and safety degree [m, or -m/s], of a vehicle with these changes only.
    end, at_threshold
        The end of the shrinking: the state just below `fraction`; at the filter's threshold, the characteristic whose change the filter
        would remove.
    neighbours
        Robustness of these changes by themselves, estimated from the setting's neighbours; None in a rated study, where the simulations
        would take too long.
    short_changes, short_boundary
        `changes` and `boundary` in as few digits as a vehicle needs to end alike, for commands.
    """

    changes: dict[str, float]
    boundary: dict[str, float]
    fraction: float
    alone: dict[str, float]
    outcome: str
    safety_degree: float | None
    end: BoundaryState = BoundaryState.SAFE
    at_threshold: str | None = None
    neighbours: Robustness | None = None
    short_changes: dict[str, float] = field(default_factory=dict)
    short_boundary: dict[str, float] = field(default_factory=dict)

    @property
    def robustness(self) -> float | None:
        """Share of the neighbours of these changes that are unsafe too."""
        return None if self.neighbours is None else self.neighbours.share

    @property
    def limit(self) -> str:
        """A sentence on the smallest unsafe share of the changes, and on what lies just below this share."""
        below = {BoundaryState.SAFE: "slightly less is safe",
                 BoundaryState.FILTER: f"with less, the change of {self.at_threshold} falls below the filter's threshold "
                                       "and counts as none",
                 BoundaryState.NOT_SIMULATED: "slightly less could not be simulated"}[self.end]
        return f"Scaling all changes to {100 * self.fraction:.1f} % is still unsafe; {below}."


SomeCause = TypeVar("SomeCause")


def most_robust(causes: Iterable[SomeCause], share: Callable[[SomeCause], float | None] = attrgetter("robustness")) -> SomeCause | None:
    """The cause of a failure that is named: the one with the largest `share` of unsafe neighbours, among all of the failure's causes.

    The first of several, or in a rated study, whose causes have no shares; None without a cause.
    """
    return max(causes, key=lambda cause: share(cause) or 0.0, default=None)


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """The explanation of one failure; `handle` is None if the setting is no solution.

    `reasons` state why the failure was chosen. `safety_degree` is in m, or -m/s. `necessary` are the `changed` characteristics that every
    minimal cause contains. `because` states why it is less safe: the comparison of its braking with the original vehicle's. `preventable`
    is the `PreventableBy` of a collision, as text. `points` are the names of the test points at which the setting is unsafe; in a rated
    study, of the cells whose colour is worse than the original's.
    """

    handle: SolutionId | None
    reasons: tuple[str, ...]
    setting: dict[str, float]
    outcome: str
    safety_degree: float | None
    changed: tuple[str, ...]
    necessary: tuple[str, ...]
    causes: tuple[Cause, ...]
    robustness: Robustness
    because: BrakingComparison
    preventable: str = ""
    points: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """An entry of `explain --json`."""
        algorithm, run, index = self.handle or (None, None, None)
        entry = FailureEntry(
            algorithm=algorithm, run=run, index=index, setting=self.setting, outcome=self.outcome, safety_degree=self.safety_degree,
            changed=list(self.changed),
            minimal_causes=[CauseEntry(**{name: getattr(cause, name) for name in CauseEntry.__struct_fields__}) for cause in self.causes],
            robustness=self.robustness.share, because=sentence(self.because), reasons=list(self.reasons), points=list(self.points))
        return dict(msgspec.to_builtins(entry))


@dataclass(frozen=True, kw_only=True)
class Explained:
    """The answer of `explain`: explanations of the chosen failures, and statistics of all analysed failures.

    Attributes
    ----------
    explanations
        Explanations of the chosen failures.
    necessity, distinct
        Statistics of all analysed failures: the frames that `necessity_frame` and `count_distinct_causes` return.
    looked_at, failures, analysed
        Number of evaluated settings, of failures among these, and of failures that the statistics cover.
    otherwise
        Number of solutions that ended otherwise than in the results: with another outcome than the recorded one.
    preventability
        Shares of the collisions among the evaluated settings that reference drivers avoid.
    """

    study: Study
    unsafe: Unsafe
    original: Evaluations
    explanations: tuple[Explanation, ...]
    necessity: pd.DataFrame
    distinct: pd.DataFrame
    looked_at: int
    failures: int
    analysed: int
    otherwise: int
    preventability: Preventability
    no_verdict: str = ""

    def to_dict(self) -> list[dict[str, Any]]:
        """The JSON of `explain`: a list with an entry for each explained failure, and a summary."""
        def columns(*names: str) -> Iterable[Any]:
            return self.necessity[["characteristic", *names]].itertuples(index=False)

        summary = SummaryEntry(
            necessary=dict(columns("necessary")), changed=dict(columns("changed")),
            necessary_interval={name: ends for name, *ends in columns("necessary_lower", "necessary_upper")},
            preventable=self.preventability.shares, driven=not self.no_verdict)
        return [*(failure.to_dict() for failure in self.explanations), {"summary": msgspec.to_builtins(summary)}]

    def __repr__(self) -> str:
        return f"<Explained {self.study.name}, unsafe {self.unsafe}: {self.failures} of {self.looked_at}, {len(self.explanations)} in full>"

    def to_frame(self) -> pd.DataFrame:
        """One row for each change of each minimal cause of each explanation.

        Columns: `failure`, counted from 0, `algorithm`, `run`, `index`, `cause`, counted from 0, `characteristic`, `unit`,
        `original`, `value`, `boundary`, `alone` [unit], `fraction`, `outcome`, `safety_degree` [m or -m/s], `robustness`,
        `whose`, the class `preventable` of the failure, and `points`, separated by semicolons.
        """
        rows = []
        for failure_index, failure in enumerate(self.explanations):
            algorithm, run, index = failure.handle or (None, None, None)
            for cause_index, cause in enumerate(failure.causes):
                for characteristic in CharacteristicSet.of(self.study.vehicle.characteristics):
                    if (name := characteristic.name) in cause.changes:
                        rows.append((failure_index, algorithm, run, index, cause_index, name, characteristic.unit, characteristic.original,
                                     cause.changes[name], cause.boundary[name], cause.alone[name], cause.fraction, cause.outcome,
                                     cause.safety_degree, failure.robustness.share, failure.preventable, "; ".join(failure.points)))
        return pd.DataFrame(rows, columns=["failure", "algorithm", "run", "index", "cause", "characteristic", "unit", "original", "value",
                                           "boundary", "alone", "fraction", "outcome", SAFETY_DEGREE, "robustness", "whose", "points"])
