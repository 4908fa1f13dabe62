"""Summary of a search's solutions for a rated study, without new simulations."""

from __future__ import annotations

from shlex import quote

import pandas as pd

from safevar_sumo.analysis.words import list_of_changes, number_of, question_command
from safevar_sumo.metrics import RATING_POINTS, Unsafe
from safevar_sumo.records import Evaluations
from safevar_sumo.results import choose_handle, record, row_of_handle
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet

TITLES = {
    "fewest": "Fewest changes that cost a point",
    "smallest": "Smallest largest change that costs a point",
    "most_points": "Most points lost",
}


def summarise_rated_solutions(
    study: Study, solutions: pd.DataFrame, original: Evaluations, directory: str
) -> list[str]:
    """Summarise the solutions of a rated study in lines, the last with commands for the next steps.

    `directory` is the results directory in these commands; the other parameters are those of
    `safevar_sumo.analysis.explain.summary.summarise_failures`, which calls this function for rated studies.
    """
    original_points, points_column = float(original.column(RATING_POINTS.name)[0]), RATING_POINTS.name
    unsafe = Unsafe.default(record(original, 0), solutions["outcome"])
    has_loss = unsafe.rows(solutions)
    if not has_loss.any():
        return [
            f"No solution loses a point of the original's {original_points:.2f}.",
            f"Points against each characteristic: {question_command('tolerance', directory)}",
        ]
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    lines = [
        f"The original vehicle earns {original_points:.2f} points. {int(has_loss.sum())} of "
        f"{number_of(len(solutions), 'solution')} lose at least one point."
    ]
    handle = None
    for choice, title in TITLES.items():
        handle = choose_handle(solutions, unsafe, choice, study.name)
        row = solutions.iloc[row_of_handle(solutions, handle)]
        setting = {characteristic: float(row[characteristic]) for characteristic in characteristics.names}
        loss = original_points - row[points_column]
        lines.append(f"{title}: {handle} loses {loss:.2f} points with {list_of_changes(characteristics, setting)}.")
    return [
        *lines,
        f"Which cells change colour: {question_command('rating', directory)} --solution {quote(str(handle))} "
        "--matrix; which "
        f"changes cause it: {question_command('explain', directory)}",
    ]
