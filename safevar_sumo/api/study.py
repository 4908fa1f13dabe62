"""The command `study`: runs a search for unsafe vehicles, and summarises the search."""

from __future__ import annotations

import re
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

from msgspec.structs import replace as replace_in

from safevar_sumo.api import words
from safevar_sumo.api.running import load_for_search, run
from safevar_sumo.errors import InputError, hint, warn
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer, Column, contents, tabulate
from safevar_sumo.questions.ask import Criterion
from safevar_sumo.questions.by_criterion import cases_by, study_by
from safevar_sumo.questions.case import Results, UnanswerableError, are_collisions
from safevar_sumo.questions.counterexamples import fewest_changes
from safevar_sumo.questions.options import Jobs, PointName, Range, UpTo
from safevar_sumo.questions.part import part_of_study
from safevar_sumo.questions.research_questions.answer import (
    REMARKS,
    answer_questions,
    remarks_on_runs,
)
from safevar_sumo.questions.research_questions.comparisons import titles_of
from safevar_sumo.questions.research_questions.tables import TABLES
from safevar_sumo.questions.sentence import Sentence, Verdict
from safevar_sumo.questions.subject import load
from safevar_sumo.questions.tables import shipped_columns
from safevar_sumo.questions.words import (
    ALREADY_UNSAFE,
    EXACT,
    change_texts,
    count_in_words,
    demanded_in_words,
    encounter_in_words,
    notes_on,
    number_of,
    replay_command,
)
from safevar_sumo.records import JsonObject, Outcome
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.study import ORIGINAL_DEGREE, SAFETY_DEGREE, Study
from safevar_sumo.sumo import assemble, drive_and_score, vehicle_remarks
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.system import System
from safevar_sumo.sumo.without_effect import without_effect
from safevar_sumo.terminal import Parts, Progress, open_progress, show_no_progress

INTERRUPTED = (
    "finished evaluations are kept in {}: run the same command again to continue"
)
VERDICT_COST = 80_000
"""The verdict on a search takes about as long as this number of simulations. (The bar of progress
adds this number to the simulations of the search.)
"""
VERDICT_SIMULATIONS = 60
"""Number of simulations that the verdict takes in a simulator of the user's own, roughly."""
ALGORITHMS = shipped_columns("study")["algorithms"]
"""The columns of the table with a row for each search algorithm."""
CHANGES = shipped_columns("study")["fewest"]
"""The columns of the table with the changes of the vehicle with the fewest changes."""
MAX_LISTED = 3
"""Largest number of changes that the verdict lists; the table lists all changes."""
RUN_TESTS = ("rq1-runs", "rq2-runs")
"""The tables with statistical tests over runs."""


@contents(
    *(
        "results",
        "finished",
        "runs",
        "evaluations",
        "solutions",
        "original_outcome",
        "original_degree",
    ),
    algorithms=[*ALGORITHMS, ...],
    fewest=CHANGES,
    **{name: TABLES[name].columns for name in RUN_TESTS},
    remarks=REMARKS,
)
def study(
    study: str,
    *,
    runs: Annotated[int | None, Range(1, 100_000)] = None,
    evaluations: Annotated[int | None, Range(1, 10_000_000)] = None,
    algorithms: Annotated[str | None, "NAME,..."] = None,
    seed: Annotated[int | None, Range(0, 2**63 - 1)] = None,
    ranges: bool = False,
    point: PointName = None,
    up_to: UpTo = None,
    unsafe: Criterion = None,
    engine: Literal["recorded", "sumo"] = "recorded",
    out: Path | None = None,
    jobs: Jobs = None,
    cluster: Annotated[str | None, "ADDRESS"] = None,
    retry_failed: bool = False,
    quiet: bool = False,
    status: bool = False,
) -> Answer:
    """Search for unsafe vehicles with few and small changes. You get a directory with every vehicle
    that the search algorithms return, and the fewest changes that make the vehicle unsafe. The same
    command continues a search that was interrupted.

    Example: python -m safevar_sumo study rain

    Parameters
    ----------
    runs
        Number of runs of each search algorithm. Default: the number in the study.
    evaluations
        Largest number of simulated vehicles in each run. Default: the number in the study.
    algorithms
        Search algorithms, separated by commas, such as nsga2,rs. Default: the algorithms in the
        study.
    seed
        Seed of all random numbers of the study. Default: the seed in the study.
    ranges
        Let the search also choose the encounter, within the ranges of the study. Default: the
        study's test cases.
    point
        Use only this test or test case of the study, such as CPNA. Default: all tests.
    up_to
        Use only encounters in which this value is not exceeded, such as speed=40. The unit is that
        of the study.
    unsafe
        Criterion for an unsafe vehicle in the answer, such as collision or "drac > 6". This
        criterion does not change the search.
    engine
        What moves the vehicles: recorded (fast, in a scene that SUMO played once) or sumo (SUMO in
        every simulation).
    out
        Directory for the results. Default: results/STUDY.
    jobs
        Number of worker processes. Default: one for each processor core.
    cluster
        Simulate on the workers of this Dask scheduler, such as tcp://host:8786. Default: on this
        machine.
    retry_failed
        Simulate vehicles again that could not be simulated before. Default: no further attempt.
    quiet
        Print only errors, warnings, and an output that you ask for, such as JSON. Default: print
        the answer and the progress as well.
    status
        Print how far the search in the directory is, and simulate nothing.
    """
    as_written = part_of_study(read_study(study), ranges, point, up_to)
    directory = out or Path("results") / directory_name(as_written)
    if unsafe is not None and status:
        raise InputError(
            "unsafe",
            "beside --status, which simulates no search",
            "one of the two options",
        )
    if status:
        return summarise(load(directory))

    changed = _with_options(
        as_written, algorithms, runs=runs, evaluations=evaluations, seed=seed
    )
    loaded, system = load_for_search(changed)
    # A criterion that the study cannot have is refused now: the search may take hours.
    if unsafe is not None:
        study_by(loaded, unsafe)
    for remark in dict.fromkeys(without_effect(system)):
        warn(remark)
    if system.mover.takes_long and not quiet:
        command = f"{PROGRAM_COMMAND} explain {loaded.words}"
        hint(
            f"{command} --simulations N looks for the smallest changes with N simulations alone"
        )

    try:
        with open_progress(not quiet) as show:
            parts = Parts(
                show,
                [0, VERDICT_SIMULATIONS if system.mover.takes_long else VERDICT_COST],
            )
            results = run(
                loaded,
                directory,
                progress=parts.begin(),
                retry_failed=retry_failed,
                jobs=jobs,
                cluster=cluster,
                engine=engine,
            )
            _refuse_undefined(results)
            return _found(results, system, unsafe, jobs, parts.begin(), loaded.words)
    except KeyboardInterrupt:
        warn(INTERRUPTED.format(directory))
        raise


def _refuse_undefined(results: Results) -> None:
    """Refuse an objective that no simulated vehicle has: the search then has no solutions."""
    simulated = results.evaluations
    for objective in results.scoring.objectives:
        if len(simulated) and simulated[objective.name].isna().all():
            raise InputError(
                results.study.source,
                f"search.objectives: {objective.name} is undefined in all"
                f" {len(simulated):,} simulated vehicles",
                "objectives that have a value in some run: `check` says more",
            )


def _found(
    results: Results,
    system: System,
    unsafe: Unsafe | None,
    jobs: int | None,
    progress: Progress,
    study: str,
) -> Answer:
    """The answer after a search: a summary, the verdict, and the advice what to ask next."""
    progress("the fewest unsafe changes", 0, 1)
    answer = summarise(results)
    reason = why_no_verdict(system)
    (case,) = cases_by([results], unsafe, jobs, show_no_progress)
    criterion = "" if unsafe is None else f" --unsafe {quote(str(unsafe))}"
    advice = f"{PROGRAM_COMMAND} explain {study}{criterion}"

    # Questions refuse studies whose original vehicle is unsafe in the original encounter.
    demanded = results.scoring.safe_original
    if demanded is not None and results.original[ORIGINAL_DEGREE] < demanded:
        advice = (
            "a smaller scenario.margin, or original values of the axes with which the"
            " original vehicle is safe, as questions demand"
        )
    changes: list[JsonObject] = []
    if system.meets_nobody and not (unsafe or results.study.unsafe.criterion):
        advice = ""
    breach = _breach_of_original(case)
    if breach:
        sentences = [ALREADY_UNSAFE(breach=breach)]
        advice = ""
    else:
        sentences, changes = _verdict(results, case, jobs, study)
    tables = answer.tables.records
    if changes:
        fewest = tabulate(
            "The smallest number of changes that the search found to be unsafe",
            CHANGES,
            changes,
        )
        tables = {"algorithms": tables["algorithms"], "fewest": fewest, **tables}
    return replace(
        answer,
        verdict=reason or Verdict(sentences),
        next=advice,
        numbers={
            "driven": not reason,
            "never_moved": number_standing(results),
            **answer.numbers,
        },
        tables=tables,
    )


def directory_name(study: Study) -> str:
    """The name of a directory for results: the name of the study, and of the part that is
    searched.
    """
    origin = study.origin
    ranges = "ranges" if origin.ranges else ""
    parts = (study.name, ranges, origin.point, origin.up_to)
    name = "-".join(part for part in parts if part)
    return re.sub(r"[^A-Za-z0-9_.=-]+", "_", name)


def _with_options(study: Study, algorithms: str | None, **numbers: int | None) -> Study:
    """The study with the options of the command that change its search."""
    search = study.search
    changes: JsonObject = {
        name: value for name, value in numbers.items() if value is not None
    }
    if algorithms is not None:
        names = (name.strip() for name in algorithms.split(","))
        changes["algorithms"] = [search.labels.get(name, name) for name in names]
    return replace_in(study, search=replace_in(search, **changes))


def number_standing(results: Results) -> int:
    """The number of different vehicles that never moved in the search; 0 if the original vehicle
    never moves, either.
    """
    if results.original["outcome"] == Outcome.NEVER_MOVED:
        return 0
    simulated = results.evaluations
    standing = simulated[simulated["outcome"] == Outcome.NEVER_MOVED]
    names = list(results.characteristics.names)
    return len(standing.drop_duplicates(names))


def _breach_of_original(case: Results) -> str:
    """How the original vehicle is unsafe, in words. "" if the original vehicle is safe, or if the
    study searches encounters.
    """
    if case.characteristics.scenario:
        return ""
    original = drive_and_score(
        assemble(case.study), case.characteristics.original_settings
    )
    if not case.unsafe.of(original)[0]:
        return ""
    return case.unsafe.breach_in_words(original)


def _verdict(
    results: Results, case: Results, jobs: int | None, study: str
) -> tuple[list[Sentence], list[JsonObject]]:
    """The verdict on a case: how many solutions are unsafe, and how few changes suffice. The rows
    of `CHANGES` list the changes of the vehicle with the fewest changes.
    """
    members = case.characteristics
    unsafe = case.unsafe
    solutions = case.different_solutions
    if solutions.empty:
        return [words.NOTHING_RETURNED(reason=case.why_no_solution)], []
    number = int(unsafe.rows(solutions).sum())
    total = len(solutions)
    template = words.UNSAFE if number else words.NOTHING_UNSAFE
    sentences = [
        template(
            unsafe=unsafe,
            total=total,
            count=count_in_words(number, total),
            collide=unsafe.verbs[number > 1],
        ),
        *notes_on(unsafe, *demanded_in_words(results.study)),
    ]
    if len(case.failures):
        vehicles = number_of(len(case.failures), "vehicle")
        sentences.append(words.NOT_SIMULATED(failed=vehicles))
    standing = number_standing(results)
    if standing:
        vehicles = number_of(standing, "simulated vehicle")
        sentences.append(words.NEVER_MOVED(vehicles=vehicles))
    fewest = fewest_changes(case, jobs)
    if fewest is None:
        return sentences, []

    values = members.named(fewest.settings[0])
    texts = change_texts(members.vehicle, values, are_printed=True)
    count = len(texts)
    template = words.FEW_CHANGES if count <= MAX_LISTED else words.MANY_CHANGES
    if not count:
        template = words.ORIGINAL_UNSAFE
    command = replay_command(str(results.directory))
    rows: list[JsonObject] = []
    for item in members:
        value = values[item.name]
        if value != item.original:
            rows.append(
                {
                    "characteristic": item.name,
                    "unit": item.unit,
                    "original": item.original,
                    "value": value,
                }
            )
            command += f" --set {item.name}={value:{EXACT}}"
    sentences += [
        template(
            unsafe=unsafe,
            count=number_of(count, "change"),
            changes=", ".join(texts),
            breach=unsafe.breach_in_words(fewest),
            where=encounter_in_words(members, values, are_printed=True),
        ),
        words.NO_PROOF(study=study),
        words.COMMAND(command=command),
    ]
    return sentences, rows


def summarise(results: Results) -> Answer:
    """Summarise a study, even before it is finished: a row for each algorithm, and the answers to
    RQ1 and RQ2 if the runs suffice.

    Raises
    ------
    InputError
        If the results are imported.
    """
    study = results.study
    if not results.has_runs:
        raise InputError(
            results.directory or results.name,
            "holds imported solutions, which have no runs",
            "results of the command `study`",
        )

    metrics = {
        metric.name: Column(metric.unit, "mean over solutions", ".2f", is_detail=True)
        for metric in results.scoring.metrics
    }
    all_simulated = results.evaluations
    all_solutions = results.solutions
    finished = results.run_counts
    rows = []
    for name in study.search.labels:
        simulated = all_simulated[all_simulated["algorithm"] == name]
        solutions = all_solutions[all_solutions["algorithm"] == name]
        outcomes = Counter(simulated["outcome"])
        feasible = simulated[results.scoring.feasible_rows(simulated)]
        rows.append(
            {
                "algorithm": name,
                "finished": finished[name],
                "runs": study.search.runs,
                "simulated": len(simulated),
                "collisions": int(are_collisions(feasible).sum()),
                "invalid_tests": outcomes[Outcome.INVALID_TEST],
                "simulator_errors": outcomes[Outcome.SIMULATOR_ERROR],
                "best": feasible["f_safe"].min(),
                "solutions": len(solutions),
                **solutions[list(metrics)].mean(),
            }
        )

    table = tabulate(
        study.title, ALGORITHMS | metrics, rows, words=titles_of([results])
    )
    tables = {"algorithms": table}

    # If no test can be significant with so few runs, its table is folded, with a remark.
    untested = []
    with suppress(UnanswerableError):
        run_tables = answer_questions([results], names=RUN_TESTS).tables
        tables |= run_tables.records
        untested = [
            name for name in RUN_TESTS if not run_tables[name]["enough_runs"].any()
        ]
        # The first remark of such a table says how many runs are needed.
        remark = " ".join(
            next(remarks_on_runs(name, run_tables[name]), "") for name in untested
        )
        if remark:
            remarks = run_tables["remarks"]
            remarks.loc[len(remarks)] = ["all", remark]
    runs = study.search.runs * len(rows)
    return Answer(
        question="study",
        study=study,
        verdict=Verdict(
            [
                words.PROGRESS(
                    finished=len(results.finished),
                    runs=number_of(runs, "run"),
                    directory=results.directory,
                )
            ]
        ),
        numbers={
            "results": str(results.directory),
            "finished": len(results.finished),
            "runs": runs,
            "evaluations": len(results.evaluations),
            "solutions": len(results.solutions),
            "original_outcome": results.original["outcome"],
            "original_degree": results.original[SAFETY_DEGREE],
        },
        tables=tables,
        folded=tuple(untested),
        tested=" ".join(vehicle_remarks(assemble(study))),
    )
