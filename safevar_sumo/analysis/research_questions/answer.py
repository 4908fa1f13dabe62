"""Answers to the research questions, by name and over several cases: tidy frames, and notes on missing data.

In the frames, the columns `setting` and `other` hold the names of cases.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import pandas as pd

from safevar_sumo.analysis.research_questions.algorithms import compare_pairs, rank_algorithms
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES, NSGA2, Case, UnanswerableError, solutions_for_metric
from safevar_sumo.analysis.research_questions.changes import (
    compare_weathers,
    count_collisions,
    critical_solutions,
    find_weather_pairs,
    frequent_combinations,
    rq31,
    rq32,
    rq33,
    rq33_safety,
)
from safevar_sumo.analysis.research_questions.comparisons import rq1, rq2
from safevar_sumo.analysis.research_questions.over_runs import algorithms_with_few_runs, fewest_runs, notes_over_runs, rq1_runs, rq2_runs
from safevar_sumo.errors import unknown_name
from safevar_sumo.metrics import PUBLISHED_SCORING, MetricFacts

Frames = dict[str, pd.DataFrame]
SAFETY_TABLE = "rq3.3-safety"
"""Name of the table of effects on safety, the footer of the paper's table of RQ3.3. The question rq3.3 is answered by both tables."""

FRAMES_OF_ONE_CASE: Mapping[str, Callable[[Case], Frames]] = {
    "rq1": lambda case: {"rq1": rq1(case)},
    "rq2": lambda case: {"rq2": rq2(case)},
    "rq1-runs": lambda case: {"rq1-runs": rq1_runs(case)},
    "rq2-runs": lambda case: {"rq2-runs": rq2_runs(case)},
    "rq2-pairs": lambda case: {"rq2-pairs": compare_pairs(case)},
    "rq2-ranks": lambda case: {"rq2-ranks": rank_algorithms(case)},
    "rq3.1": lambda case: {"rq3.1": rq31(case)},
    "rq3.2": lambda case: {"rq3.2": rq32(case)},
    "rq3.3": lambda case: {"rq3.3": rq33(case), SAFETY_TABLE: rq33_safety(case)},
    "collisions": lambda case: {"collisions": count_collisions(case)},
    "combinations": lambda case: {"combinations": frequent_combinations(case)},
}
WEATHER = "weather"
POOLED_QUESTIONS = ("rq1", "rq2")
"""The questions whose tests pool the solutions of all runs."""
QUESTIONS = (*FRAMES_OF_ONE_CASE, SAFETY_TABLE, WEATHER)


class Answer(NamedTuple):
    """The answer to a question: a tidy frame over all cases (empty if no case has an answer), notes on the frame, and the metrics.

    `untested` are the pairs of case and algorithm whose runs are too few for a test: none of their p-values counts as significant.
    """

    name: str
    frame: pd.DataFrame
    notes: tuple[str, ...]
    metrics: tuple[MetricFacts, ...] = PUBLISHED_SCORING.metrics
    untested: frozenset[tuple[str, str]] = frozenset()


def answer_questions(cases: Sequence[Case], question: str | None = None) -> list[Answer]:
    """Answer one question, or all questions.

    Raises
    ------
    InputError
        If there is no such question, or no case has an answer.
    """
    if question is not None and question not in QUESTIONS:
        raise unknown_name("question", f"there is no question {question!r}", question, QUESTIONS)
    answers, all_errors, case_names = [], [], {case.name for case in cases}
    metrics = tuple({metric.name: metric for case in cases for metric in case.scoring.metrics}.values())
    all_questions = (*FRAMES_OF_ONE_CASE, WEATHER)
    for name in all_questions if question is None else ("rq3.3" if question == SAFETY_TABLE else question,):
        tables, errors = _collect_frames(name, cases)
        all_errors += errors
        notes = [f"{error.source}: {error.problem}." for error in errors]
        if not tables:
            answers.append(Answer(name, pd.DataFrame(), tuple(notes)))
        for table, frames in tables.items():
            frame = pd.concat(frames, ignore_index=True)
            answered_names = {*frame["setting"], *frame["other"]} if name == WEATHER else case_names - {error.source for error in errors}
            case_notes = [note for case in cases if case.name in answered_names
                          for note in _notes(table, case, alone=question is not None)]
            untested = frozenset((case.name, algorithm) for case in cases for algorithm in algorithms_with_few_runs(case, table.upper())
                                 ) if table in POOLED_QUESTIONS else frozenset()
            answers.append(Answer(table, frame, tuple(dict.fromkeys([*notes, *case_notes])), metrics, untested))
    if all_errors and all(answer.frame.empty for answer in answers):
        raise all_errors[0]
    return [answer for answer in answers if answer.name == SAFETY_TABLE] if question == SAFETY_TABLE else answers


def _collect_frames(name: str, cases: Sequence[Case]) -> tuple[dict[str, list[pd.DataFrame]], list[UnanswerableError]]:
    """The frames of a question by table, and an error for each case without a frame."""
    tables: dict[str, list[pd.DataFrame]] = {}
    errors = []
    case_groups = [cases] if name == WEATHER else [[case] for case in cases]  # weathers are compared over all cases at once
    for group in case_groups:
        try:
            if name == WEATHER:
                frames = {WEATHER: pd.concat([compare_weathers(*pair) for pair in find_weather_pairs(group)])}
            else:
                frames = FRAMES_OF_ONE_CASE[name](*group)
            for table, frame in frames.items():
                tables.setdefault(table, []).append(frame)
        except UnanswerableError as error:
            errors.append(error)
    return tables, errors


def _notes(question: str, case: Case, *, alone: bool) -> list[str]:
    """Notes on a case for the readers of a table; `alone` if it is the only question asked."""
    notes = list(case.remarks)
    if question in POOLED_QUESTIONS:
        if few := [ALGORITHM_TITLES.get(name, name) for name in algorithms_with_few_runs(case, question.upper())]:
            notes.append(f"{case.name}: too few runs of {', '.join(few)} for a test ({fewest_runs(question.upper())} are needed): "
                         "no p-value of pooled solutions stands out.")
        for metric in case.scoring.metrics:
            rows = solutions_for_metric(case.solutions, metric)
            undefined_values = int(rows[metric.name].isna().sum())
            if undefined_values:
                notes.append(f"{case.name}: {metric.name} is undefined in {undefined_values} of {len(rows)} solutions, which the "
                             "tests omit.")
    if question == "rq1":
        undefined_metrics = [name for name, value in case.original.items() if pd.isna(value)]
        if undefined_metrics:
            notes.append(f"{case.name}: the original vehicle's {', '.join(undefined_metrics)} is undefined, so that no test uses it.")
    if question in ("rq1-runs", "rq2-runs"):
        over_runs = notes_over_runs(case, question[:3].upper(), pooling=alone or question == "rq1-runs")
        notes += [f"{case.name}: {note}" for note in over_runs]
    if question == "rq2" and not case.has_runs:
        notes.append(f"{case.name}: igd, igd_plus and hypervolume need runs, which imported solutions do not have.")
    if question == "rq2" and case.has_runs:
        empty_runs = len(set(case.finished_runs) - set(zip(case.solutions["algorithm"], case.solutions["run"], strict=True)))
        if empty_runs:
            notes.append(f"{case.name}: {empty_runs} finished runs found no solution; they have no igd, igd_plus or hypervolume.")
    if question.startswith("rq3") or question in ("combinations", WEATHER):
        notes.append(f"{case.name}: {len(critical_solutions(case))} of {ALGORITHM_TITLES[NSGA2]}'s {len(case.solutions_of(NSGA2))} "
                     "solutions are critical.")
    if question == "rq3.3":
        units = [f"{characteristic.name} {characteristic.unit}" for characteristic in case.characteristics if characteristic.unit != "-"]
        notes.append(f"Units of delta: {', '.join(units)}.")
    if question == "combinations" and frequent_combinations(case).empty:
        notes.append(f"{case.name}: no critical solution has exactly four characteristics changed.")
    return notes
