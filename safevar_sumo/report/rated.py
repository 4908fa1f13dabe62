"""The page about results of a rated study: matrices of the original beside a worn vehicle, and the points that are lost by test."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from safevar_sumo.analysis.evaluator import Progress
from safevar_sumo.analysis.rating import RatingOptions
from safevar_sumo.analysis.rating.compute import Rating, rate, remarks
from safevar_sumo.analysis.rating.render import lost_by_test, matrices_figure, not_simulated, test_in_words, turned_in_words, verdict
from safevar_sumo.analysis.words import ask
from safevar_sumo.report.input import ReportInput
from safevar_sumo.results import chosen_handle, position_of
from safevar_sumo.vehicles import CharacteristicSet

CHOICE = "fewest"
"""Which solution stands beside the original: the one that loses a point with the fewest changes."""


def rated_study_page(material: ReportInput, jobs: int | None, progress: Progress) -> dict[str, Any]:
    """What the page says of one study; its vehicles are simulated in all cells."""
    case, variants, handle = material.case, dict[str, np.ndarray](), None
    if case.unsafe.rows(case.solutions).any():
        handle = chosen_handle(case.solutions, case.unsafe, CHOICE, material.place)
        row = case.solutions.iloc[position_of(case.solutions, handle)]
        names = CharacteristicSet.of(case.study.vehicle.characteristics).names
        variants[str(handle)] = row[list(names)].to_numpy(dtype=float)
    rating = rate(case.study, variants, jobs=jobs, progress=progress)
    asked = RatingOptions(solution=None if handle is None else str(handle)).command_line(str(material.place))
    return {"title": case.study.title, "sentence": verdict(rating), "notes": remarks(rating), "points": _points(rating),
            "lost": [(test_in_words(test), f"{lost:.2f}") for test, lost in lost_by_test(rating)], "turned": turned_in_words(rating),
            "picture": picture(rating), "names": [one.name for one in rating.variants], "open": not_simulated(rating),
            "commands": [asked, ask("tolerance", str(material.place)), ask("explain", str(material.place))]}


def _points(rating: Rating) -> Sequence[tuple[str, Sequence[str], str]]:
    """Test, points of every vehicle, and what there is to earn."""
    rows = [(tests[0].block.name, [f"{test.total:.2f}" for test in tests], f"{sum(tests[0].block.points):g}")
            for tests in zip(*(one.tests for one in rating.variants), strict=True)]
    return [*rows, ("all", [f"{one.points:.2f}" for one in rating.variants], f"{sum(sum(b.points) for b in rating.protocol.blocks):g}")]


def picture(rating: Rating) -> Markup:
    """The matrices as SVG that stands in the page; the same rating gives the same bytes."""
    import matplotlib

    file = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "safevar_sumo"}):
        matrices_figure(rating).savefig(file, format="svg", metadata={"Date": None})
    return Markup(file.getvalue()[file.getvalue().index("<svg"):])
