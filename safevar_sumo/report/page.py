"""The page of a report: its sections, from the answers to the questions, and the commands that reproduce its
numbers.
"""

from __future__ import annotations

import json
import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import msgspec
import pandas as pd
from markupsafe import Markup

from safevar_sumo.analysis.explain.compute import explain_failures
from safevar_sumo.analysis.explain.result import Explained
from safevar_sumo.analysis.research_questions.answer import answer_questions
from safevar_sumo.analysis.research_questions.case import Case, UnanswerableError
from safevar_sumo.analysis.research_questions.gallery import draw_figures
from safevar_sumo.analysis.research_questions.layout import BoldText, lay_out
from safevar_sumo.analysis.risk.compute import estimate_risk
from safevar_sumo.analysis.rules.compute import find_rules
from safevar_sumo.analysis.tolerance.compute import find_tolerances
from safevar_sumo.errors import InputError, did_you_mean, warn
from safevar_sumo.progress import PartsProgress, Progress, show_no_progress
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.replay.comparison import format_number, superscript_powers
from safevar_sumo.replay.page import player_files, template_environment
from safevar_sumo.report.causes import make_cause_sections, make_verdict, reason_without_opinion, replay_solutions
from safevar_sumo.report.input import ReportInput, read_inputs
from safevar_sumo.report.rated import rated_study_data
from safevar_sumo.report.tested import describe_tested_system
from safevar_sumo.report.trust import describe_agreement, describe_limits
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.study import Study, load_study, study_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONG_DECIMALS = re.compile(r"(\d\.\d\d)\d+")
"""Numbers with more decimals than a screen can show."""
SVG_STYLE = {"svg.fonttype": "none", "svg.hashsalt": "safevar_sumo", "font.family": ["sans-serif"]}
DOMAIN_QUESTIONS: Mapping[str, Callable[..., Any]] = {
    "tolerance": find_tolerances,
    "risk": estimate_risk,
    "rules": find_rules,
}
"""Functions that answer the questions about the whole domain, by the name of the section and of the command."""
HIDDEN_COLUMNS = ("lower", "upper", "not_simulated")
"""Columns of an answer's frame that the table beside its figure leaves out."""


def list_tables(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Every table of the research questions; if none can be answered, one table with the reason."""
    try:
        answers = answer_questions(cases)
    except UnanswerableError as error:
        return [table_data(pd.DataFrame(), "RQ1 to RQ3", [f"{error.source}: {error.problem}."])]
    return [table_data(table.frame, table.title, table.notes) for answer in answers for table in lay_out(answer)]


def table_data(frame: pd.DataFrame, title: str, notes: Iterable[str] = ()) -> dict[str, Any]:
    """A frame as the template's table: the index as labels, the outer level of columns as headings over several
    columns.
    """
    columns, labels = frame.columns, frame.index.nlevels
    blocks = Counter(columns.get_level_values(0)) if columns.nlevels > 1 else {}
    rows = [
        [{"text": _cell_text(cell), "bold": isinstance(cell, BoldText)} for cell in row]
        for row in frame.reset_index().to_numpy(dtype=object).tolist()
    ]
    heads = [] if frame.empty else [*frame.index.names, *columns.get_level_values(-1)]
    return {
        "title": superscript_powers(title),
        "heads": [superscript_powers(str(head)) for head in heads],
        "rows": rows,
        "labels": labels,
        "spans": [("", labels), *((superscript_powers(name), width) for name, width in blocks.items())]
        if blocks
        else [],
        "notes": list(map(superscript_powers, notes)),
    }


def _cell_text(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(f"{format_number(low)} to {format_number(high)}" for low, high in value)
    if isinstance(value, float):
        return "" if pd.isna(value) else format_number(value)
    return "" if value is None else superscript_powers(str(value))


def figure_data(figure: Figure, frame: pd.DataFrame) -> dict[str, Any]:
    """An answer's figure, with its values as a table."""
    shown = frame[[name for name in frame if name not in HIDDEN_COLUMNS]].set_index("characteristic")
    return {**_picture("", figure), "table": table_data(shown, "Values of the figure")}


def embed_figures(cases: Sequence[Case]) -> list[dict[str, str]]:
    """Draw every figure of the research questions as a picture to embed in the page."""
    try:
        figures_by_name, _ = draw_figures(cases)
    except UnanswerableError:
        return []
    return [_picture(name, figure) for name, figure in figures_by_name.items()]


def _picture(name: str, figure: Figure) -> dict[str, str]:
    """A figure as Matplotlib's SVG, in a link that holds it; equal figures give equal bytes."""
    import matplotlib

    axis, buffer = figure.axes[0], BytesIO()
    with matplotlib.rc_context(SVG_STYLE):  # type: ignore[arg-type]
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    svg = LONG_DECIMALS.sub(r"\1", buffer.getvalue().decode())
    words = f"{figure.get_suptitle()}: {axis.get_ylabel() or 'values'} over {axis.get_xlabel() or 'characteristics'}"
    return {
        "name": name,
        "alt": words.replace("\n", " "),
        "source": "data:image/svg+xml," + quote(svg, safe=" =:/;,()'!?@&+$*"),
    }


def commands_to_reproduce(inputs: Sequence[ReportInput], questions: Sequence[str]) -> list[dict[str, str]]:
    """List the commands that reproduce the numbers of the page; `questions` are those that the page answers."""
    directories = " ".join(shlex.quote(str(data.directory)) for data in inputs)
    commands = []
    for data in inputs:
        directory, study = shlex.quote(str(data.directory)), data.case.study
        flag = " --as-it-is-now" if data.later_changes else ""
        if data.case.has_runs:
            commands.append(
                {
                    "what": f"The study {study.name}, as its manifest.json records it, into another directory",
                    "command": _rerun_command(study, f"{data.directory}-again", data.directory),
                }
            )
        has_opinion = "explain" in questions and data.system is not None and not reason_without_opinion(data)
        commands += [
            {
                "what": f"The part {name}",
                "command": data.options[name].command_line(str(data.directory), data.point) + flag,
            }
            for name in (*questions, *(["opinion"] if has_opinion else []))
        ]
        if data.point:
            continue
        commands.append(
            {
                "what": "A replay, with figure and animation",
                "command": f"{PROGRAM_COMMAND} simulate {directory} --most-severe --plot it.png "
                f"--animate it.html{flag}",
            }
        )
    if any(data.point for data in inputs):
        return commands
    commands.append({"what": "The tables of RQ1 to RQ3", "command": f"{PROGRAM_COMMAND} tables {directories}"})
    commands.append({"what": "The figures", "command": f"{PROGRAM_COMMAND} figures {directories} --out figures"})
    return commands


def _rerun_command(study: Study, out: str, directory: Path) -> str:
    """The command that runs a study again: `study` with options for a shipped study, else Python's `run` with the
    recorded study.
    """
    search = study.search
    if study.name in study_names():
        options = {name: getattr(search, name) for name in ("seed", "runs", "evaluations", "algorithms")}
        shipped = load_study(study.name)
        if (
            msgspec.structs.replace(
                shipped, search=msgspec.structs.replace(shipped.search, **options), origin=study.origin
            )
            == study
        ):
            flags = {**options, "algorithms": shlex.quote(",".join(search.algorithms)), "out": shlex.quote(out)}
            return " ".join(
                [f"{PROGRAM_COMMAND} study {study.name}", *(f"--{name} {value}" for name, value in flags.items())]
            )
    script = (
        f"import safevar_sumo as sv; sv.run(sv.load({json.dumps(str(directory))}).study, out={json.dumps(out)}, "
        "progress=True)"
    )
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


COMMAND_OF_SECTION = {"causes": "explain", **{name: name for name in DOMAIN_QUESTIONS}}
"""The command that computes each section that needs simulations."""


def make_report(
    directories: Iterable[str | Path],
    only: Sequence[str] = (),
    jobs: int | None = None,
    progress: Progress = show_no_progress,
    *,
    point: str | None = None,
    as_it_is_now: bool = False,
) -> str:
    """Make the page about results in directories; parameters, warnings and errors are those of
    `safevar_sumo.report`.
    """
    unknown_names = [name for name in only if name not in SECTIONS]
    if unknown_names:
        raise InputError(
            "only",
            f"there is no section {unknown_names[0]!r}{did_you_mean(unknown_names[0], SECTIONS)}",
            f"some of {','.join(SECTIONS)}",
        )
    sections = [name for name in SECTIONS if not only or name in only]
    if point is not None:
        if "questions" in only:
            raise InputError(
                "only", "the research questions are about whole studies", "sections other than questions with `point`"
            )
        sections = [name for name in sections if name != "questions"]
    inputs = read_inputs(directories, point, as_it_is_now=as_it_is_now)
    for data in inputs:
        for change in data.later_changes:
            warn(f"{data.directory}: {change}")
    are_rated = [is_rated(data.case.study) and point is None for data in inputs]
    if any(are_rated):
        if not all(are_rated):
            raise InputError(
                "directories", "some hold results of rated studies, others do not", "a report for each kind"
            )
        return (
            template_environment(TEMPLATE_FOLDER)
            .get_template("rated.html.j2")
            .render(
                title=f"Euro NCAP rating: {', '.join(data.case.name for data in inputs)}",
                css=_web_file("report.css"),
                studies=[rated_study_data(data, jobs, progress) for data in inputs],
            )
            + "\n"
        )
    cases = [data.case for data in inputs] if "questions" in sections else []
    parts = PartsProgress(
        progress,
        {
            f"{data.directory}: {name}": number
            for data in inputs
            for name, number in data.simulation_counts.items()
            if name in sections
        },
    )
    studies = [_study_data(data, sections, jobs, parts) for data in inputs]
    progress("tables and figures", 0, 1)
    page = (
        template_environment(TEMPLATE_FOLDER)
        .get_template("report.html.j2")
        .render(
            title=f"Safety report: {', '.join(data.case.name for data in inputs)}",
            sections={name: SECTIONS[name] for name in sections},
            studies=studies,
            tables=list_tables(cases) if cases else [],
            figures=embed_figures(cases) if cases else [],
            commands=commands_to_reproduce(
                inputs, [command for name, command in COMMAND_OF_SECTION.items() if name in sections]
            )
            if "reproduce" in sections
            else [],
            simulated_sections=list(COMMAND_OF_SECTION),
            as_table=partial(table_data, title="Failing points"),
            player=player_files(),
            css=_web_file("report.css"),
            js=_web_file("report.js"),
        )
    )
    progress("tables and figures", 1, 1)
    return page + "\n"


def _study_data(
    data: ReportInput, sections: Sequence[str], jobs: int | None, parts: PartsProgress
) -> Mapping[str, Any]:
    """Make the data of one study that the templates of these sections need."""

    def answer(name: str, compute: Callable[..., Any], progress: Progress, **options: bool) -> Any:
        return compute(data.case, data.options[name], jobs=jobs, progress=progress, **options)

    progress = parts.begin(f"{data.directory}: causes") if "causes" in sections else show_no_progress
    explained: Explained | None = None
    if data.system is not None and {"verdict", "causes"} & {*sections} and len(data.case.solutions):
        explained = answer("explain", explain_failures, progress, statistics="causes" in sections)
    solutions = replay_solutions(data, explained, progress) if "causes" in sections else []
    answers = {
        name: answer(name, compute, parts.begin(f"{data.directory}: {name}"))
        for name, compute in DOMAIN_QUESTIONS.items()
        if name in sections and data.system is not None
    }
    different = [solution["handle"] for solution in solutions if solution["differences"]]
    if different:
        warn(
            f"{data.directory}: simulated again with different results: {', '.join(different)}; "
            "have versions or code changed since the study?"
        )
    makers: dict[str, Callable[[], Any]] = {
        "tested": lambda: describe_tested_system(data),
        "verdict": lambda: make_verdict(data, explained, answers.get("tolerance")),
        "causes": lambda: make_cause_sections(data, explained) if explained else [],
        "trust": lambda: describe_limits(data, explained),
    }
    return {
        "name": data.case.name,
        "title": data.case.study.title,
        "anchor": data.anchor(),
        "replays": solutions,
        "different": different,
        "agreement": describe_agreement(data.case.study),
        "problem": data.problem,
        "no_verdict": data.no_verdict,
        "later_changes": data.later_changes,
        "opinion_problem": "" if data.system is None else reason_without_opinion(data),
        "statistics": figure_data(explained.figure(), explained.necessity)
        if explained and explained.analysed
        else None,
        "answers": {
            name: [superscript_powers(sentence) for sentence in result.sentences() if isinstance(sentence, str)]
            for name, result in answers.items()
        },
        "figures": {
            name: figure_data(result.figure(), result.to_frame())
            for name, result in answers.items()
            if name != "rules" and not result.to_frame().empty
        },
        **{name: make() for name, make in makers.items() if name in sections},
    }


def _web_file(name: str) -> Markup:
    return Markup((TEMPLATE_FOLDER / name).read_text(encoding="utf-8"))
