"""The page about a rated study: matrices and points of the original vehicle and of a worn vehicle, and the points lost
by test.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from safevar_sumo.analysis.rating import RatingOptions
from safevar_sumo.analysis.rating.compute import Rating, rate, remarks
from safevar_sumo.analysis.rating.render import (
    colour_changes_in_words,
    lost_by_test,
    matrices_figure,
    not_simulated,
    rating_in_words,
    test_in_words,
)
from safevar_sumo.analysis.words import question_command
from safevar_sumo.progress import Progress
from safevar_sumo.report.input import ReportInput
from safevar_sumo.results import choose_handle, row_of_handle
from safevar_sumo.vehicles import CharacteristicSet

VARIANT_CHOICE = "fewest"
"""Choice of the solution beside the original: the fewest changes that lose a point."""


def rated_study_data(data: ReportInput, jobs: int | None, progress: Progress) -> dict[str, Any]:
    """The page's data about one study; simulates the vehicles in all cells."""
    case, variants, handle = data.case, dict[str, np.ndarray](), None
    if case.unsafe.rows(case.solutions).any():
        handle = choose_handle(case.solutions, case.unsafe, VARIANT_CHOICE, data.directory)
        row = case.solutions.iloc[row_of_handle(case.solutions, handle)]
        names = CharacteristicSet.of(case.study.vehicle.characteristics).names
        variants[str(handle)] = row[list(names)].to_numpy(dtype=float)
    rating = rate(case.study, variants, jobs=jobs, progress=progress)
    rating_command = RatingOptions(solution=None if handle is None else str(handle)).command_line(str(data.directory))
    return {
        "title": case.study.title,
        "sentence": f"{rating.no_verdict} {rating_in_words(rating)}".lstrip(),
        "notes": remarks(rating),
        "points": _point_rows(rating),
        "lost": [(test_in_words(test), f"{lost:.2f}") for test, lost in lost_by_test(rating)],
        "turned": colour_changes_in_words(rating),
        "picture": draw_matrices(rating),
        "names": [vehicle.name for vehicle in rating.vehicles],
        "not_simulated": not_simulated(rating),
        "commands": [
            rating_command,
            *(question_command(question, str(data.directory)) for question in ("tolerance", "explain")),
        ],
    }


def _point_rows(rating: Rating) -> Sequence[tuple[str, Sequence[str], str]]:
    """Rows of texts: a test, the points of each vehicle, and the points available."""
    rows = [
        (tests[0].matrix.name, [f"{test.total:.2f}" for test in tests], f"{sum(tests[0].matrix.points):g}")
        for tests in zip(*(vehicle.tests for vehicle in rating.vehicles), strict=True)
    ]
    available = sum(sum(matrix.points) for matrix in rating.protocol.matrices)
    return [*rows, ("all", [f"{vehicle.points:.2f}" for vehicle in rating.vehicles], f"{available:g}")]


def draw_matrices(rating: Rating) -> Markup:
    """Draw the matrices as SVG to embed in the page; equal ratings give equal bytes."""
    import matplotlib

    file = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "safevar_sumo"}):
        matrices_figure(rating).savefig(file, format="svg", metadata={"Date": None})
    return Markup(file.getvalue()[file.getvalue().index("<svg") :])
