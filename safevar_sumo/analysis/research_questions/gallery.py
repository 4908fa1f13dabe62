"""All figures of results by name, drawn for every case that has the data."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from safevar_sumo.analysis.figures import save
from safevar_sumo.analysis.research_questions.algorithm_figures import (
    draw_attainment_surfaces,
    draw_convergence,
    draw_critical_differences,
    draw_pareto_fronts,
)
from safevar_sumo.analysis.research_questions.case import Case, UnanswerableError
from safevar_sumo.analysis.research_questions.change_figures import (
    draw_change_counts,
    draw_change_sizes,
    draw_changed_characteristics,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = ("png", "pdf", "svg")
LEAST_ALGORITHMS = 3
"""Minimum number of algorithms for a figure of ranks; for two, the test of the pair suffices."""
COUNTS_FIGURE = "rq3.1-number-of-changes"
"""The figure that has all cases side by side."""
FIGURES_OF_ONE_CASE: Mapping[str, Callable[[Case], Figure]] = {
    "rq3.2-changed-characteristics": draw_changed_characteristics,
    "rq3.3-sizes-of-changes": draw_change_sizes,
    "pareto-fronts": draw_pareto_fronts,
    "convergence": draw_convergence,
    "critical-differences": draw_critical_differences,
    "attainment": draw_attainment_surfaces,
}


def draw_figures(cases: Sequence[Case]) -> tuple[dict[str, Figure], list[str]]:
    """Every figure of the cases by name, and the reasons for missing figures; with several cases, names start with the
    case's name.

    Raises
    ------
    UnanswerableError
        If no figure can be drawn.
    """
    figures, errors, countable_cases = dict[str, "Figure"](), list[UnanswerableError](), list[Case]()
    for case in cases:
        try:
            draw_change_counts([case])
            countable_cases.append(case)
        except UnanswerableError as error:
            errors.append(error)
    if countable_cases:
        figures[COUNTS_FIGURE] = draw_change_counts(countable_cases)
    for case in cases:
        for name, draw_figure in FIGURES_OF_ONE_CASE.items():
            if draw_figure is draw_critical_differences and len(case.algorithms) < LEAST_ALGORITHMS:
                continue
            try:
                figures[name if len(cases) == 1 else f"{case.name}-{name}"] = draw_figure(case)
            except UnanswerableError as error:
                errors.append(error)
    if not figures:
        raise errors[0]
    return figures, list(dict.fromkeys(f"{error.source}: {error.problem}" for error in errors))


def save_figures(cases: Sequence[Case], directory: Path, file_format: str) -> tuple[list[Path], list[str]]:
    """Draw every figure into a file; returns the files, and the reasons for missing figures.

    Raises
    ------
    InputError
        If the directory cannot be written, or no figure can be drawn.
    """
    figures, reasons = draw_figures(cases)
    directory.mkdir(parents=True, exist_ok=True)
    files = []
    for name, figure in figures.items():
        file_name = re.sub(r"[^\w.-]", "-", f"{cases[0].name}-{name}" if len(cases) == 1 else name).strip("-")
        files.append(directory / f"{file_name}.{file_format}")
        save(figure, files[-1])
    return files, reasons
