"""The page: which sections it has, what each study gives to them, and the template that they are set in."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from safevar_sumo.errors import InputError
from safevar_sumo.report.findings import causes, replays
from safevar_sumo.report.material import Material, gather
from safevar_sumo.report.questions import figures, front, tables
from safevar_sumo.report.tested import tested
from safevar_sumo.report.trust import reproduce, trust
from safevar_sumo.report.verdict import verdict
from safevar_sumo.showing.page import environment, player_parts

WEB = Path(__file__).parent / "web"
SECTIONS = {
    "tested": "What was tested",
    "verdict": "Verdict",
    "causes": "What does it, and how it looks",
    "questions": "The research questions",
    "trust": "What was not tested, and how far to trust it",
    "reproduce": "How to make every number again",
}
"""The sections of a report by the names that `--only` takes, in their order."""
Progress = Callable[[str, int, int], None]


def make_report(directories: Iterable[str | Path], only: Sequence[str] = (), progress: Progress = lambda what, done, total: None) -> str:
    """One self-contained page about the results of one or several studies; the same results give the same page.

    Parameters
    ----------
    directories
        Results directories.
    only
        Names of `SECTIONS`; all of them by default.
    progress
        Is told what is being made, how many parts are done, and of how many.

    Raises
    ------
    InputError
        If a directory holds no results, or there is no such section.
    """
    unknown = [name for name in only if name not in SECTIONS]
    if unknown:
        raise InputError("--only", f"there is no section {unknown[0]!r}", f"some of {','.join(SECTIONS)}")
    wanted = [name for name in SECTIONS if not only or name in only]
    materials = gather(directories)
    total, done = len(materials) + 1, 0
    studies = []
    for material in materials:
        progress(material.case.name, done, total)
        studies.append(_study(material, wanted))
        done += 1
    progress("tables and figures", done, total)
    cases = [material.case for material in materials]
    asked = "questions" in wanted
    page = environment(WEB).get_template("report.html.j2").render(
        title=f"Safety report: {', '.join(case.name for case in cases)}", sections={name: SECTIONS[name] for name in wanted},
        studies=studies,
        tables=tables(cases) if asked else [], figures=figures(cases) if asked else [],
        commands=reproduce(materials, []) if "reproduce" in wanted else [],
        player=player_parts(), css=_part("report.css"), js=_part("report.js"))
    progress("done", total, total)
    return page + "\n"


def _study(material: Material, wanted: Sequence[str]) -> Mapping[str, Any]:
    """What one study gives to every section that is wanted."""
    explained = None
    shown = replays(material, explained) if "causes" in wanted else []
    made: dict[str, Callable[[], Any]] = {
        "tested": lambda: tested(material),
        "verdict": lambda: verdict(material, explained),
        "causes": lambda: causes(explained or [], material),
        "trust": lambda: trust(material, explained)}
    return {"name": material.case.name, "title": material.case.study.title, "anchor": material.anchor(), "replays": shown,
            "has_system": material.system is not None, "front": front(material, [one["handle"] for one in shown]) if shown else None,
            **{name: make() for name, make in made.items() if name in wanted}}


def _part(name: str) -> Markup:
    return Markup((WEB / name).read_text(encoding="utf-8"))
