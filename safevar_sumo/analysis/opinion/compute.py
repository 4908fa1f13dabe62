"""Simulates minimal causes of failures again with the second vehicle model, and for each the largest share of its changes that is safe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.evaluator import Progress, open_evaluator, show_no_progress
from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.explain.causes import RESOLUTION, find_boundaries
from safevar_sumo.analysis.explain.compute import choose_failures
from safevar_sumo.analysis.opinion import OpinionOptions
from safevar_sumo.analysis.opinion.mapping import VehicleMapping, map_vehicle
from safevar_sumo.analysis.opinion.multi_body import load_bmw_parameters
from safevar_sumo.analysis.opinion.result import Opinion, Opinions, OpinionVerdict, RunEnd
from safevar_sumo.analysis.opinion.second_vehicle import SecondVehicle
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, finite_or_none
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.workers.evaluation import Pool

SIMULATION_LIMIT = 12_000
"""Approximate number of simulations that search the minimal causes, the same as for a report."""
REDUCTIONS = np.array([RESOLUTION, 2 * RESOLUTION, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0])
"""Relative reductions below a cause's boundary at which the nearest safe setting is searched."""
CHANGE_SHARES = np.arange(1, 10) / 10
"""Shares of a cause's changes that the second model simulates, to locate the share from which they are unsafe."""


class CauseToJudge(NamedTuple):
    """A minimal cause, and its boundary: the share of its changes above which it is unsafe with our model."""

    solution: str | None
    changes: Mapping[str, float]
    fraction: float


class NearestSafeSetting(NamedTuple):
    """The nearest setting below a cause's boundary that is safe with our model, shape (n,), and its share of the cause's changes."""

    setting: FloatArray
    share: float


def assemble_both_systems(study: Study) -> tuple[System, System, VehicleMapping]:
    """Assemble a study's system, and the same with the second vehicle model; the third value is the vehicle's mapping to that model.

    Both systems have the same driving system, including its knowledge of our original vehicle.

    Raises
    ------
    InputError
        If commonroad-vehicle-models is not installed, or the second model cannot represent the vehicle at all.
    """
    load_bmw_parameters()  # raises the error if the package is not installed
    system = assemble(study)
    mapping = map_vehicle(study, system.vehicle)
    return system, replace(system, vehicle=SecondVehicle(system.vehicle, mapping, study)), mapping


def ask_for_opinions(source: Study | Case, options: OpinionOptions, *, pool: Pool | None = None, jobs: int | None = None,
                     progress: Progress = show_no_progress) -> Opinions:
    """Find the minimal causes of the failures that a report explains, or of named solutions, and let the second model judge them.

    Raises
    ------
    InputError
        If `assemble_both_systems` or `choose_failures` raises it, or if `source` is a study, which has no failures yet.
    """
    if isinstance(source, Study):
        raise InputError(source.origin.called or source.name, "is a study and has no solutions",
                         "a directory that the command `study` has written")
    assemble_both_systems(source.study)
    explain_options = ExplainOptions(solutions=options.solutions, unsafe=options.unsafe, limit=SIMULATION_LIMIT)
    with open_evaluator(source.study, pool, jobs, progress) as evaluator:
        selection = choose_failures(source, explain_options, evaluator)
        evaluated, rows = selection.evaluated, list(selection.choice_reasons)
        minimal_causes = [(str(evaluated.handles[row]), cause) for row in rows for cause in selection.causes[row]]
        limits = find_boundaries(evaluator, [cause for _, cause in minimal_causes], evaluated.unsafe)
    characteristic_names = evaluator.characteristics.names
    causes = [CauseToJudge(handle, {characteristic_names[column]: float(cause.setting[column]) for column in cause.columns}, limit.fraction)
              for (handle, cause), limit in zip(minimal_causes, limits, strict=True)]
    opinions = judge_causes(source.study, causes, evaluated.unsafe, progress)
    return replace(opinions, without_cause=tuple(str(evaluated.handles[row]) for row in rows if not selection.causes[row]))


def judge_causes(study: Study, causes: Sequence[CauseToJudge], unsafe: Unsafe, progress: Progress = show_no_progress) -> Opinions:
    """Simulate minimal causes with both models and judge them; raises the errors of `assemble_both_systems`."""
    system, second, mapping = assemble_both_systems(study)
    characteristics = system.characteristics
    settings = np.stack([characteristics.original, *(characteristics.setting(cause.changes, "cause", beyond=True) for cause in causes)])
    stage, setting_count = "second vehicle model", len(settings)
    progress(stage, 0, setting_count)
    our_runs = evaluate(system, settings)
    safe_settings = _find_safe_settings(system, causes, settings[1:], unsafe)
    scaled_settings = characteristics.original + CHANGE_SHARES[:, np.newaxis, np.newaxis] * (settings[1:] - characteristics.original)
    settings_below = np.stack([safe_setting.setting for safe_setting in safe_settings]) if safe_settings else settings[1:]
    second_runs = evaluate(second, np.concatenate([settings, settings_below, scaled_settings.reshape(-1, len(characteristics))]))
    progress(stage, setting_count, setting_count)
    our_ends, second_ends = ([_run_end(runs, row) for row in range(setting_count)] for runs in (our_runs, second_runs))
    fails_with_ours, fails_with_second = unsafe.of(our_runs), unsafe.of(second_runs)
    original = _Original(our_ends[0], second_ends[0], bool(fails_with_ours[0]), bool(fails_with_second[0] or not second_runs.valid[0]))
    fails_below = fails_with_second[setting_count:setting_count + len(causes)]
    scaled_fails = fails_with_second[setting_count + len(causes):].reshape(len(CHANGE_SHARES), len(causes))
    opinions = []
    for index, (cause, safe_setting) in enumerate(zip(causes, safe_settings, strict=True)):
        row = index + 1  # row 0 is the original vehicle
        comparison = (f"The nearest setting that is safe with our model, {safe_setting.share:.1%} of the changes, is "
                      f"{'unsafe' if fails_below[index] else 'safe'} with the second. {_failing_shares(scaled_fails[:, index])} "
                      f"of the changes are enough with the second model, {cause.fraction:.1%} with ours.")
        fails = bool(fails_with_second[row]) if second_runs.valid[row] else None
        opinions.append(_judge(cause, mapping, original, our_ends[row], second_ends[row], fails, comparison))
    return Opinions(study=study, unsafe=unsafe, opinions=tuple(opinions), original_here=our_ends[0], original_there=second_ends[0])


def _failing_shares(fails: BoolArray) -> str:
    """The shares of a cause's changes between which it becomes unsafe, such as `40% to 50%`."""
    safe_indices = np.flatnonzero(~fails)
    lower_share = CHANGE_SHARES[safe_indices[-1]] if len(safe_indices) else 0.0
    return f"{lower_share:.0%} to {lower_share + CHANGE_SHARES[0]:.0%}"


class _Original(NamedTuple):
    """How the original vehicle's run ends with each model, and whether that run is unsafe."""

    our_end: RunEnd
    second_end: RunEnd
    fails_with_ours: bool
    fails_with_second: bool


def _judge(cause: CauseToJudge, mapping: VehicleMapping, original: _Original, our_end: RunEnd, second_end: RunEnd, fails: bool | None,
           comparison: str) -> Opinion:
    """The opinion on a cause; `fails` states whether the cause is unsafe with the second model, None if it could not be simulated."""
    def conclude(verdict: OpinionVerdict, reason: str, second_end: RunEnd = second_end) -> Opinion:
        return Opinion(solution=cause.solution, changes=dict(cause.changes), here=our_end, there=second_end, opinion=verdict,
                       because=reason)

    if reasons := mapping.reasons_to_omit(cause.changes):
        return conclude(OpinionVerdict.OUTSIDE, "; ".join(reasons), RunEnd())
    if original.fails_with_ours:
        return conclude(OpinionVerdict.OUTSIDE, "the original vehicle itself is unsafe, so that no change is a cause")
    if original.fails_with_second:
        return conclude(OpinionVerdict.OUTSIDE, f"the original vehicle itself is not safe with the second model: {original.second_end}")
    if fails is None:
        return conclude(OpinionVerdict.OUTSIDE, f"it could not be simulated with the second model: {second_end}")
    if fails:
        return conclude(OpinionVerdict.CONFIRMED, f"also unsafe with the second model: {second_end}; the original vehicle is safe: "
                                                  f"{original.second_end}. {comparison}")
    return conclude(OpinionVerdict.CONTRADICTED, f"safe with the second model: {second_end}; the original vehicle: {original.second_end}")


def _find_safe_settings(system: System, causes: Sequence[CauseToJudge], settings: FloatArray, unsafe: Unsafe) -> list[NearestSafeSetting]:
    """For each cause, the first setting below its boundary that is safe with our model; the original setting if there is none."""
    if not causes:
        return []
    original = system.characteristics.original
    shares = np.array([cause.fraction * (1 - REDUCTIONS) for cause in causes])
    candidates = original + shares[..., np.newaxis] * (settings - original)[:, np.newaxis]
    evaluations = evaluate(system, candidates.reshape(-1, len(original)))
    is_safe = (evaluations.valid & ~unsafe.of(evaluations)).reshape(shares.shape)
    is_safe[:, -1] = True
    nearest = np.argmax(is_safe, axis=1).tolist()
    return [NearestSafeSetting(candidates[row, column], float(shares[row, column])) for row, column in enumerate(nearest)]


def _run_end(evaluations: Evaluations, row: int) -> RunEnd:
    return RunEnd(str(evaluations.outcome[row]), finite_or_none(evaluations.f_safe[row]))
