"""Simulates minimal causes of failures again with the second vehicle model, and says how they end as frame and
sentences.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, get_args

import msgspec
import numpy as np
import pandas as pd

from safevar_sumo.analysis.case import Case
from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.explain.causes import MIN_ROBUST_SHARE, Cause, draw_neighbours
from safevar_sumo.analysis.explain.compute import explain_failures
from safevar_sumo.analysis.figures import FONT_SIZE, new_figure
from safevar_sumo.analysis.opinion import OpinionOptions
from safevar_sumo.analysis.opinion.multi_body import load_bmw_parameters
from safevar_sumo.analysis.opinion.second_vehicle import SPIN_LIMIT, SecondVehicle
from safevar_sumo.analysis.words import ending_in_words, join_phrases, list_of_changes, number_of
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Evaluations, FloatArray, JsonObject, finite_or_none
from safevar_sumo.study import Study
from safevar_sumo.sumo.empty_road import summary_entry
from safevar_sumo.sumo.matrix import contact_degree, evaluate
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.terminal import Answer, Progress, show_no_progress
from safevar_sumo.vehicles import CharacteristicSet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MODEL_IN_WORDS = "Driven again with CommonRoad's multi-body vehicle, Pacejka's tyres and anti-lock brakes"


Verdict = Literal["outside", "confirmed", "contradicted", "borderline"]
"""The second model's verdict on a cause."""


class RunEnd(msgspec.Struct, frozen=True):
    """How a run ends: outcome, safety degree [m, or -m/s], and where that is from centre to centre, gap between bodies
    [m]; None if there is none, or the run was not simulated.
    """

    outcome: str | None = None
    safety_degree: float | None = None
    gap: float | None = None

    def __str__(self) -> str:
        """Such as `collides at 3.21 m/s`."""
        if not self.outcome:
            return "was not driven"
        contact = 0.0 if self.safety_degree is None or self.gap is None else self.safety_degree - self.gap
        return ending_in_words(self.outcome, self.safety_degree, contact)


class Opinion(msgspec.Struct, frozen=True, kw_only=True):
    """The second model's opinion on one minimal cause, an entry of `opinion --json`.

    Attributes
    ----------
    solution
        The handle of the failure with this cause.
    changes
        The cause: values by name, in their units.
    here, there
        How the run with these changes ends: `here` with our model, `there` with the second model.
    opinion, because
        The verdict, and its reason in a sentence or two.
    """

    solution: str
    changes: dict[str, float]
    here: RunEnd
    there: RunEnd
    opinion: Verdict
    because: str


@dataclass(frozen=True, kw_only=True, repr=False)
class Opinions(Answer):
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

    def to_dict(self) -> list[JsonObject]:
        """The JSON of `opinion`."""
        return [*map(msgspec.to_builtins, self.opinions), *summary_entry(self.no_verdict)]

    def to_frame(self) -> pd.DataFrame:
        """One row for each cause: the keys of `to_dict`, with outcome and safety degree of `here` and `there`."""
        astuple = msgspec.structs.astuple
        rows = [
            (item.solution, item.changes, *astuple(item.here), *astuple(item.there), item.opinion, item.because)
            for item in self.opinions
        ]
        ends = [f"{key}_{side}" for side in ("here", "there") for key in RunEnd.__struct_fields__]
        return pd.DataFrame(rows, columns=["solution", "changes", *ends, "opinion", "because"])

    @property
    def counts(self) -> str:
        """The number of causes with each verdict."""
        numbers = Counter(item.opinion for item in self.opinions)
        counts = [
            f"{numbers[verdict]} {verdict}{' (no answer)' if verdict == 'outside' else ''}"
            for verdict in get_args(Verdict)
            if verdict in numbers
        ]
        total = number_of(len(self.opinions), "minimal cause")
        return f"of {total} {join_phrases(counts)}" if counts else "there is no cause to judge"

    @property
    def notes(self) -> list[str]:
        """The solutions that are not unsafe."""
        return [f"{handle} is not unsafe: it has no cause" for handle in self.without_cause]

    def sentences(self) -> list[str]:
        """The answer as lines: how many causes are confirmed, then every cause with the reason."""
        characteristics = CharacteristicSet.of(self.study)
        lines = [
            f"Unsafe: {self.unsafe.description}. {MODEL_IN_WORDS}: {self.counts}.",
            f"The original vehicle {self.original_here} with our model; it {self.original_there} with the second.",
            *(f"note: {note}" for note in self.notes),
        ]
        for item in self.opinions:
            lines += [
                f"{item.solution}: {item.opinion}: {list_of_changes(characteristics, item.changes)}",
                f"  With our model it {item.here}; {item.because}.",
            ]
        return lines

    def figure(self) -> Figure:
        """The safety degree of each cause with both models; on the line they agree."""
        figure, ((axis,),) = new_figure(f"{self.study.name}: causes with two vehicle models", 1, 1, (4.6, 4.0))
        driven = self.to_frame().dropna(subset=["safety_degree_here", "safety_degree_there"])
        for verdict, marker in zip(get_args(Verdict), "xos^", strict=True):
            causes = driven[driven["opinion"] == verdict]
            if len(causes):
                axis.plot("safety_degree_here", "safety_degree_there", marker, data=causes, label=verdict)
        axis.axline((0, 0), slope=1, color="black", linewidth=0.8, linestyle="--")
        axis.set_xlabel("safety degree with our model [m, or -m/s]")
        axis.set_ylabel("with the second model [m, or -m/s]")
        if len(driven):
            axis.legend(fontsize=FONT_SIZE)
        return figure


SIMULATION_LIMIT = 12_000
"""Approximate number of simulations of the search for minimal causes, the same as for a report."""
STAGE = "second vehicle model"
CHANGE_SHARES = np.arange(1, 10) / 10
"""Shares of a cause's changes that the second model simulates, to locate the share from which they are unsafe."""


def assemble_both_systems(study: Study) -> tuple[System, SecondVehicle]:
    """A study's system, and the second vehicle, which can replace the system's.

    The driving system stays the same, including its knowledge of our original vehicle.

    Raises
    ------
    InputError
        If commonroad-vehicle-models is not installed, or the second model cannot represent the vehicle at all.
    """
    load_bmw_parameters()  # raises the error if the package is not installed
    system = assemble(study)
    return system, SecondVehicle(system.vehicle, study)


def ask_for_opinions(source: Study | Case, options: OpinionOptions, evaluator: Evaluator) -> Opinions:
    """Find the minimal causes of the failures that a report explains, or of named solutions, and judge them.

    Raises
    ------
    InputError
        If `assemble_both_systems` or `explain_failures` raises it, or `source` is a study, which has no failures yet.
    """
    if isinstance(source, Study):
        raise InputError(
            source.origin.called or source.name,
            "is a study and has no solutions",
            "a directory that the command `study` has written",
        )
    assemble_both_systems(source.study)
    explain_options = ExplainOptions(solutions=options.solutions, unsafe=options.unsafe, limit=SIMULATION_LIMIT, fits=0)
    explained = explain_failures(source, explain_options, evaluator)
    causes = [(failure.name, cause) for failure in explained.explanations for cause in failure.causes]
    return replace(
        judge_causes(source.study, causes, explained.unsafe, evaluator.progress),
        no_verdict=explained.no_verdict,
        without_cause=tuple(failure.name for failure in explained.explanations if not failure.causes),
    )


def judge_causes(
    study: Study, causes: Sequence[tuple[str, Cause]], unsafe: Unsafe, progress: Progress = show_no_progress
) -> Opinions:
    """Simulate minimal causes of solutions, named by their handles, with both models and judge them.

    Raises the errors of `assemble_both_systems`.
    """
    system, vehicle = assemble_both_systems(study)
    second_system, characteristics = replace(system, vehicle=vehicle), system.characteristics
    original = characteristics.original
    settings = np.stack([original, *(cause.setting(characteristics) for _, cause in causes)])
    progress(STAGE, 0, len(settings))
    # Shares of each setting's changes, one setting after the other; shape (settings times shares, n).
    scaled = (original + CHANGE_SHARES[:, np.newaxis] * (settings - original)[:, np.newaxis]).reshape(-1, len(original))
    ours, theirs = evaluate(system, settings), evaluate(second_system, np.concatenate([settings, scaled]))
    contact = contact_degree(system)
    here, there, fails_there = *(_run_ends(runs, contact) for runs in (ours, theirs)), unsafe.of(theirs)
    fails_scaled = fails_there[len(settings) :].reshape(len(settings), -1)

    def judge(row: int, cause: Cause) -> tuple[Verdict, str]:
        """The verdict on a cause, and its reason."""
        if reasons := vehicle.reasons_to_omit(cause.changes):
            return "outside", "; ".join(reasons)
        if unsafe.of(ours)[0]:
            return "outside", "the original vehicle itself is unsafe, so that no change is a cause"
        if fails_there[0] or not theirs.valid[0]:
            return "outside", f"the original vehicle itself is not safe with the second model: it {there[0]}"
        if not theirs.valid[row]:
            return "outside", f"with the second model it {there[row]}"
        if settings[row].tobytes() in vehicle.spinning:  # filled by `evaluate(second_system, ...)` above
            return "outside", f"its wheels spin with the second model, more than {SPIN_LIMIT:g} m/s faster than the car"
        verdict: Verdict = "contradicted"
        because = f"safe with the second model: it {there[row]}; the original vehicle {there[0]}"
        if fails_there[row]:
            verdict = "confirmed"
            safe_share = np.max(CHANGE_SHARES, initial=0.0, where=~fails_scaled[row])  # the largest that is still safe
            because = (
                f"also unsafe with the second model: it {there[row]}; the original vehicle is safe: it {there[0]}. "
                f"{safe_share:.0%} to {safe_share + CHANGE_SHARES[0]:.0%} of the changes are enough with the second "
                f"model, {cause.fraction:.1%} with ours"
            )
        reason = _why_borderline(second_system, settings[row], cause, fails_there[row], unsafe, study.search.seed)
        return ("borderline", f"{reason}; {because}") if reason else (verdict, because)

    opinions = []
    for row, (solution, cause) in enumerate(causes, 1):
        verdict, because = judge(row, cause)
        end = RunEnd() if vehicle.reasons_to_omit(cause.changes) else there[row]
        opinion = Opinion(
            solution=solution, changes=cause.changes, here=here[row], there=end, opinion=verdict, because=because
        )
        opinions.append(opinion)
        progress(STAGE, row + 1, len(settings))
    return Opinions(
        study=study, unsafe=unsafe, opinions=tuple(opinions), original_here=here[0], original_there=there[0]
    )


def _why_borderline(
    second_system: System, setting: FloatArray, cause: Cause, is_unsafe: bool, unsafe: Unsafe, seed: int
) -> str:
    """Why a cause is borderline, by its neighbours in our model, else in the second; empty if it is not."""
    if cause.neighbours is None:  # in a rated study, whose neighbours take too long
        return ""
    if cause.neighbours.borderline:
        return f"with our model {cause.neighbours}"
    neighbours = draw_neighbours(second_system.characteristics, setting[np.newaxis], seed)
    runs = evaluate(second_system, neighbours[second_system.region.feasible(neighbours)])
    share = np.mean((unsafe.of(runs) == is_unsafe)[runs.valid]) if runs.valid.any() else 0.0
    result = "unsafe" if is_unsafe else "safe"
    if share >= MIN_ROBUST_SHARE:
        return ""
    return f"with the second model only {share:.0%} of the neighbours are {result}, too"


def _run_ends(runs: Evaluations, contact: float) -> list[RunEnd]:
    """How runs end; bodies touch at a safety degree of `contact` [m]."""
    gaps = runs.gaps(contact) if contact else np.full(len(runs), np.nan)
    return [
        RunEnd(str(outcome), finite_or_none(degree), finite_or_none(gap))
        for outcome, degree, gap in zip(runs.outcome, runs.f_safe, gaps, strict=True)
    ]
