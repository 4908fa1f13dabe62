"""Simulates minimal causes of failures again with the second vehicle model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.explain.compute import explain_failures
from safevar_sumo.analysis.explain.robustness import draw_neighbours, is_borderline, robustness_in_words
from safevar_sumo.analysis.opinion import OpinionOptions
from safevar_sumo.analysis.opinion.multi_body import load_bmw_parameters
from safevar_sumo.analysis.opinion.result import Opinion, Opinions, RunEnd, Verdict
from safevar_sumo.analysis.opinion.second_vehicle import SPIN_LIMIT, SecondVehicle
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, finite_or_none
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.terminal import Progress, show_no_progress

SIMULATION_LIMIT = 12_000
"""Approximate number of simulations that search the minimal causes, the same as for a report."""
CHANGE_SHARES = np.arange(1, 10) / 10
"""Shares of a cause's changes that the second model simulates, to locate the share from which they are unsafe."""


class CauseToJudge(NamedTuple):
    """A minimal cause of a solution; `fraction` and `robustness` say of our model what `explain` says of the cause."""

    solution: str | None
    changes: Mapping[str, float]
    fraction: float
    robustness: float | None


def assemble_both_systems(study: Study) -> tuple[System, SecondVehicle]:
    """Assemble a study's system; with the second value as its vehicle, it simulates with the second model.

    The driving system stays the same, including its knowledge of our original vehicle.

    Raises
    ------
    InputError
        If commonroad-vehicle-models is not installed, or the second model cannot represent the vehicle at all.
    """
    load_bmw_parameters()  # raises the error if the package is not installed
    system = assemble(study)
    return system, SecondVehicle(system.vehicle, study)


def ask_for_opinions(
    source: Study | Case,
    options: OpinionOptions,
    *,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: Progress = show_no_progress,
) -> Opinions:
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
    explain_options = ExplainOptions(solutions=options.solutions, unsafe=options.unsafe, limit=SIMULATION_LIMIT)
    explained = explain_failures(source, explain_options, pool=pool, jobs=jobs, progress=progress)
    causes = [
        CauseToJudge(str(failure.handle), cause.changes, cause.fraction, cause.robustness)
        for failure in explained.explanations
        for cause in failure.causes
    ]
    return replace(
        judge_causes(source.study, causes, explained.unsafe, progress),
        no_verdict=explained.no_verdict,
        without_cause=tuple(str(failure.handle) for failure in explained.explanations if not failure.causes),
    )


def judge_causes(
    study: Study, causes: Sequence[CauseToJudge], unsafe: Unsafe, progress: Progress = show_no_progress
) -> Opinions:
    """Simulate minimal causes with both models and judge them; raises the errors of `assemble_both_systems`."""
    system, vehicle = assemble_both_systems(study)
    second, original, stage = replace(system, vehicle=vehicle), system.characteristics.original, "second vehicle model"
    changed = [system.characteristics.setting(cause.changes, "cause", beyond=True) for cause in causes]
    settings = np.stack([original, *changed])
    progress(stage, 0, len(settings))
    scaled = (original + CHANGE_SHARES[:, np.newaxis] * (settings - original)[:, np.newaxis]).reshape(-1, len(original))
    ours, theirs = evaluate(system, settings), evaluate(second, np.concatenate([settings, scaled]))
    fails_here, fails_there = unsafe.of(ours), unsafe.of(theirs)
    fails_scaled = fails_there[len(settings) :].reshape(len(settings), -1)
    (original_here, *ends_here), (original_there, *ends_there) = _run_ends(ours), _run_ends(theirs)
    opinions = []
    for row, (cause, here, there) in enumerate(zip(causes, ends_here, ends_there, strict=False), 1):
        verdict: Verdict = "outside"
        if reasons := vehicle.reasons_to_omit(cause.changes):
            because, there = "; ".join(reasons), RunEnd()
        elif fails_here[0]:
            because = "the original vehicle itself is unsafe, so that no change is a cause"
        elif fails_there[0] or not theirs.valid[0]:
            because = f"the original vehicle itself is not safe with the second model: {original_there}"
        elif not theirs.valid[row]:
            because = f"it could not be simulated with the second model: {there}"
        elif settings[row].tobytes() in vehicle.spinning:
            because = f"its wheels spin with the second model, more than {SPIN_LIMIT:g} m/s faster than the car"
        else:
            verdict = "contradicted"
            because = f"safe with the second model: {there}; the original vehicle: {original_there}"
            if fails_there[row]:
                verdict, because = (
                    "confirmed",
                    (
                        f"also unsafe with the second model: {there}; the original vehicle is safe: {original_there}. "
                        f"{_failing_shares(fails_scaled[row])} of the changes are enough with the second model, "
                        f"{cause.fraction:.1%} with ours"
                    ),
                )
            if doubt := _doubt(second, settings[row], cause.robustness, fails_there[row], unsafe, study.search.seed):
                verdict, because = "borderline", f"{doubt}; {because}"
        opinions.append(
            Opinion(
                solution=cause.solution,
                changes=dict(cause.changes),
                here=here,
                there=there,
                opinion=verdict,
                because=because,
            )
        )
        progress(stage, row + 1, len(settings))
    return Opinions(
        study=study, unsafe=unsafe, opinions=tuple(opinions), original_here=original_here, original_there=original_there
    )


def _doubt(
    second: System, setting: FloatArray, our_robustness: float | None, is_unsafe: bool, unsafe: Unsafe, seed: int
) -> str:
    """In which model a cause is borderline; empty if in none, or in a rated study, whose neighbours take too long."""
    if our_robustness is None:
        return ""
    if is_borderline(our_robustness):
        return f"with our model {robustness_in_words(our_robustness)}"
    neighbours = draw_neighbours(second.characteristics, setting[np.newaxis], seed)
    runs = evaluate(second, neighbours[second.region.feasible(neighbours)])
    same = (unsafe.of(runs) == is_unsafe)[runs.valid]
    share = int(np.sum(same)) / max(len(same), 1)
    result = "unsafe" if is_unsafe else "safe"
    return f"with the second model only {share:.0%} of the neighbours are {result}, too" if is_borderline(share) else ""


def _failing_shares(fails: BoolArray) -> str:
    """The shares of a cause's changes between which it becomes unsafe, such as `40% to 50%`."""
    lower_share = np.max(CHANGE_SHARES, initial=0.0, where=~fails)
    return f"{lower_share:.0%} to {lower_share + CHANGE_SHARES[0]:.0%}"


def _run_ends(runs: Evaluations) -> list[RunEnd]:
    return [RunEnd(str(end), finite_or_none(degree)) for end, degree in zip(runs.outcome, runs.f_safe, strict=True)]
