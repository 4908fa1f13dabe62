"""The page of a report: its sections, research questions, and the commands that reproduce its numbers."""

from __future__ import annotations

import json
import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import msgspec
import numpy as np
from markupsafe import Markup

from safevar_sumo.analysis.research_questions.answer import answer_questions
from safevar_sumo.analysis.research_questions.case import Case, UnanswerableError
from safevar_sumo.analysis.research_questions.gallery import draw_figures
from safevar_sumo.analysis.research_questions.layout import BoldText, Table, lay_out
from safevar_sumo.errors import InputError, did_you_mean, warn
from safevar_sumo.progress import PartsProgress, Progress, show_no_progress
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.replay.comparison import superscript_powers
from safevar_sumo.replay.page import player_files, template_environment
from safevar_sumo.report.causes import (
    ReplayedSolution,
    draw_necessity,
    evenly_spaced_indices,
    explain_main_failures,
    make_cause_sections,
    nondominated_rows,
    reason_without_opinion,
    replay_solutions,
)
from safevar_sumo.report.domain import DOMAIN_SECTIONS
from safevar_sumo.report.input import ReportInput, read_inputs
from safevar_sumo.report.rated import rated_study_data
from safevar_sumo.report.svg import Dot, draw_scatter
from safevar_sumo.report.verdict import describe_limits, describe_tested_system, reach_verdict
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.study import Study, load_study, study_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONG_DECIMALS = re.compile(r"(\d\.\d\d)\d+")
"""Numbers with more decimals than a screen can show."""
MAX_DOTS = 150
"""Maximum number of points in a scatter chart."""
SVG_STYLE = {"svg.fonttype": "none", "svg.hashsalt": "safevar_sumo", "font.family": ["sans-serif"]}


def list_tables(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Every table of the research questions; if none can be answered, one table with the reason."""
    try:
        answers = answer_questions(cases)
    except UnanswerableError as error:
        return [{"title": "RQ1 to RQ3", "heads": (), "spans": (), "rows": [], "labels": 0, "notes": [f"{error.source}: {error.problem}."]}]
    return [_table_data(table) for question_table in answers for table in lay_out(question_table)]


def _table_data(table: Table) -> dict[str, Any]:
    columns, labels = table.frame.columns, table.frame.index.nlevels
    blocks = Counter(columns.get_level_values(0)) if columns.nlevels > 1 else {}
    heads = [] if table.frame.empty else [*table.frame.index.names, *columns.get_level_values(-1)]
    rows = [[{"text": superscript_powers(cell), "bold": isinstance(cell, BoldText)} for cell in row]
            for row in table.frame.reset_index().to_numpy().tolist()]
    return {"title": superscript_powers(table.title), "heads": list(map(superscript_powers, heads)), "rows": rows, "labels": labels,
            "spans": [("", labels), *((superscript_powers(name), width) for name, width in blocks.items())] if blocks else [],
            "notes": list(map(superscript_powers, table.notes))}


def embed_figures(cases: Sequence[Case]) -> list[dict[str, str]]:
    """Draw every figure of the research questions as a picture to embed in the page."""
    try:
        figures_by_name, _ = draw_figures(cases)
    except UnanswerableError:
        return []
    return [{"name": name, "alt": _alt_text(figure), "source": _data_url(figure)} for name, figure in figures_by_name.items()]


def _alt_text(figure: Figure) -> str:
    axis = figure.axes[0]
    return f"{figure.get_suptitle()}: {axis.get_ylabel() or 'values'} over {axis.get_xlabel() or 'characteristics'}".replace("\n", " ")


def _data_url(figure: Figure) -> str:
    import matplotlib

    buffer = BytesIO()
    with matplotlib.rc_context(SVG_STYLE):  # type: ignore[arg-type]
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    picture = LONG_DECIMALS.sub(r"\1", buffer.getvalue().decode())
    return "data:image/svg+xml," + quote(picture, safe=" =:/;,()'!?@&+$*")


def draw_front(data: ReportInput, handles: Sequence[str]) -> Markup:
    """Draw non-dominated solutions by largest change and safety degree; those of `handles` link to their replays."""
    rows = [row for row in data.solutions.values() if not np.isnan([row["f_safe"], row["f_diff"]]).any()]
    best = nondominated_rows(rows)
    selection = [best[index] for index in evenly_spaced_indices(len(best), MAX_DOTS)] + [row for row in rows if row["handle"] in handles]
    dots = {row["handle"]: _dot(data, row, row["handle"] in handles) for row in selection}
    return draw_scatter(f"{data.case.name}: safety degree over the largest change of the solutions that no other solution beats",
                        list(dots.values()), "largest change [% of the original]", "safety degree [m, or -m/s]", line=0.0,
                        line_title="collision below")


def _dot(data: ReportInput, row: dict[Any, Any], has_replay: bool) -> Dot:
    words = (f"{row['handle']}: {row['outcome']}, safety degree {row['f_safe']:.2f}, largest change {row['f_diff']:.0%}, "
             f"{row['f_num_diff']} changed")
    css_class = "hit" if row["outcome"] == "collision" else "miss"
    return Dot(100 * row["f_diff"], row["f_safe"], words, css_class, data.anchor("replay", row["handle"]) if has_replay else "")


def commands_to_reproduce(inputs: Sequence[ReportInput], questions: Sequence[str]) -> list[dict[str, str]]:
    """List the commands that reproduce the numbers of the page; `questions` are those that the page answers."""
    directories = " ".join(shlex.quote(str(data.directory)) for data in inputs)
    commands = []
    for data in inputs:
        directory, study = shlex.quote(str(data.directory)), data.case.study
        flag = " --as-it-is-now" if data.later_changes else ""
        if data.case.has_runs:
            commands.append({"what": f"The study {study.name}, as its manifest.json records it, into another directory",
                             "command": _rerun_command(study, f"{data.directory}-again", data.directory)})
        has_opinion = "explain" in questions and data.system is not None and not reason_without_opinion(data)
        commands += [{"what": f"The part {name}", "command": data.options[name].command_line(str(data.directory), data.point) + flag}
                     for name in (*questions, *(["opinion"] if has_opinion else []))]
        if data.point:
            continue
        commands.append({"what": "A replay, with figure and animation",
                         "command": f"{PROGRAM_COMMAND} simulate {directory} --most-severe --plot it.png --animate it.html{flag}"})
    if any(data.point for data in inputs):
        return commands
    commands.append({"what": "The tables of RQ1 to RQ3", "command": f"{PROGRAM_COMMAND} tables {directories}"})
    commands.append({"what": "The figures", "command": f"{PROGRAM_COMMAND} figures {directories} --out figures"})
    return commands


def _rerun_command(study: Study, out: str, directory: Path) -> str:
    """The command that runs a study again: `study` with options for a shipped study, else Python's `run` with the recorded study."""
    search = study.search
    if study.name in study_names():
        options = {name: getattr(search, name) for name in ("seed", "runs", "evaluations", "algorithms")}
        shipped = load_study(study.name)
        if msgspec.structs.replace(shipped, search=msgspec.structs.replace(shipped.search, **options), origin=study.origin) == study:
            flags = {**options, "algorithms": shlex.quote(",".join(search.algorithms)), "out": shlex.quote(out)}
            return " ".join([f"{PROGRAM_COMMAND} study {study.name}", *(f"--{name} {value}" for name, value in flags.items())])
    script = f"import safevar_sumo as sv; sv.run(sv.load({json.dumps(str(directory))}).study, out={json.dumps(out)}, progress=True)"
    return f"python -c {shlex.quote(script)}"


TEMPLATE_FOLDER = Path(__file__).parent / "web"
SECTIONS = {
    "verdict": "Verdict",
    "tested": "What was tested",
    "causes": "Causes",
    "tolerance": "Tolerances",
    "risk": "Share of unsafe vehicles",
    "rules": "Failure regions",
    "questions": "Research questions",
    "trust": "Limits and trust",
    "reproduce": "How to reproduce every number",
}
"""Headings of the sections in order, by the names that `--only` accepts."""


COMMAND_OF_SECTION = {"causes": "explain", **{name: name for name in DOMAIN_SECTIONS}}
"""The command that computes each section that needs simulations."""


def make_report(directories: Iterable[str | Path], only: Sequence[str] = (), jobs: int | None = None, progress: Progress = show_no_progress,
                *, point: str | None = None, as_it_is_now: bool = False) -> str:
    """Make the page about results in directories; parameters, warnings and errors are those of `safevar_sumo.report`."""
    unknown_names = [name for name in only if name not in SECTIONS]
    if unknown_names:
        raise InputError("only", f"there is no section {unknown_names[0]!r}{did_you_mean(unknown_names[0], SECTIONS)}",
                         f"some of {','.join(SECTIONS)}")
    sections = [name for name in SECTIONS if not only or name in only]
    if point is not None:
        if "questions" in only:
            raise InputError("only", "the research questions are about whole studies",
                             "sections other than questions with `point`")
        sections = [name for name in sections if name != "questions"]
    inputs = read_inputs(directories, point, as_it_is_now=as_it_is_now)
    for data in inputs:
        for change in data.later_changes:
            warn(f"{data.directory}: {change}")
    are_rated = [is_rated(data.case.study) and point is None for data in inputs]
    if any(are_rated):
        if not all(are_rated):
            raise InputError("directories", "some hold results of rated studies, others do not", "a report for each kind")
        return template_environment(TEMPLATE_FOLDER).get_template("rated.html.j2").render(
            title=f"Euro NCAP rating: {', '.join(data.case.name for data in inputs)}", css=_web_file("report.css"),
            studies=[rated_study_data(data, jobs, progress) for data in inputs]) + "\n"
    cases = [data.case for data in inputs] if "questions" in sections else []
    parts = PartsProgress(progress, {f"{data.directory}: {name}": number for data in inputs
                                     for name, number in data.simulation_counts.items() if name in sections})
    with ThreadPoolExecutor(1) as drawing_thread:  # meanwhile this process only waits for workers, and nothing else in it draws
        questions = drawing_thread.submit(lambda: (list_tables(cases), embed_figures(cases)) if cases else ([], []))
        studies = [_study_data(data, sections, jobs, parts) for data in inputs]
        progress("tables and figures", 0, 1)
        answers, pictures = questions.result()
    page = template_environment(TEMPLATE_FOLDER).get_template("report.html.j2").render(
        title=f"Safety report: {', '.join(data.case.name for data in inputs)}", sections={name: SECTIONS[name] for name in sections},
        studies=studies, tables=answers, figures=pictures,
        commands=commands_to_reproduce(inputs, [command for name, command in COMMAND_OF_SECTION.items() if name in sections])
        if "reproduce" in sections else [],
        simulated_sections=list(COMMAND_OF_SECTION), player=player_files(), css=_web_file("report.css"), js=_web_file("report.js"))
    progress("tables and figures", 1, 1)
    return page + "\n"


def _study_data(data: ReportInput, sections: Sequence[str], jobs: int | None,
                parts: PartsProgress) -> Mapping[str, Any]:
    """Make the data of one study that the templates of these sections need."""
    explanations, solutions = None, list[ReplayedSolution]()
    if "causes" in sections:
        progress = parts.begin(f"{data.directory}: causes")
        explanations = None if data.system is None else explain_main_failures(data, jobs, progress)
        solutions = replay_solutions(data, explanations, progress)
    domain_sections = {name: make(data, jobs, parts.begin(f"{data.directory}: {name}"))
                       for name, make in DOMAIN_SECTIONS.items() if name in sections and data.system is not None}
    makers: dict[str, Callable[[], Any]] = {
        "tested": lambda: describe_tested_system(data),
        "verdict": lambda: reach_verdict(data, explanations, domain_sections.get("tolerance")),
        "causes": lambda: make_cause_sections(explanations.failures if explanations else [], data),
        "opinion_problem": lambda: "" if data.system is None else reason_without_opinion(data),
        "necessity": lambda: draw_necessity(explanations.summary, data) if explanations else None,
        "trust": lambda: describe_limits(data, explanations)}
    different_handles = [solution.handle for solution in solutions if solution.differences]
    if different_handles:
        warn(f"{data.directory}: simulated again with different results: {', '.join(different_handles)}; "
             "have versions or code changed since the study?")
    return {"name": data.case.name, "title": data.case.study.title, "anchor": data.anchor(), "replays": solutions,
            "different": different_handles,
            "problem": data.problem, "no_verdict": data.no_verdict,
            "later_changes": data.later_changes, "original_fails": data.original_fails,
            "front": draw_front(data, [solution.handle for solution in solutions]) if solutions else None,
            **domain_sections, **{name: make() for name, make in makers.items()
                         if name in sections or (name in ("necessity", "opinion_problem") and "causes" in sections)}}


def _web_file(name: str) -> Markup:
    return Markup((TEMPLATE_FOLDER / name).read_text(encoding="utf-8"))
