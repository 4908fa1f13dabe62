"""Answers to the research questions, by name and over several cases: tidy frames, and notes on missing data.

In the frames, the columns `setting` and `other` hold the names of cases.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import pandas as pd

from safevar_sumo.analysis.case import ALGORITHM_TITLES, NSGA2, Case, UnanswerableError, solutions_for_metric
from safevar_sumo.analysis.research_questions import changes, comparisons
from safevar_sumo.analysis.research_questions.statistics import fewest_runs
from safevar_sumo.errors import unknown_name

SAFETY_TABLE = "rq3.3-safety"
"""Name of the table of effects on safety, the footer of the paper's table of RQ3.3.

The question rq3.3 is answered by both tables.
"""
WEATHER = "weather"
FRAMES: Mapping[str, Callable[..., pd.DataFrame]] = {
    "rq1": comparisons.rq1,
    "rq2": comparisons.rq2,
    "rq1-runs": comparisons.rq1_runs,
    "rq2-runs": comparisons.rq2_runs,
    "rq2-pairs": comparisons.compare_pairs,
    "rq2-ranks": comparisons.rank_algorithms,
    "rq3.1": changes.rq31,
    "rq3.2": changes.rq32,
    "rq3.3": changes.rq33,
    SAFETY_TABLE: changes.rq33_safety,
    "collisions": changes.count_collisions,
    "combinations": changes.frequent_combinations,
    WEATHER: changes.compare_weathers,
}
"""Functions that answer a question from one case, and about the weather from all."""
QUESTIONS = tuple(FRAMES)


class Answer(NamedTuple):
    """The answer to a question: a tidy frame over all cases (empty if no case has an answer), notes on the frame, and
    the cases.
    """

    name: str
    frame: pd.DataFrame
    notes: tuple[str, ...]
    cases: Sequence[Case] = ()


def answer_questions(cases: Sequence[Case], question: str | None = None) -> list[Answer]:
    """Answer one question, or all questions.

    Raises
    ------
    InputError
        If there is no such question, or no case has an answer.
    """
    if question is not None and question not in QUESTIONS:
        raise unknown_name("question", f"there is no question {question!r}", question, QUESTIONS)
    answers, all_errors = list[Answer](), list[UnanswerableError]()
    for name in QUESTIONS if question is None else ("rq3.3", SAFETY_TABLE) if question == "rq3.3" else (question,):
        frames, notes, case_notes = list[pd.DataFrame](), list[str](), list[str]()
        for group in [cases] if name == WEATHER else [[case] for case in cases]:
            try:
                frame = FRAMES[name](*group)
            except UnanswerableError as error:
                all_errors.append(error)
                notes.append(f"{error.source}: {error.problem}.")
            else:
                frames.append(frame)
                compared = {*frame["setting"], *frame["other"]} if name == WEATHER else {case.name for case in group}
                case_notes += [note for case in group if case.name in compared for note in _notes(name, case)]
        table = pd.concat(frames, ignore_index=True) if frames else pd.DataFrame()
        answers.append(Answer(name, table, tuple(dict.fromkeys([*notes, *case_notes])), cases))
    if all_errors and all(answer.frame.empty for answer in answers):
        raise all_errors[0]
    return answers


def algorithms_with_few_runs(case: Case, question: str) -> list[str]:
    """RQ1's algorithms or RQ2's baselines with too few runs for a significant test; none if the runs are unknown
    (imported).
    """
    runs = Counter(algorithm for algorithm, _ in case.finished_runs)
    most = runs.pop(NSGA2, 0) if question == "RQ2" else math.inf
    known = case.algorithms if case.has_runs else ()
    return [name for name in known if name in runs and min(runs[name], most) < fewest_runs(question)]


def _notes(question: str, case: Case) -> Iterator[str]:
    """Notes on a case for the readers of a table."""
    yield from case.remarks
    name, rq = f"{case.name}: ", question.split("-")[0].upper()
    if question in ("rq1", "rq2"):
        if few := [ALGORITHM_TITLES.get(algorithm, algorithm) for algorithm in algorithms_with_few_runs(case, rq)]:
            yield (
                f"{name}too few runs of {', '.join(few)} for a test ({fewest_runs(rq)} are needed): "
                "no p-value of pooled solutions stands out."
            )
        for metric in case.scoring.metrics:
            values = solutions_for_metric(case.solutions, metric)[metric.name]
            if undefined := int(values.isna().sum()):
                share = f"{undefined} of {len(values)} solutions"
                yield f"{name}{metric.name} is undefined in {share}, which the tests omit."
        undefined_names = ", ".join(metric for metric, value in case.original.items() if math.isnan(value))
        if question == "rq1" and undefined_names:
            yield f"{name}the original vehicle's {undefined_names} is undefined, so that no test uses it."
        if question == "rq2" and not case.has_runs:
            yield f"{name}igd, igd_plus and hypervolume need runs, which imported solutions do not have."
    if question in ("rq1-runs", "rq2-runs"):
        tests = comparisons.compare_over_runs(case).dropna(subset="effect_size")
        tests = tests[tests.index == rq]
        if few_count := len(tests) - tests["enough"].sum():
            how_many = "all" if few_count == len(tests) else f"{few_count} of the"
            yield f"{name}too few runs for {how_many} {len(tests)} tests of {rq} ({fewest_runs(rq)} are needed)."
    if question.startswith("rq3") or question in ("combinations", WEATHER):
        counts = len(changes.critical_solutions(case)), len(case.solutions_of(NSGA2))
        yield f"{name}{counts[0]} of {ALGORITHM_TITLES[NSGA2]}'s {counts[1]} solutions are critical."
    if question == "combinations" and changes.frequent_combinations(case).empty:
        yield f"{name}no critical solution has exactly four characteristics changed."
    if question == "rq3.3":
        units = (f"{item.name} {item.unit}" for item in case.characteristics if item.unit != "-")
        yield f"Units of delta: {', '.join(units)}."
