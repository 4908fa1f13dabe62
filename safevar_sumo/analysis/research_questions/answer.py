"""Answers to the research questions, by name and over several cases: tidy frames, and notes on missing data.

In the frames, the columns `setting` and `other` hold the names of cases.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import pandas as pd

from safevar_sumo.analysis.research_questions.case import (
    ALGORITHM_TITLES,
    NSGA2,
    Case,
    UnanswerableError,
    solutions_for_metric,
)
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
from safevar_sumo.analysis.research_questions.comparisons import (
    compare_pairs,
    rank_algorithms,
    rq1,
    rq1_runs,
    rq2,
    rq2_runs,
)
from safevar_sumo.analysis.research_questions.over_runs import notes_over_runs
from safevar_sumo.analysis.research_questions.statistics import fewest_runs
from safevar_sumo.errors import unknown_name
from safevar_sumo.metrics import PUBLISHED_SCORING, MetricFacts

SAFETY_TABLE = "rq3.3-safety"
"""Name of the table of effects on safety, the footer of the paper's table of RQ3.3.

The question rq3.3 is answered by both tables.
"""
WEATHER = "weather"
FRAMES_OF_ONE_CASE: Mapping[str, Callable[[Case], pd.DataFrame]] = {
    "rq1": rq1,
    "rq2": rq2,
    "rq1-runs": rq1_runs,
    "rq2-runs": rq2_runs,
    "rq2-pairs": compare_pairs,
    "rq2-ranks": rank_algorithms,
    "rq3.1": rq31,
    "rq3.2": rq32,
    "rq3.3": rq33,
    SAFETY_TABLE: rq33_safety,
    "collisions": count_collisions,
    "combinations": frequent_combinations,
}
POOLED_QUESTIONS = ("rq1", "rq2")
"""The questions whose tests pool the solutions of all runs."""
QUESTIONS = (*FRAMES_OF_ONE_CASE, WEATHER)


class Answer(NamedTuple):
    """The answer to a question: a tidy frame over all cases (empty if no case has an answer), notes on the frame, and
    the metrics.

    `untested` are the pairs of case and algorithm whose runs are too few for a test: none of their p-values counts as
    significant.
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
    metrics = tuple({metric.name: metric for case in cases for metric in case.scoring.metrics}.values())
    answers, all_errors = list[Answer](), list[UnanswerableError]()
    for name in QUESTIONS if question is None else ("rq3.3", SAFETY_TABLE) if question == "rq3.3" else (question,):
        frames, notes, answered = list[pd.DataFrame](), list[str](), list[Case]()
        for group in [cases] if name == WEATHER else [[case] for case in cases]:
            try:
                if name == WEATHER:
                    pairs = find_weather_pairs(group)
                    frames += [compare_weathers(*pair) for pair in pairs]
                    answered += [case for case in group if any(case is one for pair in pairs for one in pair)]
                else:
                    frames.append(FRAMES_OF_ONE_CASE[name](*group))
                    answered += group
            except UnanswerableError as error:
                all_errors.append(error)
                notes.append(f"{error.source}: {error.problem}.")
        frame = pd.concat(frames, ignore_index=True) if frames else pd.DataFrame()
        notes += [note for case in answered for note in _notes(name, case, alone=question is not None)]
        untested = frozenset(
            (case.name, algorithm)
            for case in cases
            if name in POOLED_QUESTIONS
            for algorithm in algorithms_with_few_runs(case, name.upper())
        )
        answers.append(Answer(name, frame, tuple(dict.fromkeys(notes)), metrics, untested))
    if all_errors and all(answer.frame.empty for answer in answers):
        raise all_errors[0]
    return answers


def algorithms_with_few_runs(case: Case, question: str) -> list[str]:
    """RQ1's algorithms or RQ2's baselines with too few runs for a significant test; none if the runs are unknown
    (imported).
    """
    if not case.has_runs or (question == "RQ2" and NSGA2 not in case.algorithms):
        return []
    runs = {name: len(case.runs_of(name)) for name in case.algorithms}
    most = runs.pop(NSGA2) if question == "RQ2" else math.inf
    return [name for name, number in runs.items() if min(number, most) < fewest_runs(question)]


def _notes(question: str, case: Case, *, alone: bool) -> list[str]:
    """Notes on a case for the readers of a table; `alone` if it is the only question asked."""
    notes = []
    if question in POOLED_QUESTIONS:
        if few := [ALGORITHM_TITLES.get(name, name) for name in algorithms_with_few_runs(case, question.upper())]:
            notes.append(
                f"too few runs of {', '.join(few)} for a test ({fewest_runs(question.upper())} are needed): "
                "no p-value of pooled solutions stands out."
            )
        for metric in case.scoring.metrics:
            rows = solutions_for_metric(case.solutions, metric)
            if undefined_values := int(rows[metric.name].isna().sum()):
                notes.append(
                    f"{metric.name} is undefined in {undefined_values} of {len(rows)} solutions, which the tests omit."
                )
    undefined = ", ".join(name for name, value in case.original.items() if pd.isna(value))
    if question == "rq1" and undefined:
        notes.append(f"the original vehicle's {undefined} is undefined, so that no test uses it.")
    if question in ("rq1-runs", "rq2-runs"):
        notes += notes_over_runs(case, question[:3].upper(), pooling=alone or question == "rq1-runs")
    if question == "rq2" and not case.has_runs:
        notes.append("igd, igd_plus and hypervolume need runs, which imported solutions do not have.")
    elif question == "rq2":
        with_solutions = case.solutions.groupby(["algorithm", "run"]).groups
        if empty_runs := len({*case.finished_runs} - {*with_solutions}):
            notes.append(f"{empty_runs} finished runs found no solution; they have no igd, igd_plus or hypervolume.")
    if question.startswith("rq3") or question in ("combinations", WEATHER):
        notes.append(
            f"{len(critical_solutions(case))} of {ALGORITHM_TITLES[NSGA2]}'s {len(case.solutions_of(NSGA2))} "
            "solutions are critical."
        )
    if question == "combinations" and frequent_combinations(case).empty:
        notes.append("no critical solution has exactly four characteristics changed.")
    lines = [*case.remarks, *(f"{case.name}: {note}" for note in notes)]
    if question == "rq3.3":
        units = (f"{item.name} {item.unit}" for item in case.characteristics if item.unit != "-")
        lines.append(f"Units of delta: {', '.join(units)}.")
    return lines
