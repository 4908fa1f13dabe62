"""The page about results. Each study begins with its first answer, replays, and the sheet for a
workshop; all other answers follow.
"""

from __future__ import annotations

import re
from collections import ChainMap
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from io import BytesIO
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.parse import quote

from markupsafe import Markup

from safevar_sumo.campaign.cache import keep_simulations
from safevar_sumo.campaign.pool import Pool, open_pool
from safevar_sumo.errors import InputError, check_text, printable, warn
from safevar_sumo.metrics import Unsafe
from safevar_sumo.output import check_writable
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.arguments import checked
from safevar_sumo.questions.ask import SIMULATIONS, Question
from safevar_sumo.questions.by_criterion import cases_by
from safevar_sumo.questions.case import Results, load_cases
from safevar_sumo.questions.figures import own_style
from safevar_sumo.questions.options import (
    CRITERION,
    Cluster,
    Jobs,
    PointName,
    Simulations,
)
from safevar_sumo.questions.subject import case_at, changes_since, with_own_set
from safevar_sumo.records import JsonObject
from safevar_sumo.replay.animation import template_environment
from safevar_sumo.report.budget import REPLAYS, SPEED, divided
from safevar_sumo.report.replays import page_commands, replays
from safevar_sumo.report.sections import ReportedStudy, tested, trust
from safevar_sumo.report.sheet import sheet_of, speeds_of, with_answers
from safevar_sumo.report.texts import answer_about, completed, parse_question
from safevar_sumo.results import read_manifest, write_whole
from safevar_sumo.sumo.simulators import simulations_of_setting
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import Parts, Progress, open_progress, show_no_progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SMALLEST = "explain --of-study"
USUAL_QUESTIONS = (
    "tolerance",
    SMALLEST,
    "explain",
    "risk --samples 4000",
    "rules --samples 4000",
)
"""Questions that a page answers unless the user asks others. The first answer leads the page.
Samples are smaller than the default of the commands.
"""
LEAST_COST = 40_000
"""Time of a question that `USUAL_COSTS` lacks, as the number of simulations that take as long. Only
the bar of progress needs this number and the next ones.
"""
USUAL_COSTS = {"tolerance": 500_000, "repair": 500_000, "explain": 100_000}
"""Usual times of questions by name, in the same unit."""
PAGE_COSTS = 25_000, 5_000
"""Times of a study's figures and of its replays, in the same unit."""
TEMPLATE_FOLDER = Path(__file__).parent / "web"
LONG_DECIMALS = re.compile(r"(\d\.\d\d)\d+")
"""A number with more than two decimals, more than a screen can show of a coordinate."""
TAG = re.compile(r"<[^>]*>")
SVG_STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "safevar_sumo",
    "font.family": ["sans-serif"],
}


@checked
def report(
    *results: Results | str | Path,
    out: str | Path = "report.html",
    ask: tuple[str, ...] = (),
    unsafe: Annotated[Unsafe | str | None, CRITERION] = None,
    point: PointName = None,
    jobs: Jobs = None,
    cluster: Cluster = None,
    progress: bool | Progress = False,
    as_it_is_now: bool = False,
    fresh: bool = False,
    quick: bool = False,
    simulations: Simulations = None,
) -> Path:
    """Write one HTML page about results. The page opens offline. The page has the answers,
    animated replays of failures, a sheet for the workshop, and the commands that compute every
    number again. The same results give the same page.

    Example: python -m safevar_sumo report results/rain

    Parameters
    ----------
    results
        Results, or their directories.
    out
        File to write the page to.
    ask
        Ask this question in place of the usual ones, such as "risk --samples 4000"; may be
        repeated. The answer to the first question leads the page.
    unsafe
        Criterion for an unsafe vehicle on the whole page, such as collision or "drac > 6". Default:
        the criterion of the study, else a collision.
    point
        Write the page about this test case only. Default: the page covers all test cases.
    jobs
        Number of worker processes. Default: one for each processor core.
    cluster
        Simulate on the workers of this Dask scheduler, such as tcp://host:8786. Default: on this
        machine.
    progress
        True for a bar on the terminal, or a function of a phase, the number of simulations done,
        and their total.
    as_it_is_now
        Use the present files and versions, although the results were computed with other files or
        versions. Default: an error.
    fresh
        Simulate everything again. Default: use simulations of earlier commands again.
    quick
        Give rough answers that prove nothing, with at most an eighth of the usual simulations.
        Nobody can sign the workshop sheet of a rough page.
    simulations
        Largest number of simulations of all questions and replays of the page together.

    Returns
    -------
    Path
        The file.

    Warns
    -----
    UserWarning
        If a simulation differs from the results; with `as_it_is_now`, for each change of a file or
        version.

    Raises
    ------
    InputError
        If a directory holds no results, there is no such question or point, or the file cannot be
        written.
    """
    if not results:
        raise InputError("report()", "no results", "results, or their directories")
    SIMULATIONS.check(simulations)
    criterion = None if unsafe is None else Unsafe.parse(unsafe)
    out = Path(out)
    check_writable(out, "out", (".html", ".htm"))

    paths = [
        Path(check_text("results", getattr(place, "directory", place)))
        for place in results
    ]
    cases = load_cases(paths)
    joint = _joint_questions(ask, len(cases))
    alone = [text for text in ask if text not in joint]
    later_changes = _later_changes(paths, cases, as_it_is_now=as_it_is_now)
    point_cases = _cases_asked_about(cases, point, quick=quick)
    key = f"report {paths} {point} {ask} {criterion} {quick}"
    with (
        open_progress(progress) as show,
        keep_simulations(key, fresh=fresh),
        ExitStack() as stack,
    ):
        criterion_cases = cases_by(
            point_cases, criterion, jobs, show_no_progress, cluster
        )
        questions = (
            [alone] * len(cases)
            if ask
            else [usual_questions(case) for case in criterion_cases]
        )
        texts_of = [
            with_speed_part(texts, case)
            for texts, case in zip(questions, criterion_cases, strict=True)
        ]
        texts = [*chain(*texts_of), *joint]
        # Joint questions take a part from the first results.
        texts_of[0] += joint
        budgets = parts_of_simulations(
            point_cases, criterion_cases, point, texts_of, simulations
        )
        pool = _pool_of(stack, cases, jobs, cluster, bool(simulations))
        numbers = count(1)
        costs = [USUAL_COSTS.get(text.split()[0], LEAST_COST) for text in texts]
        if simulations:
            # The questions have equal parts of the simulations.
            costs = [LEAST_COST] * len(texts)
        costs += PAGE_COSTS * len(cases)
        if simulations:
            # The bar counts the simulations that the user allows.
            total_cost = sum(costs)
            costs = [simulations * cost // total_cost for cost in costs]
        progress_parts = Parts(show, costs)

        def next_answer(
            places: slice, text: str, parsed: tuple[Question, JsonObject] | None = None
        ) -> Answer:
            """The answer to a question about the results at `places`."""
            question, values = parsed or parse_question(text)
            budget = ChainMap(*budgets[places]).get(text)
            values = completed(question, values, criterion, budget, quick=quick)
            # A question with another criterion than the page, or without any, must not get results
            # that are adapted to the page's criterion.
            subjects = (
                criterion_cases if values.get("unsafe") == criterion else point_cases
            )
            name = f"question {next(numbers)} of {len(texts)}, {question.name}"
            return answer_about(
                question,
                values,
                subjects[places],
                paths[places],
                point,
                jobs,
                progress_parts.begin(name),
                is_asked=bool(ask) and not parsed,
                as_it_is_now=as_it_is_now,
                pool=pool,
                questions=len(texts),
            )

        studies = []
        for number, path in enumerate(paths):
            study = ReportedStudy(
                directory=path,
                case=criterion_cases[number],
                versions=read_manifest(path)["versions"],
                point=point or "",
                later_changes=later_changes[number],
                simulations=budgets[number].get(REPLAYS),
            )
            ask_study = partial(next_answer, slice(number, number + 1))
            studies.append(with_answers(study, questions[number], ask_study))
        shared = [next_answer(slice(None), text) for text in joint]
        # Close the pool of workers: this process simulates the replays.
        stack.close()
        write_whole(out, make_page(studies, progress_parts, shared))
    return out


def _cases_asked_about(
    cases: Sequence[Results], point: str | None, *, quick: bool
) -> list[Results]:
    """The results about which the page asks: at a `point` if there is one, and only with the
    study's own parameter set if the page is `quick`.
    """
    if point is not None:
        cases = [case_at(case, point) for case in cases]
    if quick:
        return [with_own_set(case) for case in cases]
    return list(cases)


def parts_of_simulations(
    point_cases: Sequence[Results],
    criterion_cases: Sequence[Results],
    point: str | None,
    texts_of: Sequence[Sequence[str]],
    simulations: int | None,
) -> list[dict[str, int]]:
    """The largest numbers of simulations of the questions about each of the results (`texts_of`
    has their texts), by text; see `divided`. Without `simulations` there are no limits.

    All results have equal parts. Simulations that have already repeated solutions (at a point, or
    by a criterion) are subtracted.
    """
    if simulations is None:
        return [{}] * len(texts_of)
    budgets = []
    for case, adapted, texts in zip(
        point_cases, criterion_cases, texts_of, strict=True
    ):
        system = assemble(adapted.study)
        # The solutions are simulated at the point, and again if the criterion changes the study.
        is_at_point = point is not None
        is_by_criterion = adapted.study != case.study
        repetitions = [is_at_point, is_by_criterion].count(True)
        spent = repetitions * len(case.settings) * simulations_of_setting(system)
        budgets.append(divided(texts, simulations // len(texts_of) - spent, system))
    return budgets


def _pool_of(
    stack: ExitStack,
    cases: Sequence[Results],
    jobs: int | None,
    cluster: str | None,
    is_limited: bool,
) -> Pool | None:
    """The pool of workers that the questions of a page share; None if each question opens its own.
    If a simulator takes long, and simulations are limited (`is_limited`), the pool keeps its
    results, so that questions share samples.
    """
    take_long = any(assemble(case.study).mover.takes_long for case in cases)
    if not (take_long or cluster or is_limited):
        return None
    pool = stack.enter_context(open_pool(jobs, cluster))
    if take_long and is_limited:
        pool.shared = {}
    return pool


def with_speed_part(questions: Sequence[str], case: Results) -> list[str]:
    """The questions about results, and `SPEED` if the page has a sheet that states the greatest
    speed.
    """
    has_sheet = any(text.startswith("tolerance") for text in questions)
    if has_sheet and speeds_of(case):
        return [*questions, SPEED]
    return list(questions)


def _joint_questions(ask: Sequence[str], results: int) -> list[str]:
    """The questions about all results together: such questions among those that the user asks. If
    the user asks nothing, `compare` for two results.
    """
    usual = []
    if results == 2:
        usual = ["compare"]
    return [text for text in ask or usual if parse_question(text)[0].others]


def _later_changes(
    paths: Sequence[Path], cases: Sequence[Results], *, as_it_is_now: bool
) -> list[list[str]]:
    """The changes of files and versions since each of the results were computed. The user is warned
    of each change.
    """
    later_changes = []
    for path, case in zip(paths, cases, strict=True):
        changes = changes_since(path, case, as_it_is_now=as_it_is_now)
        for change in changes:
            warn(f"{path}: {change}")
        later_changes.append(changes)
    return later_changes


def usual_questions(case: Results) -> list[str]:
    """The questions of a page about results, unless the user asks others. The question about the
    smallest changes is left out with a simulator that takes long.
    """
    questions = list(USUAL_QUESTIONS)
    if assemble(case.study).mover.takes_long:
        questions.remove(SMALLEST)
    if case.study.repair.promise or case.study.limits:
        questions.append("repair")
    return questions


def make_page(
    studies: Sequence[ReportedStudy], parts: Parts, shared: Sequence[Answer] = ()
) -> str:
    """The HTML of the page about studies; `shared` are the answers about all studies together."""
    names = ", ".join(study.case.name for study in studies)
    commands = list(chain(*(page_commands(study) for study in studies)))
    for answer in shared:
        if answer.command:
            commands.append((f"The answer {answer.question}", answer.command))
    template = template_environment(TEMPLATE_FOLDER).get_template("report.html.j2")
    study_parts = [_study_parts(*pair, parts) for pair in enumerate(studies, 1)]
    page = template.render(
        title=f"Safety report: {names}",
        studies=study_parts,
        shared=list(_sections("all", shared)),
        commands=commands,
        css=Markup((TEMPLATE_FOLDER / "report.css").read_text(encoding="utf-8")),
    )
    # Units have powers, such as m/s^2: a page shows m/s².
    return printable(page).replace("^2", "²").replace("^3", "³") + "\n"


def _study_parts(number: int, study: ReportedStudy, parts: Parts) -> JsonObject:
    """The values of one study for the template. `front` is the first answer, which leads the page;
    `sections` are all other answers.
    """
    anchor = f"study-{number}"
    show = parts.begin()
    show("figures", 0, 0)
    answers = study.answers
    front, *sections = _sections(anchor, [*answers, tested(study), trust(study)])
    show = parts.begin()
    replayed = list(replays(study, show, start=100 * number))
    show("replays", 1, 1)
    return {
        "name": study.case.name,
        "title": study.case.study.title,
        "anchor": anchor,
        "is_bad": any(answer.failures for answer in answers),
        "shortfall": study.case.shortfall,
        "later_changes": study.later_changes,
        "sheet": sheet_of(study),
        "study": study.case.study,
        "versions": study.versions,
        "is_for_workshop": study.has_workshop_parts,
        "front": front,
        "replays": replayed,
        "sections": sections,
    }


def _sections(anchor: str, answers: Iterable[Answer]) -> Iterator[JsonObject]:
    """Yield the values of answers for the template: the heading, the answer in HTML, and its figure
    (None without a figure).
    """
    for number, answer in enumerate(answers, 1):
        name = "smallest changes"
        if "staircase" not in answer.tables:
            name = answer.question
        try:
            picture = _picture(answer.figure())
        except InputError:
            # The answer has nothing to draw.
            picture = None
        yield {
            "anchor": f"{anchor}-{number}-{re.sub('[^a-z]', '-', name.lower())}",
            "heading": name[:1].upper() + name[1:],
            "html": Markup(answer.render("html")),
            "picture": picture,
        }


@own_style()
def _picture(figure: Figure) -> JsonObject:
    """A figure for the page: a text that describes it, and a link that contains Matplotlib's SVG.
    Equal figures give equal bytes.
    """
    import matplotlib

    axis = figure.axes[0]
    buffer = BytesIO()
    with matplotlib.rc_context(SVG_STYLE):  # type: ignore[arg-type]
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    # Only coordinates, which stand in tags, are shortened: texts keep their digits.
    svg = TAG.sub(
        lambda tag: LONG_DECIMALS.sub(r"\1", tag[0]), buffer.getvalue().decode()
    )
    words = (
        f"{figure.get_suptitle()}: {axis.get_ylabel() or 'values'} over"
        f" {axis.get_xlabel() or 'characteristics'}"
    )
    return {
        "alt": words.replace("\n", " "),
        "source": "data:image/svg+xml," + quote(svg, safe=" =:/;,()'!?@&+$*"),
    }
