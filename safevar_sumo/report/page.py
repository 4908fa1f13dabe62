"""The page of a report: its sections, from the answers to the questions, and the commands that reproduce its
numbers.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from urllib.parse import quote

import pandas as pd
from markupsafe import Markup

from safevar_sumo.errors import InputError, did_you_mean, warn
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.case import Case, UnanswerableError
from safevar_sumo.questions.explain.failures import DISTINCT_CAUSE
from safevar_sumo.questions.research_questions.answer import answer_questions
from safevar_sumo.questions.research_questions.figures import draw_figures
from safevar_sumo.questions.subject import Results
from safevar_sumo.questions.words import question_command
from safevar_sumo.records import JsonObject
from safevar_sumo.replay.animation import player_files, template_environment
from safevar_sumo.replay.comparison import why_different
from safevar_sumo.report.input import ReportInput, read_inputs
from safevar_sumo.report.sections import (
    GENERAL_LIMITS,
    describe_agreement,
    describe_failure,
    describe_limits,
    describe_tested_system,
    make_cause_sections,
    make_verdict,
    reason_without_opinion,
    replay_solutions,
    table_data,
)
from safevar_sumo.results import write_whole
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.terminal import Progress, open_progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONG_DECIMALS = re.compile(r"(\d\.\d\d)\d+")
"""Numbers with more decimals than a screen can show."""
SVG_STYLE = {"svg.fonttype": "none", "svg.hashsalt": "safevar_sumo", "font.family": ["sans-serif"]}
HIDDEN_COLUMNS = ("lower", "upper", "not_simulated")
"""Columns of an answer's frame that the table beside its figure leaves out."""


def render_tables(cases: Sequence[Case]) -> Markup:
    """Every table of the research questions; if none can be answered, the reason."""
    try:
        return Markup(answer_questions(cases).render("html"))
    except UnanswerableError as error:
        return Markup("<p>{}</p>").format(f"{error.source}: {error.problem}.")


def _limits(tolerance: Answer) -> Markup:
    """The decision on the limits, and their table."""
    return Markup(replace(tolerance, tables={"limits": tolerance.tables["limits"]}).render("html"))


def figure_data(figure: Figure, frame: pd.DataFrame) -> JsonObject:
    """An answer's figure, with its values as a table."""
    shown = frame[[name for name in frame if name not in HIDDEN_COLUMNS]].set_index("characteristic")
    return {**_picture("", figure), "table": table_data(shown, "Values of the figure")}


def embed_figures(cases: Sequence[Case]) -> list[dict[str, str]]:
    """Draw every figure of the research questions as a picture to embed in the page."""
    try:
        figures_by_name = draw_figures(cases)
    except UnanswerableError:
        return []
    return [_picture(name, figure) for name, figure in figures_by_name.items()]


def _picture(name: str, figure: Figure) -> dict[str, str]:
    """A figure for the page: Matplotlib's SVG in a link that holds it; equal figures give equal bytes."""
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


def commands_to_reproduce(inputs: Sequence[ReportInput], sections: Collection[str]) -> list[tuple[str, str]]:
    """The commands that give the numbers of the page, each after what it reproduces."""
    commands = []
    for data in inputs:
        directory, flag = str(data.directory), " --as-it-is-now" if data.later_changes else ""
        if data.case.has_runs:
            out = json.dumps(f"{directory}-again")
            script = (
                f"import safevar_sumo as sv; sv.run(sv.load({json.dumps(directory)}).study, out={out}, progress=True)"
            )
            what = f"The study {data.case.study.name}, as its manifest.json records it, into another directory"
            commands.append((what, f"python -c {shlex.quote(script)}"))
        asked = questions_of(sections)
        if "causes" in sections and not reason_without_opinion(data):
            asked.append("opinion")
        commands += [(f"The part {name}", data.command(name) + flag) for name in asked]
        if not data.point:
            simulate = question_command("simulate", directory)
            what = "A replay, with figure and animation"
            commands.append((what, f"{simulate} --most-severe --plot it.png --animate it.html{flag}"))
    directories = " ".join(shlex.quote(str(data.directory)) for data in inputs)
    flags = f" --point {shlex.quote(inputs[0].point)}" if inputs[0].point else ""
    if "compare" in sections:
        commands.append(("The comparison", f"{PROGRAM_COMMAND} compare {directories}{flags}"))
    if "questions" in sections:
        commands.append(("RQ1 to RQ3", f"{PROGRAM_COMMAND} tables {directories} --figures figures"))
    return commands


TEMPLATE_FOLDER = Path(__file__).parent / "web"
SECTIONS = {
    "verdict": "Verdict",
    "tested": "What was tested",
    "causes": "Causes",
    "tolerance": "Tolerances",
    "risk": "Share of unsafe vehicles",
    "rules": "Failure regions",
    "repair": "Repair",
    "compare": "The two systems compared",
    "questions": "Research questions",
    "trust": "Limits and trust",
    "reproduce": "How to reproduce every number",
}
"""Headings of the sections in order, by the names that `--only` accepts."""


QUESTION_OF_SECTION = {"verdict": "explain", "causes": "explain"}
QUESTION_OF_SECTION |= {name: name for name in ("tolerance", "risk", "rules", "repair")}
"""The question that each section answers which needs simulations of its own."""


def questions_of(sections: Collection[str]) -> list[str]:
    """The questions that sections answer."""
    return list(dict.fromkeys(question for name, question in QUESTION_OF_SECTION.items() if name in sections))


def report(
    *results: Results | str | Path,
    out: str | Path | None = None,
    only: Sequence[str] = (),
    paper: bool = False,
    point: str | None = None,
    margin: float | None = None,
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
        Name of the only point of the study's matrix that the page is about; research questions need whole studies.
    margin
        Distance to keep [m] of tolerances and repairs; by default the model's error that a study states, else 0.3 m.
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
        If a simulation differs from the results; with `as_it_is_now`, for each change of a file or version.

    Raises
    ------
    InputError
        If a directory holds no results, there is no such section or point, or the file cannot be written.
    """
    _check_sections(only, paper, point)
    directories = [source.directory if isinstance(source, Results) else source for source in results]
    inputs = read_inputs(directories, point, margin, as_it_is_now=as_it_is_now)
    if len({data.is_rated for data in inputs}) > 1:
        problem = "some hold results of rated studies, others do not"
        raise InputError("directories", problem, "a report for each kind")
    if len(inputs) != 2 and "compare" in only:
        raise InputError("only", f"compare needs two results, and there are {len(inputs)}", "two results directories")
    for data in inputs:
        for change in data.later_changes:
            warn(f"{data.directory}: {change}")
    is_possible = {
        "questions": paper,
        "compare": len(inputs) == 2,
        "repair": all(data.case.study.repair.promise or data.case.study.limits for data in inputs),
    }
    sections = only or [name for name in SECTIONS if is_possible.get(name, True)]
    with open_progress(progress) as show_progress:
        answers = [answer_sections(data, sections, jobs, show_progress) for data in inputs]
        if "compare" in sections:
            answers[0]["compare"] = _compare(inputs, jobs, show_progress)
        page = make_page(inputs, sections, answers, show_progress)
    if out is not None:
        write_whole(Path(out), page)
    return page


def _check_sections(only: Sequence[str], paper: bool, point: str | None) -> None:
    """Refuse unknown sections, and research questions about one point."""
    if unknown := [name for name in only if name not in SECTIONS]:
        hint = did_you_mean(unknown[0], SECTIONS)
        raise InputError("only", f"there is no section {unknown[0]!r}{hint}", f"some of {','.join(SECTIONS)}")
    if point is not None and (paper or "questions" in only):
        problem = "the research questions are about whole studies"
        raise InputError("point", problem, "the page without them, or no `point`")


def answer_sections(
    data: ReportInput, sections: Collection[str], jobs: int | None, progress: Progress
) -> dict[str, Any]:
    """The answers about one study that sections of a page need, by question; a rated study has only its rating."""
    questions = ["rating"] if data.is_rated else questions_of(sections)
    if data.case.solutions.empty and "explain" in questions:
        questions.remove("explain")
    return {question: data.ask(question, jobs, progress) for question in questions}


def make_page(
    inputs: Sequence[ReportInput], sections: Collection[str], answers: Sequence[Mapping[str, Any]], progress: Progress
) -> str:
    """The page with these sections, from the answers about each study."""
    names = ", ".join(data.case.name for data in inputs)
    if inputs[0].is_rated:
        rated = [rated_study_data(data, given["rating"]) for data, given in zip(inputs, answers, strict=True)]
        return _render("rated.html.j2", title=f"Euro NCAP rating: {names}", studies=rated)
    studies = [_study_data(data, sections, given, progress) for data, given in zip(inputs, answers, strict=True)]
    progress("tables and figures", 0, 1)
    cases = [data.case for data in inputs] if "questions" in sections else []
    return _render(
        "report.html.j2",
        title=f"Safety report: {names}",
        sections={name: heading for name, heading in SECTIONS.items() if name in sections},
        studies=studies,
        tables=render_tables(cases) if cases else "",
        figures=embed_figures(cases) if cases else [],
        commands=commands_to_reproduce(inputs, sections) if "reproduce" in sections else [],
        general_limits=GENERAL_LIMITS,
        player=player_files(),
        js=_web_file("report.js"),
    )


def _study_data(
    data: ReportInput, sections: Collection[str], answers: Mapping[str, Any], progress: Progress
) -> JsonObject:
    """The data of one study that the templates of these sections need."""
    explained: Answer | None = answers.get("explain")
    failures = explained.tables["solutions"].to_dict("records") if explained else []
    choices: list[Any] = [row for row in failures if row["reason"] != DISTINCT_CAUSE]
    rendered = {name: answer for name, answer in answers.items() if isinstance(answer, Answer)}
    replays = replay_solutions(data, explained, progress) if "causes" in sections else []
    different = [solution["handle"] for solution in replays if solution["differences"]]
    why = why_different(is_imported=not data.case.has_runs)
    if different:
        warn(f"{data.directory}: simulated again with different results: {', '.join(different)}; {why}")
    makers: dict[str, Callable[[], Any]] = {
        "tested": lambda: describe_tested_system(data),
        "verdict": lambda: make_verdict(data, explained),
        "causes": lambda: make_cause_sections(data, explained) if explained else [],
        "trust": lambda: describe_limits(data, explained),
    }
    return {
        "name": data.case.name,
        "title": data.case.study.title,
        "anchor": data.anchor(),
        "replays": replays,
        "failures": [describe_failure(data, failure) for failure in choices],
        "picture": _picture("failure", data.draw_failure(choices[0]["solution"]))
        if choices and "verdict" in sections
        else None,
        "different": different,
        "why_different": why,
        "agreement": describe_agreement(data.case.study),
        "no_verdict": why_no_verdict(data.system),
        "later_changes": data.later_changes,
        "opinion_problem": reason_without_opinion(data),
        "statistics": figure_data(
            explained.figure(), explained.tables["characteristics"].drop(columns="needed_in_fits")
        )
        if explained and explained.numbers["analysed"]
        else None,
        "rendered": {name: Markup(answer.render("html")) for name, answer in rendered.items()},
        "limits": _limits(rendered["tolerance"]) if "tolerance" in rendered else None,
        **{name: make() for name, make in makers.items() if name in sections},
    }


def _compare(inputs: Sequence[ReportInput], jobs: int | None, progress: Progress) -> Answer:
    """Two studies side by side, or the reason why they cannot be compared."""
    first, second = inputs
    try:
        return cast(Answer, first.ask("compare", jobs, progress, second.case))
    except InputError as error:
        verdict = f"{error.problem}."
        return Answer(question="compare", study=first.case.study, verdict=verdict, numbers={}, tables={})


def rated_study_data(data: ReportInput, rating: Answer) -> JsonObject:
    """The page's data about one rated study: the points of the original vehicle and of its variant."""
    further = [question_command(question, str(data.directory)) for question in ("tolerance", "explain")]
    return {
        "title": data.case.study.title,
        "answer": Markup(rating.render("html")),
        "picture": _picture("matrices", rating.figure()),
        "commands": [data.command("rating"), *further],
    }


def _render(template: str, **values: Any) -> str:
    page = template_environment(TEMPLATE_FOLDER).get_template(template).render(css=_web_file("report.css"), **values)
    return page.replace("^2", "²").replace("^3", "³") + "\n"  # the powers of units, as in m/s^2


def _web_file(name: str) -> Markup:
    return Markup((TEMPLATE_FOLDER / name).read_text(encoding="utf-8"))
