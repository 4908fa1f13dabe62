"""Explain failures: which of the changes did it, how little of them is enough, why, and whether the failure is robust."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from safevar_sumo.analysis.criterion import Unsafe
from safevar_sumo.analysis.evaluator import Bench, Progress, open_bench, silent
from safevar_sumo.analysis.explain.causes import MinimalCause, affordable, boundaries, minimal_causes, necessary, number
from safevar_sumo.analysis.explain.failures import Failures, failures_of, where
from safevar_sumo.analysis.explain.necessity import distinct_causes, key_of, necessity, robustness, smallest_robust
from safevar_sumo.analysis.explain.options import ExplainOptions
from safevar_sumo.analysis.explain.result import Cause, Explained, Explanation
from safevar_sumo.analysis.preventability import preventability, preventable_by
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.records import Evaluations
from safevar_sumo.results import SolutionId
from safevar_sumo.study import Study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.workers.evaluation import Pool

ROBUST = "smallest robust"
REASONS = {"fewest": "fewest changes", "smallest": "smallest changes", "most_severe": "most severe"}
Causes = Mapping[int, list[MinimalCause]]
Reasons = tuple[str, ...]


def explain_failures(source: Study | Case, *, solutions: Sequence[str] = (), unsafe: str | None = None, top: int = ExplainOptions.top,
            limit: int = ExplainOptions.limit, pool: Pool | None = None, jobs: int | None = None, progress: Progress = silent) -> Explained:
    """Explain the failures that matter among the solutions of results, or among settings all over a study's domain.

    Parameters
    ----------
    source
        Results, or a study without any.
    solutions
        Handles of the solutions to explain; by default the smallest robust failure, those with the fewest and the smallest
        changes, the most severe one, and one of each distinct minimal cause, the most frequent first.
    unsafe
        `collision` or `below=X`; by default a collision if there is one, else half of the original's safety degree.
    top
        How many failures are explained in full at the most.
    limit
        Simulations, about, that the minimal causes of all failures may take: of more, a random sample is looked into. So
        many may the search for the smallest robust failure take again.
    pool, jobs
        Where to simulate: a pool, or that many worker processes (by default one for each core).
    progress
        Is told what is done.

    Raises
    ------
    InputError
        If `unsafe` or a handle cannot be read, or the study cannot be assembled.
    """
    ExplainOptions(solutions=tuple(solutions), unsafe=unsafe, top=top, limit=limit)
    study = source if isinstance(source, Study) else source.study
    means, named = Unsafe.given(unsafe), [SolutionId.parse(text) for text in solutions]
    limit //= len(assemble(study).points)
    with open_bench(study, pool, jobs, progress) as bench:
        original = bench.original()
        found = failures_of(source, bench, original, named, means)
        sample = found.rows if solutions else [found.rows[i] for i in affordable(found.evaluations.settings[found.rows], bench, limit)]
        robust = None if solutions else _robust(found, bench, original, limit)
        reasons = dict.fromkeys(found.rows[:len(solutions)], ("asked for",)) if solutions else _that_matter(found, robust)
        rows = sorted({*sample, *reasons})
        causes = dict(zip(rows, minimal_causes(bench, found.evaluations.settings[rows], found.unsafe), strict=True))
        if not solutions:
            reasons = _with_one_of_each_cause(found, bench, {row: causes[row] for row in sample}, reasons, causes, top)
        explanations = _explained(found, bench, original, causes, reasons)
        preventable = preventability(bench, found.evaluations.settings[found.evaluations.collided])
    changed = bench.characteristics.changed(found.evaluations.settings[sample])
    of_sample = [causes[row] for row in sample]
    return Explained(
        study=study, unsafe=found.unsafe, original=original, explanations=explanations,
        necessity=necessity(bench.characteristics, changed, of_sample, len(found.rows)),
        distinct=distinct_causes(bench.characteristics, of_sample),
        looked_at=len(found.evaluations), failures=len(found.rows), analysed=len(sample), otherwise=found.otherwise,
        preventability=preventable)


def _robust(found: Failures, bench: Bench, original: Evaluations, limit: int) -> int | None:
    """The smallest robust failure, if there is one among those that may be tried; none where the original vehicle is unsafe itself."""
    if not found.rows or found.unsafe.of(original)[0]:
        return None
    _, step = where(assemble(bench.study), original.settings, original.settings[:0], found.unsafe)
    row = smallest_robust(bench, found.evaluations.take(found.rows), step, found.unsafe, limit)
    return None if row is None else found.rows[row]


def _that_matter(found: Failures, robust: int | None) -> dict[int, Reasons]:
    """The smallest robust failure, the one of the fewest changes, the most severe and the one of the smallest changes, by row."""
    reasons: dict[int, Reasons] = {} if robust is None else {robust: (ROBUST,)}
    for choice in ("fewest", "most_severe", "smallest"):
        if found.rows:
            row = found.least(choice)
            reasons[row] = (*reasons.get(row, ()), REASONS[choice])
    return reasons


def _with_one_of_each_cause(found: Failures, bench: Bench, sample: Causes, reasons: Mapping[int, Reasons], causes: Causes,
                            top: int) -> dict[int, Reasons]:
    """Add one failure of each distinct minimal cause that is not there yet, the simplest that has it, up to `top` in all."""
    chosen = dict(list(reasons.items())[:top])
    keys = {row: {key_of(bench.characteristics, cause) for cause in group} for row, group in causes.items()}
    for key in distinct_causes(bench.characteristics, list(sample.values()))["cause"]:
        if len(chosen) >= top:
            break
        if not any(key in keys[row] for row in chosen):
            group = [row for row in sample if key in keys[row]]
            simplest = min(group, key=lambda row: (found.evaluations.f_num_diff[row], found.evaluations.f_diff[row], row))
            chosen[simplest] = ("a cause of its own",)
    return chosen


def _explained(found: Failures, bench: Bench, original: Evaluations, causes: Causes,
               reasons: Mapping[int, Reasons]) -> tuple[Explanation, ...]:
    """The chosen failures explained in full."""
    if not reasons:
        return ()
    rows = list(reasons)
    here, names = found.evaluations.take(rows), bench.characteristics.names
    beside, step = where(assemble(bench.study), original.settings, here.settings, found.unsafe)
    robust = robustness(bench, here.settings, step, found.unsafe)
    shrunk = iter(boundaries(bench, [cause for row in rows for cause in causes[row]], found.unsafe))
    collided = np.flatnonzero(here.collided)
    avoided = dict(zip(collided.tolist(), preventable_by(bench, here.settings[collided]), strict=True))
    explanations = []
    for i, row in enumerate(rows):
        group = []
        for cause in causes[row]:
            boundary = next(shrunk)
            group.append(Cause(
                changes={names[column]: float(cause.setting[column]) for column in cause.columns},
                boundary={names[column]: float(boundary.setting[column]) for column in cause.columns}, fraction=boundary.fraction,
                alone={names[column]: value for column, value in boundary.alone.items()}, outcome=cause.outcome,
                safety_degree=cause.safety_degree, end=boundary.end,
                at_threshold=None if boundary.at_threshold is None else names[boundary.at_threshold]))
        changed = bench.characteristics.changed(here.settings[i])
        explanations.append(Explanation(
            handle=found.handles[row], reasons=reasons[row], setting=dict(zip(names, here.settings[i].tolist(), strict=True)),
            outcome=str(here.outcome[i]), safety_degree=number(here.f_safe[i]),
            changed=tuple(name for name, is_changed in zip(names, changed, strict=True) if is_changed),
            necessary=tuple(names[column] for column in sorted(necessary(causes[row]))), causes=tuple(group), robustness=robust[i],
            because=beside[i].because, preventable=str(avoided.get(i) or ""), points=beside[i].points))
    return tuple(explanations)
