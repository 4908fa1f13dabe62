"""All figures of results by name, drawn for every case that has the data."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from safevar_sumo.analysis.figures import save
from safevar_sumo.analysis.research_questions.algorithm_figures import draw_attainment_surfaces, draw_critical_differences
from safevar_sumo.analysis.research_questions.case import Case, UnanswerableError
from safevar_sumo.analysis.research_questions.changes import rq31
from safevar_sumo.analysis.research_questions.figures import (
    draw_change_counts,
    draw_change_sizes,
    draw_changed_characteristics,
    draw_convergence,
    draw_pareto_fronts,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = ("png", "pdf", "svg")
LEAST_ALGORITHMS = 3
"""Minimum number of algorithms for a figure of ranks; for two, the test of the pair suffices."""
FIGURES_OF_ALL_CASES: Mapping[str, Callable[[Sequence[Case]], Figure]] = {"rq3.1-number-of-changes": draw_change_counts}
FIGURES_OF_ONE_CASE: Mapping[str, Callable[[Case], Figure]] = {
    "rq3.2-changed-characteristics": draw_changed_characteristics,
    "rq3.3-sizes-of-changes": draw_change_sizes,
    "pareto-fronts": draw_pareto_fronts,
    "convergence": draw_convergence,
    "critical-differences": draw_critical_differences,
    "attainment": draw_attainment_surfaces,
}


def draw_figures(cases: Sequence[Case]) -> tuple[dict[str, Figure], list[str]]:
    """Every figure of the cases by name, and the reasons for missing figures; with several cases, names start with the case's name.

    Raises
    ------
    UnanswerableError
        If no figure can be drawn.
    """
    figures, all_errors = {}, []
    is_single = len(cases) == 1
    for name, draw_cases in FIGURES_OF_ALL_CASES.items():
        answerable_cases, errors = _select_answerable(cases)
        all_errors += errors
        if answerable_cases:
            figures[name] = draw_cases(answerable_cases)
    for case in cases:
        for name, draw_figure in FIGURES_OF_ONE_CASE.items():
            if draw_figure is draw_critical_differences and len(case.algorithms) < LEAST_ALGORITHMS:
                continue
            try:
                figures[name if is_single else f"{case.name}-{name}"] = draw_figure(case)
            except UnanswerableError as error:
                all_errors.append(error)
    if not figures:
        raise all_errors[0]
    return figures, list(dict.fromkeys(f"{error.source}: {error.problem}" for error in all_errors))


def _select_answerable(cases: Sequence[Case]) -> tuple[list[Case], list[UnanswerableError]]:
    """The cases that have an answer to RQ3.1, and the errors of the others."""
    answerable_cases, errors = [], []
    for case in cases:
        try:
            rq31(case)
            answerable_cases.append(case)
        except UnanswerableError as error:
            errors.append(error)
    return answerable_cases, errors


def save_figures(cases: Sequence[Case], directory: Path, file_format: str) -> tuple[list[Path], list[str]]:
    """Draw every figure into a file; returns the files, and the reasons for missing figures.

    Raises
    ------
    InputError
        If the directory cannot be written, or no figure can be drawn.
    """
    figures, reasons = draw_figures(cases)
    files = []
    for name, figure in figures.items():
        path = directory / f"{_file_name(f'{cases[0].name}-{name}' if len(cases) == 1 else name)}.{file_format}"
        directory.mkdir(parents=True, exist_ok=True)
        save(figure, path)
        files.append(path)
    return files, reasons


def _file_name(name: str) -> str:
    """The name of a figure or case without characters that file systems may refuse."""
    return "".join(character if character.isalnum() or character in "._-" else "-" for character in name).strip("-")
