"""The answer of `explain`: explained failures and statistics of all failures, in JSON and in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from rich.table import Table

from safevar_sumo.metrics import RATING_POINTS, Unsafe
from safevar_sumo.questions.case import Case
from safevar_sumo.questions.explain.across_fits import AcrossFits
from safevar_sumo.questions.explain.failure import DISTINCT_CAUSE, REASONS, ROBUST, Explanation, speed_in_words
from safevar_sumo.questions.figures import BLUE, FONT_SIZE, GREY, SKY_BLUE, escape_dollars, new_figure
from safevar_sumo.questions.preventability import Preventability
from safevar_sumo.questions.words import (
    OUTCOME_VERBS,
    ending_in_words,
    list_of_changes,
    number_of,
    question_command,
    simulate_command,
)
from safevar_sumo.records import Evaluations, JsonObject, Outcome
from safevar_sumo.results import CHOICES
from safevar_sumo.scenarios import distance_in_words, equals_clear, weather_in_words
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.sumo.empty_road import driven_entry
from safevar_sumo.sumo.matrix import contact_degree
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.terminal import Answer, WholeTable, constraints_in_words

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_DISTINCT_CAUSES = 10
"""Maximum number of distinct causes in the table of all failures."""
SOLUTIONS, DRAWN = "different solutions of the search", "vehicles drawn from the whole domain"
"""What the settings are of which some are unsafe."""
MAX_NECESSARY = 4
"""Maximum number of characteristics that a sentence names as necessary."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Explained(Answer):
    """The answer of `explain`: explanations of the chosen failures, and statistics of all analysed failures.

    Attributes
    ----------
    original, nearest
        Evaluations of the original vehicle, and of the least safe of the evaluated settings; `nearest` is empty if no
        setting was evaluated.
    explanations
        Explanations of the chosen failures.
    necessity, distinct
        Statistics of all analysed failures: the frames that `necessity_frame` and `count_distinct_causes` return.
    looked_at, failures, analysed
        Number of evaluated settings, of failures among these, and of failures that the statistics cover.
    kind
        What the evaluated settings are, in the plural.
    otherwise
        Number of solutions with another outcome than the recorded one.
    left_out
        Number of collisions that the search simulated, if no solution is one.
    preventability
        Which collisions among the evaluated settings reference drivers avoid.
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
    kind: str
    otherwise: int
    left_out: int
    preventability: Preventability
    no_verdict: str = ""
    across_fits: AcrossFits | None = None

    @property
    def choices(self) -> list[Explanation]:
        """The failures that were chosen by their size or severity."""
        return [failure for failure in self.explanations if failure.reasons != (DISTINCT_CAUSE,)]

    @property
    def sample(self) -> str:
        """Which failures the statistics cover, in words."""
        if self.analysed == self.failures:
            return f"all of {number_of(self.failures, 'failure')}"
        return f"random sample: {self.analysed} of {self.failures} failures"

    @property
    def counts(self) -> str:
        """How many settings are unsafe, the criterion, and the unsafe share with other fitted vehicle models."""
        counts = f"{self.failures} of {self.looked_at} {self.kind} are unsafe: {self.unsafe.description}."
        if self.otherwise:
            counts += f" {number_of(self.otherwise, 'setting')} with another outcome than recorded."
        if self.left_out:
            collisions = number_of(self.left_out, "collision")
            counts += f" The search also simulated {collisions}, which its objectives leave out."
        return f"{counts} {self.across_fits}" if self.across_fits else counts

    @property
    def verdict(self) -> list[str]:
        """The verdict in sentences: the situation, the leading failure, the robust one, and who would have avoided the
        collisions.

        The leading failure has the fewest changes; of several, it is the robust one, or else the most severe one.
        """
        system, evaluated = assemble(self.study), f"{self.looked_at} {self.kind}"
        sentences = [situation_in_words(system, self.original, self.nearest, evaluated)]
        by_reason = {reason: failure for failure in self.explanations for reason in failure.reasons}
        robust, leading = by_reason.get(ROBUST), by_reason.get(REASONS["fewest"], next(iter(self.explanations), None))
        if leading is None or leading.cause is None:
            return sentences if self.no_verdict else [*sentences, "Nothing unsafe was found."]
        if not leading.cause.changes:
            return [*sentences, "No change is needed for it to be unsafe."]
        if robust is not None and len(robust.changed) == len(leading.changed):
            leading = robust
        verb = "collides" if str(self.unsafe) == Outcome.COLLISION else "is unsafe"
        sentences.append(leading.finding(verb))
        if leading.robustness.borderline and robust:
            sentences.append(f"The robust failure with the fewest changes: {robust.finding(verb)}")
        elif leading.robustness.borderline:
            sentences.append("No failure tested is robust.")
        return [*sentences, *filter(None, [str(self.preventability)])]

    def sentences(self) -> list[str]:
        """The answer in sentences: the verdict as a paragraph, the counts, how the first failure ends, and the most
        frequent necessary changes and minimal cause of all failures.
        """
        sentences = [" ".join(self.verdict), self.counts]
        if not self.explanations:
            return sentences
        sentences.append(f"{self.explanations[0].name}: {self.explanations[0].endings}")
        if self.analysed and len(self.distinct):
            cause, _, share = next(self.distinct.itertuples(index=False))
            rows = self.necessity[self.necessity["necessary"] > 0].head(MAX_NECESSARY).to_dict("records")
            necessary = ", ".join(f"{row['characteristic']} {_necessary_share(row)}" for row in rows)
            sentences += [
                f"In every cause of a failure most often ({self.sample}): {necessary or 'no change is common to all'}.",
                f"{number_of(len(self.distinct), 'distinct minimal cause')}; the most frequent: "
                f"{', '.join(cause) or 'none'} ({100 * share:.0f} % of the failures).",
            ]
        return sentences

    def parts(self, subject: str, point: str = "", *, full: bool = False) -> Iterator[str | Table]:
        """The answer in about ten lines; `full` adds every chosen failure. Commands name `subject` and `point`."""
        yield from self.sentences()
        if not self.explanations:
            yield f"How far each characteristic may go: {question_command('tolerance', subject, point)}"
            return
        cause = self.explanations[0].cause
        if cause and cause.changes:
            yield f"Try it: {simulate_command(subject, cause.boundary, point)}"
        yield from constraints_in_words(self.study)
        if not full:
            command = f"{question_command('explain', subject, point)} --full"
            yield f"{number_of(len(self.explanations), 'failure')} explained in full: {command}"
            return
        for failure in self.explanations:
            yield from failure.details(subject, point)
        yield from self._statistics()

    def _statistics(self) -> Iterator[str | Table]:
        table = WholeTable(
            "characteristic",
            right=("changed", "necessary", "in some cause"),
            title=f"Changed vs. necessary ({self.sample})",
        )
        for row in self.necessity.to_dict("records"):
            shares = f"{100 * row['changed']:.0f} %", _necessary_share(row), f"{100 * row['involved']:.0f} %"
            table.add_row(row["characteristic"], *shares)
        yield table
        yield (
            "Shares of the failures. necessary: every minimal cause of a failure contains it, none does without; in "
            "some cause: at least one minimal cause contains it, others may do without. In brackets: 95 % intervals "
            f"for all {number_of(self.failures, 'failure')} (Clopper and Pearson's), where only a sample was analysed."
        )
        causes = WholeTable(
            "minimal cause", right=("failures", "share"), title=f"Distinct minimal causes: {len(self.distinct)}"
        )
        for cause, failures, share in self.distinct.head(MAX_DISTINCT_CAUSES).itertuples(index=False):
            causes.add_row(", ".join(cause) or "none: the original vehicle", str(failures), f"{100 * share:.0f} %")
        yield causes

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

    def to_frame(self) -> pd.DataFrame:
        """One row for each change of each minimal cause of each explanation.

        Columns: `failure`, counted from 0, `algorithm`, `run`, `index`, `cause`, counted from 0, `characteristic`,
        `unit`, `original`, `value`, `boundary`, `alone` [unit], `fraction`, `outcome`, `safety_degree` [m or -m/s],
        `robustness`, `whose`, the class `preventable` of the failure, and `points`, separated by semicolons.
        """
        rows = [
            (
                *(number, *(failure.handle or (None, None, None)), cause_number, item.name, item.unit, item.original),
                *(values[item.name] for values in (cause.changes, cause.boundary, cause.alone)),
                *(cause.fraction, cause.outcome, cause.safety_degree, failure.robustness.share),
                *(failure.preventable, "; ".join(failure.points)),
            )
            for number, failure in enumerate(self.explanations)
            for cause_number, cause in enumerate(failure.causes)
            for item in failure.characteristics
            if item.name in cause.changes
        ]
        columns = ["failure", "algorithm", "run", "index", "cause", "characteristic", "unit", "original"]
        columns += ["value", "boundary", "alone", "fraction", "outcome", SAFETY_DEGREE, "robustness", "whose", "points"]
        return pd.DataFrame(rows, columns=columns)

    def figure(self) -> Figure:
        """How often each characteristic is necessary, beside how often it is changed (as RQ3.2 counts)."""
        frame = self.necessity.iloc[::-1]  # bars are drawn from the bottom up
        size = (6.4, 1.4 + 0.3 * max(len(self.necessity), 4))
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
        figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=FONT_SIZE)
        return figure


def _necessary_share(row: Mapping[Any, Any]) -> str:
    """The share of failures that need a characteristic; with an interval if the failures are a sample."""
    low, high = row["necessary_lower"], row["necessary_upper"]
    interval = f" ({100 * low:.0f} % to {100 * high:.0f} %)" if low < high else ""
    return f"{100 * row['necessary']:.0f} %{interval}"


def situation_in_words(
    system: System, original: Evaluations, nearest: Evaluations | None = None, evaluated: str = ""
) -> str:
    """A sentence on the conditions and on how the original vehicle's run ends.

    If none of the `evaluated` vehicles collides, the sentence begins with that; `nearest` is the evaluation of the
    least safe of them.
    """
    place, ending = _place_in_words(system), _ending_in_words(system, original)
    if not nearest or nearest.collided[0] or original.collided[0] or RATING_POINTS.name in original.metrics:
        return f"{place}, the original vehicle {ending}."
    if nearest.outcome[0] == original.outcome[0]:
        # The verb is that of the worst vehicle.
        ending = distance_in_words(float(original.f_safe[0]), contact_degree(system))
    return (
        f"No collision in {evaluated}; the worst {_ending_in_words(system, nearest)}, "
        f"the original {ending}, {place[0].lower()}{place[1:]}."
    )


def study_verdict(case: Case, original: Evaluations) -> list[str]:
    """How a study ends, from its solutions: the situation, how many solutions are unsafe, and how little is enough."""
    system, unsafe, names = assemble(case.study), case.unsafe, list(case.characteristics.names)
    if original.collided[0] and not system.rater:
        return ["The original vehicle itself collides: no change is needed."]
    solutions = case.solutions.drop_duplicates(names)
    if solutions.empty:
        return ["No solution."]
    failures = solutions[unsafe.rows(solutions)].sort_values(CHOICES["fewest"], kind="stable")
    counts = f"{len(failures)} of {len(solutions)} {SOLUTIONS} are unsafe: {unsafe.description}."
    sentences = [f"{situation_in_words(system, original)} {counts}"]
    if len(failures):
        fewest = failures.iloc[0]
        ending = ending_in_words(fewest["outcome"], fewest["f_safe"], contact_degree(system))
        if system.rater:
            ending = f"keeps {fewest[RATING_POINTS.name]:.2f} points"
        changes = list_of_changes(case.characteristics, {name: float(fewest[name]) for name in names})
        sentences.append(f"With the fewest changes it {ending}: {changes}.")
    return sentences


def _place_in_words(system: System) -> str:
    """The weather, or the points of a matrix, as the beginning of a sentence."""
    points, weather = system.points, system.points[0].weather
    if system.matrix:
        return f"At the worst of {len(points)} test points" if len(points) > 1 else f"At {points[0].name}"
    return f"{weather_in_words(weather)}{' (which changes neither road nor sensors)' * equals_clear(weather)}"


def _ending_in_words(system: System, run: Evaluations) -> str:
    """How a run ends; `run` is the evaluation of a single setting."""
    degree, outcome = float(run.f_safe[0]), Outcome(str(run.outcome[0]))
    if RATING_POINTS.name in run.metrics:
        return f"earns {run.metrics[RATING_POINTS.name][0]:.2f} points"
    if outcome == Outcome.COLLISION:
        return f"itself collides, at {speed_in_words(degree)}"
    if outcome == Outcome.STOPPED and all(point.scenario.pre_crash.startswith("pedestrian") for point in system.points):
        return f"stops {degree:.2f} m short of the pedestrian"
    verb = OUTCOME_VERBS[outcome]
    if np.isnan(degree):
        return verb
    return f"{verb} with a safety degree of {distance_in_words(degree, contact_degree(system))}"
