"""The page: which sections it has, what each study gives to them, and the template that they are set in."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from safevar_sumo.analysis.evaluator import Progress, silent
from safevar_sumo.errors import InputError, did_you_mean
from safevar_sumo.replay.page import environment, player_parts
from safevar_sumo.report.findings import causes, explanations, necessity, replays
from safevar_sumo.report.input import ReportInput, gather
from safevar_sumo.report.limits import LIMITS
from safevar_sumo.report.questions import figures, front, tables
from safevar_sumo.report.trust import reproduce, trust
from safevar_sumo.report.verdict import tested, verdict

WEB = Path(__file__).parent / "web"
SECTIONS = {
    "verdict": "Verdict",
    "tested": "What was tested",
    "causes": "Causes",
    "tolerance": "Tolerances",
    "risk": "Share of unsafe vehicles",
    "rules": "Failure regions",
    "questions": "Research questions",
    "trust": "What was not tested, and how far to trust it",
    "reproduce": "How to reproduce every number",
}
"""The sections of a report by the names that `--only` takes, in their order."""


PARTS = {"causes": "explain", **{name: name for name in LIMITS}}
"""Sections that take simulations, and the commands that make them alone."""


def make_report(directories: Iterable[str | Path], only: Sequence[str] = (), jobs: int | None = None, progress: Progress = silent,
                *, point: str = "", as_it_is_now: bool = False) -> str:
    """One self-contained page about the results of one or several studies; the same results give the same page.

    Parameters
    ----------
    directories
        Results directories.
    only
        Names of `SECTIONS`; all of them by default.
    jobs
        Worker processes for what is to be simulated, one for each core by default.
    progress
        Is told what is being made, how much of it is done, and of how much.
    point
        Name of a point of a matrix, to be asked about alone; the research questions are about whole studies and left out.
    as_it_is_now
        Simulate with what is there now where results were computed with something else; the page says so.

    Warns
    -----
    UserWarning
        Of solutions that, simulated again, are not what the results say; with `as_it_is_now` of what has changed.

    Raises
    ------
    InputError
        If a directory holds no results, or there is no such section.
    """
    unknown = [name for name in only if name not in SECTIONS]
    if unknown:
        raise InputError("only", f"there is no section {unknown[0]!r}{did_you_mean(unknown[0], SECTIONS)}", f"some of {','.join(SECTIONS)}")
    wanted = [name for name in SECTIONS if not only or name in only]
    if point:
        if "questions" in only:
            raise InputError("only", "the research questions are about whole studies", "sections other than questions with --point")
        wanted = [name for name in wanted if name != "questions"]
    materials = gather(directories, point, as_it_is_now=as_it_is_now)
    for material in materials:
        for told in material.changed:
            warnings.warn(f"{material.place}: {told}", stacklevel=2)
    studies = [_study(material, wanted, jobs, progress) for material in materials]
    progress("tables and figures", 0, 1)
    cases = [material.case for material in materials]
    asked = "questions" in wanted
    page = environment(WEB).get_template("report.html.j2").render(
        title=f"Safety report: {', '.join(case.name for case in cases)}", sections={name: SECTIONS[name] for name in wanted},
        studies=studies,
        tables=tables(cases) if asked else [], figures=figures(cases) if asked else [],
        commands=reproduce(materials, [PARTS[name] for name in PARTS if name in wanted]) if "reproduce" in wanted else [],
        takes_simulations=list(PARTS), player=player_parts(), css=_part("report.css"), js=_part("report.js"))
    progress("tables and figures", 1, 1)
    return page + "\n"


def _study(material: ReportInput, wanted: Sequence[str], jobs: int | None, progress: Progress) -> Mapping[str, Any]:
    """What one study gives to every section that is wanted."""
    explained = explanations(material, jobs, progress) if "causes" in wanted and material.system is not None else None
    limits = {name: make(material, jobs, _named(progress, material)) for name, make in LIMITS.items()
              if name in wanted and material.system is not None}
    progress(f"{material.case.name}: replays", 0, 1)
    shown = replays(material, explained) if "causes" in wanted else []
    made: dict[str, Callable[[], Any]] = {
        "tested": lambda: tested(material),
        "verdict": lambda: verdict(material, explained, limits.get("tolerance")),
        "causes": lambda: causes(explained or [], material),
        "necessity": lambda: necessity(explained or [], material),
        "trust": lambda: trust(material, explained)}
    otherwise = [one["handle"] for one in shown if one.get("differences")]
    if otherwise:
        warnings.warn(f"{material.place}: {', '.join(otherwise)}: simulated again not what the results say; other versions or code than "
                      "those of the study?", stacklevel=2)
    return {"name": material.case.name, "title": material.case.study.title, "anchor": material.anchor(), "replays": shown,
            "otherwise": otherwise,
            "lacking": material.lacking, "changed": material.changed, "original_fails": material.original_fails,
            "front": front(material, [one["handle"] for one in shown]) if shown else None,
            **limits, **{name: make() for name, make in made.items() if name in wanted or (name == "necessity" and "causes" in wanted)}}


def _named(progress: Progress, material: ReportInput) -> Progress:
    """Progress that tells of which study it is."""
    return lambda what, done, total: progress(f"{material.case.name}: {what}", done, total)


def _part(name: str) -> Markup:
    return Markup((WEB / name).read_text(encoding="utf-8"))
