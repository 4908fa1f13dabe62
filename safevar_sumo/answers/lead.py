"""The answer that a study's summary leads with: the failures that matter, each with its minimal cause in words."""

from __future__ import annotations

import pandas as pd

from safevar_sumo.answers.bench import Bench
from safevar_sumo.answers.causes import MinimalCause, minimal_causes
from safevar_sumo.answers.explanation import REASONS
from safevar_sumo.answers.unsafe import Unsafe
from safevar_sumo.answers.where import points_in_words, points_of
from safevar_sumo.answers.words import ask, changes, number_of
from safevar_sumo.computing import Pool
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.results import chosen_handle, position_of, unsafe_rows
from safevar_sumo.simulation import assemble, at_every_point, worst_points
from safevar_sumo.study import Study


def lead(study: Study, solutions: pd.DataFrame, original: Evaluations, pool: Pool, place: str) -> list[str]:
    """What solutions of a study come to, in lines, and which command tells more; unsafe is what `safevar_sumo.results.unsafe_rows` goes by.

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
    means = Unsafe() if (solutions["outcome"] == str(Outcome.COLLISION)).any() else Unsafe.half_of(degree)
    if not unsafe.any():
        return [f"Nothing unsafe found in {number_of(len(solutions), 'solution')}: no collision, no SD below half of the original's.",
                f"How far each characteristic may go: {ask('tolerance', place)}"]
    handles = {reason: chosen_handle(solutions, degree, choice, study.name) for choice, reason in REASONS.items()}
    rows = solutions.iloc[[position_of(solutions, handle) for handle in handles.values()]]
    settings = rows[list(bench.characteristics.names)].to_numpy(dtype=float)
    found, (places, worst) = minimal_causes(bench, settings, means), _places(study, settings, means)
    lines = [f"Unsafe ({means}): {int(unsafe.sum())} of {number_of(len(solutions), 'solution')}."]
    for (reason, handle), row, causes, fails in zip(handles.items(), rows.to_dict("records"), found, places, strict=True):
        size = f"{number_of(int(row['f_num_diff']), 'change')} of up to {row['f_diff']:.0%}"
        end = f"{row['outcome']}, SD {row['f_safe']:.2f}"
        lines.append(f"{reason.capitalize()}: {handle}, {end}, {size}. {_in_words(bench, causes)}{fails}")
    where = f"at the worst point of the first (without --point: at all {len(assemble(study).points)}, which takes long)"
    return [*lines, f"Why, and how far{f', {where}' if worst else ''}: {ask('explain', place, worst)}"]


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
    others = f", or {number_of(len(causes) - 1, 'other set')} as small" if len(causes) > 1 else ""
    return f"It takes {changes(bench.characteristics, values)}{others}."
