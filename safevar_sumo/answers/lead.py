"""The answer that a study's summary leads with: the failures that matter, each with its minimal cause in words."""

from __future__ import annotations

import numpy as np
import pandas as pd

from safevar_sumo.answers.bench import Bench
from safevar_sumo.answers.causes import MinimalCause, minimal_causes, number
from safevar_sumo.answers.explanation import REASONS
from safevar_sumo.answers.in_short import Finding, in_short
from safevar_sumo.answers.preventability import preventability
from safevar_sumo.answers.robustness import robustness, smallest_robust
from safevar_sumo.answers.unsafe import Unsafe
from safevar_sumo.answers.where import points_in_words, points_of, where
from safevar_sumo.answers.words import ask, changes, number_of
from safevar_sumo.computing import Pool
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.results import CHOICES, chosen_handle, handles, position_of, unsafe_rows
from safevar_sumo.simulation import assemble, at_every_point, study_at, worst_points
from safevar_sumo.study import Study

LIMIT = 4000
"""Simulations, about, in which the smallest robust failure is looked for at the end of a study; `explain` takes more."""


def lead(study: Study, solutions: pd.DataFrame, original: Evaluations, pool: Pool, place: str) -> list[str]:
    """What solutions of a study come to, in lines, and which command tells more: first a paragraph that a manager understands.

    Unsafe is what `safevar_sumo.results.unsafe_rows` goes by.

    Parameters
    ----------
    solutions
        A frame as `safevar_sumo.results.solutions_frame` makes it.
    original
        The original vehicle's evaluation.
    pool
        Where subsets of their changes are simulated.
    place
        The directory of the results.
    """
    if original.collided[0]:
        return ["The original vehicle itself collides: no change is needed."]
    bench, degree = Bench(study, pool), float(original.f_safe[0])
    unsafe = unsafe_rows(solutions, degree)
    hits = bool((solutions["outcome"] == str(Outcome.COLLISION)).any())
    means = Unsafe() if hits else Unsafe.half_of(degree)
    if not unsafe.any():
        return [f"Nothing unsafe found in {number_of(len(solutions), 'solution')}: no collision, no SD below half of the original's.",
                f"How far each characteristic may go: {ask('tolerance', place)}"]
    chosen = {reason: chosen_handle(solutions, degree, choice, study.name) for choice, reason in REASONS.items()}
    rows = solutions.iloc[[position_of(solutions, handle) for handle in chosen.values()]]
    settings = rows[list(bench.characteristics.names)].to_numpy(dtype=float)
    found, (places, worst) = minimal_causes(bench, settings, means), _places(study, settings, means)
    counted = f"{int(unsafe.sum())} of {number_of(len(solutions), 'vehicle')} found"
    lines = [_paragraph(bench, solutions, unsafe, original, means, worst),
             f"{counted} collide." if hits else f"No collision. {counted} keep less than half of the original's {degree:.2f} m."]
    for (reason, handle), row, causes, fails in zip(chosen.items(), rows.to_dict("records"), found, places, strict=True):
        size = f"{number_of(int(row['f_num_diff']), 'change')} of up to {row['f_diff']:.0%}"
        end = f"{row['outcome']}, SD {row['f_safe']:.2f}"
        lines.append(f"{reason.capitalize()}: {handle}, {end}, {size}. {_in_words(bench, causes)}{fails}")
    at_worst = f"at the worst point of the first (without --point: at all {len(assemble(study).points)}, which takes long)"
    return [*lines, f"Why, and how far{f', {at_worst}' if worst else ''}: {ask('explain', place, worst)}"]


def _paragraph(bench: Bench, solutions: pd.DataFrame, is_unsafe: pd.Series[bool], original: Evaluations, unsafe: Unsafe, point: str) -> str:
    """What the unsafe solutions come to, in short; in a matrix at the point that is named, by those that are unsafe there."""
    names, every = bench.characteristics.names, handles(solutions)
    kept = np.flatnonzero(is_unsafe.to_numpy() & ~solutions.duplicated(list(names)).to_numpy())
    if point:
        bench = bench.of(study_at(bench.study, point, point))
        original = bench.original()
    system = assemble(bench.study)
    evaluations = bench.evaluate(solutions.iloc[kept][list(names)].to_numpy(dtype=float), "unsafe solutions")
    preventable = preventability(bench, evaluations.settings[evaluations.collided])
    failing = np.flatnonzero(unsafe.of(evaluations))
    failures = evaluations.take(failing)
    if not len(failures):
        return in_short(system, original, None, None, preventable)
    step = where(system, original.settings, original.settings[:0], unsafe)[1]
    robust = smallest_robust(bench, failures, step, unsafe, LIMIT // len(system.points))
    fewest = int(np.lexsort([getattr(failures, name) for name in reversed(CHOICES["fewest"])])[0])
    rows = [fewest] if robust is None else [fewest, robust]
    told, here = [], failures.take(rows)
    causes, shares = minimal_causes(bench, here.settings, unsafe), robustness(bench, here.settings, step, unsafe)
    for i, row in enumerate(rows):
        changed = np.flatnonzero(bench.characteristics.changed(here.settings[i]))
        changes = {names[column]: float(here.settings[i, column]) for column in changed}
        told.append(Finding(str(every[kept[failing[row]]]), changes, str(here.outcome[i]), number(here.f_safe[i]), shares[i],
                            len(causes[i][0].columns)))
    return in_short(system, original, told[0], told[1] if len(told) > 1 else None, preventable)


def _places(study: Study, settings: FloatArray, unsafe: Unsafe) -> tuple[list[str], str]:
    """At which points of a matrix each setting fails, in words, and where the first comes off worst; nothing in a study without one."""
    system = assemble(study)
    if not system.matrix:
        return [""] * len(settings), ""
    found = at_every_point(system, settings)
    told = [f" {points_in_words(points, len(system.matrix), most=3)}" for points in points_of(system, found, unsafe)]
    return told, found[worst_points(found)[0]].point.name


def _in_words(bench: Bench, causes: list[MinimalCause]) -> str:
    """The first of a setting's minimal causes, and how many others there are."""
    if not causes:
        return "Simulated again it is not unsafe."
    values = {bench.characteristics.names[column]: float(causes[0].setting[column]) for column in causes[0].columns}
    more = len(causes) - 1
    others = f" ({number_of(more, 'alternative set')} of the same size; see explain)" if more else ""
    return f"These changes alone cause it: {changes(bench.characteristics, values)}{others}."
