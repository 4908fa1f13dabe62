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
from safevar_sumo.analysis.opinion.mapping import map_vehicle
from safevar_sumo.analysis.opinion.multi_body import load_bmw_parameters
from safevar_sumo.analysis.opinion.result import Opinion, Opinions, OpinionVerdict, RunEnd
from safevar_sumo.analysis.opinion.second_vehicle import SPIN_LIMIT, SecondVehicle
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.progress import Progress, show_no_progress
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, finite_or_none
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.workers.evaluation import Pool

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


def assemble_both_systems(study: Study) -> tuple[System, System, SecondVehicle]:
    """Assemble a study's system, and the same with the second vehicle model; the third value is that model's vehicle.

    Both systems have the same driving system, including its knowledge of our original vehicle.

    Raises
    ------
    InputError
        If commonroad-vehicle-models is not installed, or the second model cannot represent the vehicle at all.
    """
    load_bmw_parameters()  # raises the error if the package is not installed
    system = assemble(study)
    vehicle = SecondVehicle(system.vehicle, map_vehicle(study, system.vehicle), study)
    return system, replace(system, vehicle=vehicle), vehicle


def ask_for_opinions(source: Study | Case, options: OpinionOptions, *, pool: Pool | None = None, jobs: int | None = None,
                     progress: Progress = show_no_progress) -> Opinions:
    """Find the minimal causes of the failures that a report explains, or of named solutions, and let the second model judge them.

    Raises
    ------
    InputError
        If `assemble_both_systems` or `explain_failures` raises it, or if `source` is a study, which has no failures yet.
    """
    if isinstance(source, Study):
        raise InputError(source.origin.called or source.name, "is a study and has no solutions",
                         "a directory that the command `study` has written")
    assemble_both_systems(source.study)
    explain_options = ExplainOptions(solutions=options.solutions, unsafe=options.unsafe, limit=SIMULATION_LIMIT)
    explained = explain_failures(source, explain_options, pool=pool, jobs=jobs, progress=progress)
    causes = [CauseToJudge(str(failure.handle), cause.changes, cause.fraction, cause.robustness)
              for failure in explained.explanations for cause in failure.causes]
    opinions = judge_causes(source.study, causes, explained.unsafe, progress)
    return replace(opinions, without_cause=tuple(str(failure.handle) for failure in explained.explanations if not failure.causes))


def judge_causes(study: Study, causes: Sequence[CauseToJudge], unsafe: Unsafe, progress: Progress = show_no_progress) -> Opinions:
    """Simulate minimal causes with both models and judge them; raises the errors of `assemble_both_systems`."""
    system, second, vehicle = assemble_both_systems(study)
    original, stage = system.characteristics.original, "second vehicle model"
    settings = np.stack([original, *(system.characteristics.setting(cause.changes, "cause", beyond=True) for cause in causes)])
    progress(stage, 0, len(settings))
    scaled_settings = (original + CHANGE_SHARES[:, np.newaxis] * (settings - original)[:, np.newaxis]).reshape(-1, len(original))
    ours, theirs = evaluate(system, settings), evaluate(second, np.concatenate([settings, scaled_settings]))
    fails_here, fails_there = unsafe.of(ours), unsafe.of(theirs)
    fails_scaled = fails_there[len(settings):].reshape(len(settings), -1)
    original_here, original_there = _run_end(ours, 0), _run_end(theirs, 0)

    def judge(row: int, cause: CauseToJudge, there: RunEnd) -> tuple[OpinionVerdict, str]:
        if reasons := vehicle.mapping.reasons_to_omit(cause.changes):
            return OpinionVerdict.OUTSIDE, "; ".join(reasons)
        if fails_here[0]:
            return OpinionVerdict.OUTSIDE, "the original vehicle itself is unsafe, so that no change is a cause"
        if fails_there[0] or not theirs.valid[0]:
            problem = "the original vehicle itself is not safe with the second model"
            return OpinionVerdict.OUTSIDE, f"{problem}: {original_there}"
        if not theirs.valid[row]:
            return OpinionVerdict.OUTSIDE, f"it could not be simulated with the second model: {there}"
        if settings[row].tobytes() in vehicle.spinning:
            problem = "its wheels spin with the second model"
            return OpinionVerdict.OUTSIDE, f"{problem}, more than {SPIN_LIMIT:g} m/s faster than the car"
        doubt = _doubt(second, settings[row], cause.robustness, bool(fails_there[row]), unsafe, study.search.seed)
        verdict = OpinionVerdict.CONFIRMED if fails_there[row] else OpinionVerdict.CONTRADICTED
        because = f"safe with the second model: {there}; the original vehicle: {original_there}"
        if fails_there[row]:
            because = (f"also unsafe with the second model: {there}; the original vehicle is safe: {original_there}. "
                       f"{_failing_shares(fails_scaled[row])} of the changes are enough with the second model, "
                       f"{cause.fraction:.1%} with ours")
        return (OpinionVerdict.BORDERLINE, f"{doubt}; {because}") if doubt else (verdict, because)

    opinions = []
    for row, cause in enumerate(causes, 1):
        there = RunEnd() if vehicle.mapping.reasons_to_omit(cause.changes) else _run_end(theirs, row)
        verdict, because = judge(row, cause, there)
        opinions.append(Opinion(solution=cause.solution, changes=dict(cause.changes), here=_run_end(ours, row), there=there,
                                opinion=verdict, because=because))
        progress(stage, row, len(settings))
    progress(stage, len(settings), len(settings))
    return Opinions(study=study, unsafe=unsafe, opinions=tuple(opinions), original_here=original_here, original_there=original_there)


def _doubt(second: System, setting: FloatArray, our_robustness: float | None, is_unsafe: bool, unsafe: Unsafe, seed: int) -> str:
    """In which model a cause is borderline; empty if in neither. A rated study's neighbours, without a robustness, are not simulated."""
    if our_robustness is None:
        return ""
    if is_borderline(our_robustness):
        return f"with our model {robustness_in_words(our_robustness)}"
    neighbours = draw_neighbours(second.characteristics, setting[np.newaxis], seed)
    evaluations = evaluate(second, neighbours[second.region.feasible(neighbours)])
    same = (unsafe.of(evaluations) == is_unsafe)[evaluations.valid]
    same_share = float(np.count_nonzero(same)) / max(len(same), 1)
    word = "unsafe" if is_unsafe else "safe"
    return f"with the second model only {same_share:.0%} of the neighbours are {word}, too" if is_borderline(same_share) else ""


def _failing_shares(fails: BoolArray) -> str:
    """The shares of a cause's changes between which it becomes unsafe, such as `40% to 50%`."""
    safe_indices = np.flatnonzero(~fails)
    lower_share = CHANGE_SHARES[safe_indices[-1]] if len(safe_indices) else 0.0
    return f"{lower_share:.0%} to {lower_share + CHANGE_SHARES[0]:.0%}"


def _run_end(evaluations: Evaluations, row: int) -> RunEnd:
    return RunEnd(str(evaluations.outcome[row]), finite_or_none(evaluations.f_safe[row]))
