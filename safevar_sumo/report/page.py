"""The page: its sections, the research questions in it, the commands that make its numbers again, and the template."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import msgspec
import numpy as np
from markupsafe import Markup

from safevar_sumo.analysis.evaluator import Progress, silent
from safevar_sumo.analysis.research_questions.answer import answer
from safevar_sumo.analysis.research_questions.case import Case, Unanswerable
from safevar_sumo.analysis.research_questions.gallery import draw
from safevar_sumo.analysis.research_questions.layout import Bold, Table, lay_out
from safevar_sumo.errors import InputError, did_you_mean, warn
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.replay.comparison import raised
from safevar_sumo.replay.page import environment, player_parts
from safevar_sumo.report.findings import best_of, causes, evenly, explanations, necessity_chart, no_opinion, replays
from safevar_sumo.report.input import ReportInput, gather
from safevar_sumo.report.limits import LIMITS
from safevar_sumo.report.rated import rated_study_page
from safevar_sumo.report.svg import Dot, scatter
from safevar_sumo.report.verdict import tested, trust, verdict
from safevar_sumo.shipped import RUN
from safevar_sumo.study import Study, load_study, study_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DIGITS = re.compile(r"(\d\.\d\d)\d+")
"""A number in a picture, with more digits than can be seen."""
DOTS = 150
"""Points of a scatter chart, at the most."""
TEXT = {"svg.fonttype": "none", "svg.hashsalt": "safevar_sumo", "font.family": ["sans-serif"]}


def tables(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Every table for the template; a table with the reason where no question can be answered."""
    try:
        answers = answer(cases)
    except Unanswerable as error:
        return [{"title": "RQ1 to RQ3", "heads": (), "spans": (), "rows": [], "labels": 0, "notes": [f"{error.source}: {error.problem}."]}]
    return [_plain(table) for one in answers for table in lay_out(one)]


def _plain(table: Table) -> dict[str, Any]:
    rows = [[{"text": raised(str(cell)), "bold": isinstance(cell, Bold)} for cell in row] for row in table.rows]
    spans = [("", table.labels), *((raised(name), width) for name, width in table.spans)] if table.spans else []
    heads, notes = ([raised(text) for text in texts] for texts in (table.heads, table.notes))
    return {"title": raised(table.title), "heads": heads, "spans": spans, "rows": rows, "labels": table.labels, "notes": notes}


def figures(cases: Sequence[Case]) -> list[dict[str, str]]:
    """Every figure as a picture that stands in the page."""
    try:
        drawn, _ = draw(cases)
    except Unanswerable:
        return []
    return [{"name": name, "alt": _words(figure), "source": _inline(figure)} for name, figure in drawn.items()]


def _words(figure: Figure) -> str:
    axis = figure.axes[0]
    return f"{figure.get_suptitle()}: {axis.get_ylabel() or 'values'} over {axis.get_xlabel() or 'characteristics'}".replace("\n", " ")


def _inline(figure: Figure) -> str:
    import matplotlib

    buffer = BytesIO()
    with matplotlib.rc_context(TEXT):  # type: ignore[arg-type]
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    picture = DIGITS.sub(r"\1", buffer.getvalue().decode())
    return "data:image/svg+xml," + quote(picture, safe=" =:/;,()'!?@&+$*")


def front(material: ReportInput, shown: Sequence[str]) -> Markup:
    """A chart of the non-dominated solutions by largest change and safety degree; replayed ones are links to their replays."""
    rows = [row for row in material.solutions.values() if not np.isnan([row["f_safe"], row["f_diff"]]).any()]
    best = best_of(rows)
    kept = [best[place] for place in evenly(len(best), DOTS)] + [row for row in rows if row["handle"] in shown]
    dots = {row["handle"]: _dot(material, row, row["handle"] in shown) for row in kept}
    return scatter(f"{material.case.name}: safety degree over the largest change of the solutions that no other beats",
                   list(dots.values()), "largest change [% of the original]", "safety degree [m, or -m/s]", 0.0, "collision below")


def _dot(material: ReportInput, row: dict[Any, Any], is_shown: bool) -> Dot:
    words = (f"{row['handle']}: {row['outcome']}, safety degree {row['f_safe']:.2f}, largest change {row['f_diff']:.0%}, "
             f"{row['f_num_diff']} changed")
    look = "hit" if row["outcome"] == "collision" else "miss"
    return Dot(100 * row["f_diff"], row["f_safe"], words, look, material.anchor("replay", row["handle"]) if is_shown else "")


def reproduce(materials: Sequence[ReportInput], parts: Sequence[str]) -> list[dict[str, str]]:
    """Commands that make the numbers of this page again."""
    places = " ".join(shlex.quote(str(material.place)) for material in materials)
    commands = []
    for material in materials:
        place, study = shlex.quote(str(material.place)), material.case.study
        now = " --as-it-is-now" if material.changed else ""
        if material.case.has_runs:
            commands.append({"what": f"The study {study.name}, as its manifest.json records it whole, into another directory",
                             "command": _again(study, f"{material.place}-again", material.place)})
        asked = [*parts, *(["opinion"] if "explain" in parts and material.system is not None and not no_opinion(material) else [])]
        commands += [{"what": f"The part {part}", "command": material.options[part].command_line(str(material.place), material.point) + now}
                     for part in asked]
        if material.point:
            continue
        commands.append({"what": "A replay, with figure and animation",
                         "command": f"{RUN} simulate {place} --most-severe --plot it.png --animate it.html{now}"})
    if any(material.point for material in materials):
        return commands
    commands.append({"what": "The tables of RQ1 to RQ3", "command": f"{RUN} tables {places}"})
    commands.append({"what": "The figures", "command": f"{RUN} figures {places} --out figures"})
    return commands


def _again(study: Study, out: str, place: Path) -> str:
    """The command that runs a study again: for a shipped study with other options `study`, else a call with the recorded study."""
    search = study.search
    if study.name in study_names():
        options = {name: getattr(search, name) for name in ("seed", "runs", "evaluations", "algorithms")}
        shipped = load_study(study.name)
        if msgspec.structs.replace(shipped, search=msgspec.structs.replace(shipped.search, **options), origin=study.origin) == study:
            flags = {**options, "algorithms": shlex.quote(",".join(search.algorithms)), "out": shlex.quote(out)}
            return " ".join([f"{RUN} study {study.name}", *(f"--{name} {value}" for name, value in flags.items())])
    script = f"import safevar_sumo as sv; sv.run(sv.load({json.dumps(str(place))}).study, out={json.dumps(out)}, progress=True)"
    return f"python -c {shlex.quote(script)}"


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
                *, point: str | None = None, as_it_is_now: bool = False) -> str:
    """The page about results in directories; parameters, warnings and errors are those of `safevar_sumo.report`."""
    unknown = [name for name in only if name not in SECTIONS]
    if unknown:
        raise InputError("only", f"there is no section {unknown[0]!r}{did_you_mean(unknown[0], SECTIONS)}", f"some of {','.join(SECTIONS)}")
    wanted = [name for name in SECTIONS if not only or name in only]
    if point is not None:
        if "questions" in only:
            raise InputError("only", "the research questions are about whole studies", "sections other than questions with --point")
        wanted = [name for name in wanted if name != "questions"]
    materials = gather(directories, point, as_it_is_now=as_it_is_now)
    for material in materials:
        for change in material.changed:
            warn(f"{material.place}: {change}")
    are_rated = [is_rated(material.case.study) and point is None for material in materials]
    if any(are_rated):
        if not all(are_rated):
            raise InputError("directories", "some hold results of rated studies, others do not", "a report for each kind")
        return environment(WEB).get_template("rated.html.j2").render(
            title=f"Euro NCAP rating: {', '.join(material.case.name for material in materials)}", css=_part("report.css"),
            studies=[rated_study_page(material, jobs, progress) for material in materials]) + "\n"
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


def _study(material: ReportInput, wanted: Sequence[str], jobs: int | None, show: Progress) -> Mapping[str, Any]:
    """The data of one study for every wanted section."""
    def progress(stage: str, done: int, total: int) -> None:
        show(f"{material.case.name}: {stage}", done, total)

    explained = explanations(material, jobs, progress) if "causes" in wanted and material.system is not None else None
    limits = {name: make(material, jobs, progress) for name, make in LIMITS.items()
              if name in wanted and material.system is not None}
    progress("replays", 0, 1)
    shown = replays(material, explained) if "causes" in wanted else []
    sections: dict[str, Callable[[], Any]] = {
        "tested": lambda: tested(material),
        "verdict": lambda: verdict(material, explained, limits.get("tolerance")),
        "causes": lambda: causes(explained or [], material),
        "no_opinion": lambda: "" if material.system is None else no_opinion(material),
        "necessity": lambda: necessity_chart(explained or [], material),
        "trust": lambda: trust(material, explained)}
    otherwise = [one["handle"] for one in shown if one.get("differences")]
    if otherwise:
        warn(f"{material.place}: {', '.join(otherwise)}: simulated again not what the results say; other versions or code than "
             "those of the study?")
    return {"name": material.case.name, "title": material.case.study.title, "anchor": material.anchor(), "replays": shown,
            "otherwise": otherwise,
            "lacking": material.lacking, "changed": material.changed, "original_fails": material.original_fails,
            "front": front(material, [one["handle"] for one in shown]) if shown else None,
            **limits, **{name: make() for name, make in sections.items()
                         if name in wanted or (name in ("necessity", "no_opinion") and "causes" in wanted)}}


def _part(name: str) -> Markup:
    return Markup((WEB / name).read_text(encoding="utf-8"))
