"""Drives the minimal causes of failures and their nearest safe neighbours again, with the second vehicle model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.evaluator import Progress, open_evaluator, silent
from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.explain.causes import RESOLUTION, boundaries
from safevar_sumo.analysis.explain.compute import chosen_failures
from safevar_sumo.analysis.opinion import OpinionOptions
from safevar_sumo.analysis.opinion.mapping import Declared, declared_of
from safevar_sumo.analysis.opinion.multi_body import commonroad
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

LIMIT = 12_000
"""Approximate number of simulations for the minimal causes, as for a report."""
BELOW = np.array([RESOLUTION, 2 * RESOLUTION, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0])
"""Relative reductions of a cause's boundary at which its nearest safe neighbour is searched."""

LADDER = np.arange(1, 10) / 10
"""Shares of a cause's changes at which the second model is tried, to find where it begins to be unsafe."""


class JudgedCause(NamedTuple):
    """A minimal cause for the second model to judge: its values, and its boundary as a share of its changes."""

    solution: str | None
    changes: Mapping[str, float]
    fraction: float


class Neighbour(NamedTuple):
    """The nearest setting below a cause that is safe with our model, shape (n,), and its share of the changes."""

    setting: FloatArray
    share: float


def second_system(study: Study) -> tuple[System, System, Declared]:
    """A study's system, the same system with the second vehicle model, and that model's representation of the vehicle.

    The driving system is the same, including its knowledge of our original vehicle.

    Raises
    ------
    InputError
        If commonroad-vehicle-models is not installed, or the second model cannot represent the vehicle at all.
    """
    commonroad()
    system = assemble(study)
    declared = declared_of(study, system.vehicle)
    return system, replace(system, vehicle=SecondVehicle(system.vehicle, declared, study)), declared


def ask_for_opinions(source: Study | Case, options: OpinionOptions, *, pool: Pool | None = None, jobs: int | None = None,
                     progress: Progress = silent) -> Opinions:
    """Find the minimal causes of the failures that a report explains, or of named solutions, and let the second model judge them.

    Raises
    ------
    InputError
        As `second_system` and `chosen_failures`, and if `source` is a study, which has no failures yet.
    """
    if isinstance(source, Study):
        raise InputError(source.origin.called or source.name, "is a study and has no solutions",
                         "a directory that the command study has written")
    second_system(source.study)
    explain_options = ExplainOptions(solutions=options.solutions, unsafe=options.unsafe, limit=LIMIT)
    with open_evaluator(source.study, pool, jobs, progress) as evaluator:
        chosen = chosen_failures(source, explain_options, evaluator)
        minimal = [(str(chosen.failures.handles[row]), cause) for row in chosen.reasons for cause in chosen.causes[row]]
        limits = boundaries(evaluator, [cause for _, cause in minimal], chosen.failures.unsafe)
    names = evaluator.characteristics.names
    causes = [JudgedCause(handle, {names[column]: float(cause.setting[column]) for column in cause.columns}, limit.fraction)
              for (handle, cause), limit in zip(minimal, limits, strict=True)]
    opinions = opinions_of(source.study, causes, chosen.failures.unsafe, progress)
    return replace(opinions, without_cause=tuple(str(chosen.failures.handles[row]) for row in chosen.reasons if not chosen.causes[row]))


def opinions_of(study: Study, causes: Sequence[JudgedCause], unsafe: Unsafe, progress: Progress = silent) -> Opinions:
    """The second model's opinions on minimal causes; raises as `second_system`."""
    system, second, declared = second_system(study)
    members = system.characteristics
    settings = np.stack([members.original, *(members.setting(cause.changes, "cause", beyond=True) for cause in causes)])
    stage, number = "second vehicle model", len(settings)
    progress(stage, 0, number)
    here = evaluate(system, settings)
    neighbours = _neighbours(system, causes, settings[1:], unsafe)
    scaled = members.original + LADDER[:, np.newaxis, np.newaxis] * (settings[1:] - members.original)
    beside = np.stack([one.setting for one in neighbours]) if neighbours else settings[1:]
    there = evaluate(second, np.concatenate([settings, beside, scaled.reshape(-1, len(members))]))
    progress(stage, number, number)
    ends_here, ends_there = ([_end(evaluations, row) for row in range(number)] for evaluations in (here, there))
    fails_here, fails_there = unsafe.of(here), unsafe.of(there)
    original = _Original(ends_here[0], ends_there[0], bool(fails_here[0]), bool(fails_there[0] or not there.valid[0]))
    fails_beside = fails_there[number:number + len(causes)]
    fails_scaled = fails_there[number + len(causes):].reshape(len(LADDER), len(causes))
    opinions = []
    for k, (cause, neighbour) in enumerate(zip(causes, neighbours, strict=True)):
        words = (f"The nearest setting that is safe with our model, {neighbour.share:.1%} of the changes, is "
                 f"{'unsafe' if fails_beside[k] else 'safe'} with the second: with it {_first_unsafe_step(fails_scaled[:, k])} of the "
                 f"changes are enough, with ours {cause.fraction:.1%}.")
        fails = bool(fails_there[k + 1]) if there.valid[k + 1] else None
        opinions.append(_opinion(cause, declared, original, ends_here[k + 1], ends_there[k + 1], fails, words))
    return Opinions(study=study, unsafe=unsafe, opinions=tuple(opinions), original_here=ends_here[0], original_there=ends_there[0])


def _first_unsafe_step(fails: BoolArray) -> str:
    """The step of the ladder within which a cause begins to be unsafe."""
    safe = np.flatnonzero(~fails)
    below = LADDER[safe[-1]] if len(safe) else 0.0
    return f"{below:.0%} to {below + LADDER[0]:.0%}"


class _Original(NamedTuple):
    """How the original vehicle's run ends with both models, and whether it is unsafe."""

    here: RunEnd
    there: RunEnd
    fails_here: bool
    fails_there: bool


def _opinion(cause: JudgedCause, declared: Declared, original: _Original, here: RunEnd, there: RunEnd, fails: bool | None,
             neighbour: str) -> Opinion:
    """The opinion on a cause; `fails` states whether it is unsafe with the second model, None if it could not be simulated."""
    def says(verdict: OpinionVerdict, because: str, there: RunEnd = there) -> Opinion:
        return Opinion(solution=cause.solution, changes=dict(cause.changes), here=here, there=there, opinion=verdict, because=because)

    if outside := declared.outside(cause.changes):
        return says(OpinionVerdict.OUTSIDE, "; ".join(outside), RunEnd())
    if original.fails_here:
        return says(OpinionVerdict.OUTSIDE, "the original vehicle itself is unsafe: no change causes anything")
    if original.fails_there:
        return says(OpinionVerdict.OUTSIDE, f"the original vehicle itself is not safe with the second model: {original.there}")
    if fails is None:
        return says(OpinionVerdict.OUTSIDE, f"it could not be simulated with the second model: {there}")
    if fails:
        return says(OpinionVerdict.CONFIRMED,
                    f"also unsafe with the second: {there}; its original vehicle is safe: {original.there}. {neighbour}")
    return says(OpinionVerdict.CONTRADICTED, f"safe with the second: {there}; its original vehicle: {original.there}")


def _neighbours(system: System, causes: Sequence[JudgedCause], settings: FloatArray, unsafe: Unsafe) -> list[Neighbour]:
    """For each cause, the first setting below its boundary that is safe with our model; the original if no other is."""
    if not causes:
        return []
    original = system.characteristics.original
    shares = np.array([cause.fraction * (1 - BELOW) for cause in causes])
    candidates = original + shares[..., np.newaxis] * (settings - original)[:, np.newaxis]
    evaluations = evaluate(system, candidates.reshape(-1, len(original)))
    safe = (evaluations.valid & ~unsafe.of(evaluations)).reshape(shares.shape)
    safe[:, -1] = True
    first = np.argmax(safe, axis=1)
    return [Neighbour(candidates[k, at], float(shares[k, at])) for k, at in enumerate(first.tolist())]


def _end(evaluations: Evaluations, row: int) -> RunEnd:
    return RunEnd(str(evaluations.outcome[row]), finite_or_none(evaluations.f_safe[row]))
