"""Make a page about the findings of studies. The package is callable: `safevar_sumo.report(...)`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from safevar_sumo.analysis.subject import Results
from safevar_sumo.report.page import SECTIONS, make_report
from safevar_sumo.results import write_whole
from safevar_sumo.terminal import open_progress

if TYPE_CHECKING:
    from safevar_sumo.terminal import Progress


def report(
    *results: Results | str | Path,
    out: str | Path | None = None,
    only: Sequence[str] = (),
    paper: bool = False,
    point: str | None = None,
    jobs: int | None = None,
    progress: bool | Progress = False,
    as_it_is_now: bool = False,
) -> str:
    """Make one self-contained HTML page about the results of one or several studies; the same results give the same
    page.

    Parameters
    ----------
    results
        Results, or their directories.
    out
        File to write the page to, if any.
    only
        Names of sections from `SECTIONS`, such as "verdict"; by default all but the research questions.
    paper
        With the research questions, as tables and figures.
    point
        Name of a point of the study's matrix: the page is about this point only, without the research questions, which
        need whole studies.
    jobs
        Worker processes for simulations, by default one for each core.
    progress
        True for a bar on the terminal, or a function called with the stage, the amount done, and the total amount.
    as_it_is_now
        If results were computed with other files or versions, simulate with the present ones; the page says so.

    Returns
    -------
    str
        The page.

    Warns
    -----
    UserWarning
        If a new simulation of a solution differs from the results; with `as_it_is_now`, for each change of a file or
        version.

    Raises
    ------
    InputError
        If a directory holds no results, there is no such section or point, or the file cannot be written.
    """
    directories = [source.directory if isinstance(source, Results) else source for source in results]
    with open_progress(progress) as show_progress:
        page = make_report(directories, only, jobs, show_progress, point=point, paper=paper, as_it_is_now=as_it_is_now)
    if out is not None:
        write_whole(Path(out), page)
    return page


class _CallableModule(ModuleType):
    __call__ = staticmethod(report)


sys.modules[__name__].__class__ = _CallableModule

__all__ = ["SECTIONS", "make_report", "report"]
