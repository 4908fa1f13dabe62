"""The research questions of the paper, answered about results as tables and figures."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import pandas as pd

from safevar_sumo.errors import InputError, check_name
from safevar_sumo.questions.answer import Answer, Columns, contents, tabulate
from safevar_sumo.questions.arguments import checked
from safevar_sumo.questions.case import (
    NSGA2,
    Results,
    UnanswerableError,
    are_collisions,
    load_cases,
    solutions_for_metric,
)
from safevar_sumo.questions.options import Fraction, Jobs, Range, options_of
from safevar_sumo.questions.research_questions import changes
from safevar_sumo.questions.research_questions.comparisons import (
    DEFAULT,
    Choices,
    describe_runs_without_solutions,
    titles_of,
)
from safevar_sumo.questions.research_questions.figures import draw_figures, save_figures
from safevar_sumo.questions.research_questions.fronts import (
    count_evaluations,
    describe_evaluations,
    describe_rules,
    why_few_evaluations,
)
from safevar_sumo.questions.research_questions.statistics import ALPHA, fewest_runs
from safevar_sumo.questions.research_questions.tables import (
    AS_PUBLISHED,
    CAUSES,
    CHOSEN,
    FUNCTIONS,
    ON_REQUEST,
    OVER_RUNS,
    POOLED,
    TABLES,
)
from safevar_sumo.questions.sentence import Sentences, Verdict, answer, note
from safevar_sumo.questions.words import demanded_in_words, join_phrases, number_of
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.study import SAFETY_DEGREE, label_of
from safevar_sumo.terminal import open_progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REMARKS: Columns = {
    "table": "table",
    "remark": "what is missing or left out there, and why",
}

NO_SOLUTION = answer("The results of {name} contain no solution: {reason}.")
COLLISIONS = answer("{count} of the {total} different solutions of {name} collide.")
LESS_SAFE = (
    answer(
        "{count} of the {total} solutions of {algorithm} are less safe than the original vehicle."
    ),
    answer(
        "{count} of the {total} solutions of {algorithm} are less safe than the original vehicle"
        " in the same encounter."
    ),
)
"""The sentence if the study lists its encounters, and the sentence if encounters are ranges."""
REMARK = note("Remark: {remark}")


@contents(
    "cases",
    "solutions",
    "alpha",
    **{name: table.columns for name, table in TABLES.items()},
    remarks=REMARKS,
)
@checked
def tables(
    *results: Results | str | Path,
    algorithm: str = "",
    alpha: Fraction = ALPHA,
    causes: Annotated[int, Range(0, 100_000)] = 0,
    figures: Path | None = None,
    jobs: Jobs = None,
    table: str | None = None,
) -> Answer:
    """Answer the three research questions of the published SafeVar study from results, as tables
    and figures. RQ1 compares the search with the original vehicle, RQ2 compares the algorithms, and
    RQ3 describes the changes. Each directory of results has its own rows in the tables.

    Example: python -m safevar_sumo tables results/rain --table rq3.2

    Parameters
    ----------
    algorithm
        Algorithm that is compared with all other algorithms (RQ2). Default: NSGA-II, else the first
        algorithm of the study.
    alpha
        Significance level of the tests. Intervals have the confidence 1 - alpha.
    causes
        Number of unsafe solutions of each run that further simulations reduce to the changes that
        the failure needs (minimal causes). Default: none.
    figures
        Directory for all figures, as png and pdf.
    jobs
        Number of worker processes. Default: one for each processor core.
    table
        Print only this table of the answer. The line "More:" of an answer names the tables.
    """
    options_of(tables)["alpha"].check(alpha)
    if table:
        check_name(
            "table",
            f"there is no table {table!r}",
            table,
            {**TABLES, "remarks": REMARKS},
        )
    directories = _directories_of(results)
    cases = load_cases(directories)
    if algorithm:
        labels = set[str]()
        for case in cases:
            labels |= {*case.algorithms, *case.study.search.labels}
        check_name(
            "algorithm",
            f"the results have no {algorithm!r}",
            label_of(algorithm),
            labels,
        )
    causes_of_cases = {
        case.name: _causes_of_runs(case, causes, jobs)
        for case in cases
        if causes and case.has_runs
    }

    names: Collection[str] = FUNCTIONS
    options = {"algorithm": algorithm, "alpha": alpha, "causes": causes}
    if table in ON_REQUEST:
        names = [table]
        options["table"] = table
    answer = answer_questions(
        cases, Choices(label_of(algorithm), alpha, causes_of_cases), names
    )
    if figures is not None:
        save_figures(cases, figures)
    words = [PROGRAM_COMMAND, "tables"]
    words += map(quote, map(str, directories))
    for name, value in options.items():
        if value not in ("", ALPHA, 0):
            words += [f"--{name}", quote(str(value))]
    has_runs = any(case.has_runs for case in cases)
    leading = OVER_RUNS if has_runs else POOLED
    present = [name for name in leading if name in answer.tables]
    lead = present[0] if present else ""
    folded = AS_PUBLISHED if has_runs else ()
    return replace(answer, command=" ".join(words), lead=lead, folded=folded)


@checked
def figures(*results: Results | str | Path) -> dict[str, Figure]:
    """Every figure of results by name, such as "pareto-fronts"; of several results, the case's name
    comes first: "rain-pareto-fronts".

    Raises
    ------
    InputError
        If no figure can be drawn.
    """
    return draw_figures(load_cases(_directories_of(results)))


def _directories_of(results: Sequence[Results | str | Path]) -> list[Any]:
    """The directory of each of several results, which are given as `Results` or as paths."""
    if not results:
        raise InputError("results", "none are given", "results, or their directories")
    return [getattr(source, "directory", source) for source in results]


def _causes_of_runs(case: Results, limit: int, jobs: int | None) -> pd.DataFrame:
    """The numbers of minimal causes of a case's runs. Up to `limit` unsafe solutions of each run
    are reduced to their causes by simulation.
    """
    from safevar_sumo.questions.causes import causes_of_runs
    from safevar_sumo.questions.evaluator import open_evaluator

    with (
        open_progress(True) as show,
        open_evaluator(case.study, None, jobs, show) as evaluator,
    ):
        return causes_of_runs(case, evaluator, limit)


def answer_questions(
    cases: Sequence[Results],
    choices: Choices = DEFAULT,
    names: Collection[str] = FUNCTIONS,
) -> Answer:
    """The tables called `names`, each with the rows of all cases. A case that cannot answer a table
    has no row in it, and a remark says why.

    Raises
    ------
    UnanswerableError
        If no case answers any table.
    """
    words = titles_of(cases)
    tables = {}
    remarks = []
    errors = []
    for name in names:
        title, compute, columns, wide = TABLES[name]
        title = title.format(level=f"{100 - 100 * choices.alpha:g}")
        # The first column names the case.
        label = next(iter(columns))
        if name == CAUSES and not choices.causes:
            continue
        if name in CHOSEN:
            compute = partial(compute, choices=choices)
        parts = []
        for case in cases:
            try:
                part = compute(case)
            except UnanswerableError as error:
                errors.append(error)
                remarks.append((name, f"{error.source}: {error.problem}."))
            else:
                parts.append(part.assign(**{label: case.name}))
                beginning = f"{case.name}: " if len(cases) > 1 else ""
                for note in _remarks(name, case, part, choices.alpha):
                    remarks.append((name, f"{beginning}{note}"))
        of_case = columns[label]._replace(is_shown=len(cases) > 1)
        rows = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()
        tables[name] = tabulate(
            title, {**columns, label: of_case}, rows, wide=wide, words=words
        )

    if errors and all(table.frame.empty for table in tables.values()):
        raise errors[0]
    sentences = list(chain.from_iterable(map(_verdict, cases)))
    of_all = []
    for case in cases:
        sentences += [REMARK(remark=remark) for remark in case.remarks]
        of_all += [
            *case.remarks,
            why_few_evaluations(case),
            describe_runs_without_solutions(case),
        ]
    on_all = product(["all"], filter(None, of_all))
    different = dict.fromkeys([*on_all, *remarks])
    tables["remarks"] = tabulate("Remarks", REMARKS, list(different))
    return Answer(
        question="tables",
        study=cases[0].study,
        verdict=Verdict(sentences),
        numbers={
            "cases": len(cases),
            "solutions": sum(len(case.solutions) for case in cases),
            "alpha": choices.alpha,
        },
        tables=tables,
        draw=lambda answer: next(iter(draw_figures(cases).values())),
    )


def _verdict(case: Results) -> Sentences:
    """Say how many solutions of a case collide, and how many solutions of NSGA-II are critical
    (less safe than the original vehicle).
    """
    if case.why_no_solution:
        yield NO_SOLUTION(
            name=case.name,
            reason=case.why_no_solution,
        )
        return

    solutions = case.different_solutions
    yield COLLISIONS(
        count=are_collisions(solutions).sum(), total=len(solutions), name=case.name
    )
    try:
        critical = len(changes.critical_solutions(case))
    except UnanswerableError:
        return
    less_safe = LESS_SAFE[bool(case.study.ranges)]
    yield less_safe(
        count=critical,
        total=len(case.solutions_of(NSGA2)),
        algorithm=case.title_of(NSGA2),
    )
    yield from map(note, demanded_in_words(case.study))


def _equal_solutions(case: Results) -> str:
    """A sentence that says how many solutions equal an earlier solution of the same run; "" if no
    solutions are equal. Tables of pooled solutions count all of them.
    """
    run = ["algorithm", "run"] if case.has_runs else ["algorithm"]
    count = case.solutions.duplicated([*run, *case.characteristics.names]).sum()
    if not count:
        return ""
    of_all = f"{count} of {number_of(len(case.solutions), 'solution')}"
    return (
        f"{of_all} equal an earlier solution of the same run. Equal solutions count here, as in the"
        " paper."
    )


def _remarks(
    table: str, case: Results, frame: pd.DataFrame, alpha: float
) -> Iterator[str]:
    """Yield the remarks on a table of a case: what the table leaves out, and how it was tested."""
    remarks = list[str]()
    if table in AS_PUBLISHED:
        remarks += _on_pooled_tests(table, case, frame, alpha)
    if table in POOLED:
        remarks.append(_equal_solutions(case))
    if table in ("rq1-runs", "rq2-runs", "rq2-common"):
        remarks += remarks_on_runs(table, frame, alpha)
    if table == "rq2-runs":
        remarks.append(describe_rules(case))
    if table in ON_REQUEST:
        remarks.append(f"Unsafe means: {case.unsafe.description}.")
    if table == "a12" and len(frame):
        remarks.append(
            "An asterisk means that the p-value is significant after Holm's correction for the"
            f" {number_of(len(frame), 'test')} of RQ2."
        )
    if table == "combinations" and frame.empty:
        remarks.append("No critical solution changes exactly four characteristics.")
    for remark in filter(None, remarks):
        yield remark[0].upper() + remark[1:]


def _on_pooled_tests(
    table: str, case: Results, frame: pd.DataFrame, alpha: float
) -> Iterator[str]:
    """Yield remarks on the tests of pooled solutions: algorithms with too few runs, metrics that
    are undefined in some solutions, and the numbers of simulations.
    """
    tested = "algorithm" if table == "rq1" else "baseline"
    with_few_runs = frame.loc[~frame["enough_runs"], tested].unique()
    if len(with_few_runs):
        names = ", ".join(map(case.title_of, with_few_runs))
        least_number = fewest_runs(table.upper(), alpha)
        yield (
            f"No p-value of pooled solutions is significant for {names}: a test needs at least"
            f" {least_number} runs of each algorithm."
        )
    for metric in case.scoring.metrics:
        values = solutions_for_metric(case.solutions, metric)[metric.name]
        undefined = values.isna().sum()
        if undefined:
            yield (
                f"{metric.name} is undefined in {undefined} of {len(values)} solutions. The tests"
                " leave these out."
            )
    if table == "rq1":
        values = pd.Series(case.original_metrics, dtype=float)
        # If encounters are ranges, only the original's safety degree is known in the encounters of
        # the solutions.
        if case.study.ranges:
            values = values.where(values.index == SAFETY_DEGREE)
        omitted = list(values.index[values.isna()])
        if omitted:
            yield (
                f"No test uses {join_phrases(omitted)}, because the original vehicle has no such"
                " value."
            )
    elif not case.has_runs:
        yield (
            "igd, igd_plus and hypervolume are missing, because they need runs, and imported"
            " solutions belong to none. The number of their simulations is unknown, too."
        )
    elif len(case.evaluations):
        yield (
            "Number of vehicles that a run simulates on average:"
            f" {describe_evaluations(case, count_evaluations(case))}."
        )


def remarks_on_runs(
    table: str, frame: pd.DataFrame, alpha: float = ALPHA
) -> Iterator[str]:
    """Yield remarks on tests over runs: how many tests have too few runs, and how the p-values are
    corrected.
    """
    rq = table.partition("-")[0].upper()
    tests = frame.dropna(subset="effect_size")
    number = len(tests)
    tests_in_words = number_of(number, "test")
    few = number - tests["enough_runs"].sum()
    if few:
        least_number = fewest_runs(rq, alpha, number)
        beginning = f"{few} of {tests_in_words} of {rq} cannot"
        if few == number > 1:
            beginning = f"None of the {tests_in_words} of {rq} can"
        yield (
            f"{beginning} be significant: after Holm's correction, a test"
            f" needs at least {least_number} runs of each algorithm."
        )
    if number:
        yield f"Holm's method corrects the p-values of the {tests_in_words} of {rq} together."
