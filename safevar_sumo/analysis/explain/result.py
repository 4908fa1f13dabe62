"""The answer of `explain`: its records, with their JSON, frame, figure and sentences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pandas as pd

from safevar_sumo.analysis.explain.across_fits import AcrossFits
from safevar_sumo.analysis.explain.braking_comparison import BrakingComparison, sentence
from safevar_sumo.analysis.explain.causes import Cause
from safevar_sumo.analysis.explain.robustness import Robustness
from safevar_sumo.analysis.explain.sentences import DISTINCT_CAUSE, LABELS, answer_in_words
from safevar_sumo.analysis.figures import BLUE, FONT_SIZE, GREY, SKY_BLUE, escape_dollars, new_figure
from safevar_sumo.analysis.preventability import Preventability
from safevar_sumo.analysis.words import number_of
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Evaluations, JsonObject
from safevar_sumo.results import SolutionId
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.sumo.empty_road import driven_entry
from safevar_sumo.terminal import answer_as_html
from safevar_sumo.vehicles import CharacteristicSet

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """The explanation of one failure; `handle` is None if the setting is no solution.

    `reasons` state why the failure was chosen. `safety_degree` is in m, or -m/s. `because` states why it is less safe:
    the comparison of its braking with the original vehicle's. `preventable` is the `PreventableBy` of a collision, as
    text. `points` are the names of the test points at which the setting is unsafe; in a rated study, of the cells whose
    colour is worse than the original's.
    """

    handle: SolutionId | None
    reasons: tuple[str, ...]
    setting: dict[str, float]
    outcome: str
    safety_degree: float | None
    changed: tuple[str, ...]
    causes: tuple[Cause, ...]
    robustness: Robustness
    because: BrakingComparison
    preventable: str = ""
    points: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return str(self.handle or "a sampled setting")

    @property
    def title(self) -> str:
        """Why it was chosen, as a title."""
        return "; ".join(label for reason, label in LABELS.items() if reason in self.reasons) or ", ".join(self.reasons)

    @property
    def cause(self) -> Cause | None:
        """The cause that is named: the most robust, the first of several or in a rated study; None if the setting is
        not unsafe.
        """
        return max(self.causes, key=lambda cause: cause.robustness or 0.0, default=None)

    @property
    def necessary(self) -> tuple[str, ...]:
        """The changed characteristics that every minimal cause contains."""
        return tuple(
            name for name in self.changed if self.causes and all(name in cause.changes for cause in self.causes)
        )

    def to_dict(self) -> JsonObject:
        """An entry of `explain --json`."""
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
            "because": sentence(self.because),
            "reasons": list(self.reasons),
            **({"points": list(self.points)} if self.points else {}),
        }


@dataclass(frozen=True, kw_only=True)
class Explained:
    """The answer of `explain`: explanations of the chosen failures, and statistics of all analysed failures.

    Attributes
    ----------
    original, nearest
        Evaluations of the original vehicle, and of the least safe of the evaluated settings; of none, an empty one.
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
    no_verdict
        Why simulations tell nothing about the driving system; "" if they do.
    across_fits
        Ranges of the shares over the fitted vehicle models; None for a study with a single model.
    """

    study: Study
    unsafe: Unsafe
    original: Evaluations
    nearest: Evaluations
    explanations: tuple[Explanation, ...]
    necessity: pd.DataFrame
    distinct: pd.DataFrame
    looked_at: int
    failures: int
    analysed: int
    otherwise: int
    preventability: Preventability
    no_verdict: str = ""
    across_fits: AcrossFits | None = None

    @property
    def characteristics(self) -> CharacteristicSet:
        return CharacteristicSet.of(self.study)

    @property
    def choices(self) -> list[Explanation]:
        """The failures that were chosen by their size or severity, in the order in which they are shown."""
        failures = (self.by_reason.get(reason) for reason in LABELS if reason != DISTINCT_CAUSE)
        return list({id(failure): failure for failure in failures if failure}.values())

    @property
    def by_reason(self) -> Mapping[str, Explanation]:
        """The chosen failures by the reasons for their choice."""
        return {reason: failure for failure in self.explanations for reason in failure.reasons}

    @property
    def sample(self) -> str:
        """Which failures the statistics cover, in words."""
        if self.analysed == self.failures:
            return f"all of {number_of(self.failures, 'failure')}"
        return f"random sample: {self.analysed} of {self.failures} failures"

    def sentences(self) -> list[str]:
        """The answer in sentences, the verdict first."""
        return answer_in_words(self)

    def to_dict(self) -> list[JsonObject]:
        """The JSON of `explain`: a list with an entry for each explained failure, and a summary."""
        by_name = self.necessity.set_index("characteristic")
        summary = {
            "necessary": by_name["necessary"].to_dict(),
            "changed": by_name["changed"].to_dict(),
            "necessary_interval": by_name[["necessary_lower", "necessary_upper"]].T.to_dict("list"),
            "preventable": self.preventability.to_dict(),
            "across_fits": None if self.across_fits is None else self.across_fits.to_dict(),
            **driven_entry(self.no_verdict),
        }
        return [*(failure.to_dict() for failure in self.explanations), {"summary": summary}]

    _repr_html_ = answer_as_html

    def __repr__(self) -> str:
        counts = f"{self.failures} of {self.looked_at}, {len(self.explanations)} in full"
        return f"<Explained {self.study.name}, unsafe {self.unsafe}: {counts}>"

    def to_frame(self) -> pd.DataFrame:
        """One row for each change of each minimal cause of each explanation.

        Columns: `failure`, counted from 0, `algorithm`, `run`, `index`, `cause`, counted from 0, `characteristic`,
        `unit`, `original`, `value`, `boundary`, `alone` [unit], `fraction`, `outcome`, `safety_degree` [m or -m/s],
        `robustness`, `whose`, the class `preventable` of the failure, and `points`, separated by semicolons.
        """
        rows = [
            (
                failure_index,
                *(failure.handle or (None, None, None)),
                cause_index,
                item.name,
                item.unit,
                item.original,
                cause.changes[item.name],
                cause.boundary[item.name],
                cause.alone[item.name],
                cause.fraction,
                cause.outcome,
                cause.safety_degree,
                failure.robustness.share,
                failure.preventable,
                "; ".join(failure.points),
            )
            for failure_index, failure in enumerate(self.explanations)
            for cause_index, cause in enumerate(failure.causes)
            for item in self.characteristics
            if item.name in cause.changes
        ]
        return pd.DataFrame(
            rows,
            columns=[
                "failure",
                "algorithm",
                "run",
                "index",
                "cause",
                "characteristic",
                "unit",
                "original",
                "value",
                "boundary",
                "alone",
                "fraction",
                "outcome",
                SAFETY_DEGREE,
                "robustness",
                "whose",
                "points",
            ],
        )

    def figure(self) -> Figure:
        """How often each characteristic is necessary, beside how often it is changed (as RQ3.2 counts)."""
        frame, size = self.necessity.iloc[::-1], (6.4, 1.4 + 0.3 * max(len(self.necessity), 4))
        figure, ((axis,),) = new_figure(f"{self.study.name}: changed vs. necessary", 1, 1, size)
        names = [escape_dollars(name) for name in frame["characteristic"]]
        for column, label, colour, height in (
            ("changed", "changed", GREY, 0.8),
            ("involved", "in some minimal cause", SKY_BLUE, 0.5),
            ("necessary", "necessary: in every minimal cause", BLUE, 0.24),
        ):
            axis.barh(names, 100 * frame[column], height=height, color=colour, label=label)
        axis.set_xlim(0, 100)
        axis.set_xlabel(f"share of {self.analysed} failures [%]")
        axis.grid(visible=False, axis="y")
        figure.legend(
            *axis.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=FONT_SIZE
        )
        return figure
