"""Answers to the research questions, by name and over several cases: tidy frames, and notes on missing data.

In the frames, the columns `setting` and `other` hold the names of cases.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import pandas as pd

from safevar_sumo.errors import unknown_name
from safevar_sumo.questions.case import NSGA2, Case, UnanswerableError, solutions_for_metric
from safevar_sumo.questions.research_questions import changes, comparisons
from safevar_sumo.questions.research_questions.fronts import count_evaluations
from safevar_sumo.questions.research_questions.statistics import FEWEST_RUNS

SAFETY_TABLE = "rq3.3-safety"
"""Name of the table of effects on safety, the footer of the paper's table of RQ3.3.

The question rq3.3 is answered by both tables.
"""
WEATHER, EVALUATIONS = "weather", "evaluations"
FRAMES: Mapping[str, Callable[..., pd.DataFrame]] = {
    "rq1": comparisons.rq1,
    "rq2": comparisons.rq2,
    "rq1-runs": comparisons.rq1_runs,
    "rq2-runs": comparisons.rq2_runs,
    EVALUATIONS: count_evaluations,
    "rq3.1": changes.rq31,
    "rq3.2": changes.rq32,
    "rq3.3": changes.rq33,
    SAFETY_TABLE: changes.rq33_safety,
    "collisions": changes.count_collisions,
    "combinations": changes.frequent_combinations,
    WEATHER: changes.compare_weathers,
}
"""Functions that answer a question from one case, and about the weather from all."""
QUESTION_NAMES = tuple(FRAMES)


class TableAnswer(NamedTuple):
    """The answer to the question `name`: a tidy frame over all cases, empty if no case has an answer, and its notes."""

    name: str
    frame: pd.DataFrame
    notes: tuple[str, ...]
    cases: Sequence[Case] = ()


def answer_questions(cases: Sequence[Case], question: str | None = None, algorithm: str = "") -> list[TableAnswer]:
    """Answer one question, or all questions; RQ2 compares `algorithm`, by default NSGA-II, with the others.

    Raises
    ------
    InputError
        If there is no such question, or no case has an answer.
    """
    if question is not None and question not in QUESTION_NAMES:
        raise unknown_name("question", f"there is no question {question!r}", question, QUESTION_NAMES)
    names = QUESTION_NAMES if question is None else (question,)
    if question == "rq3.3":
        names = (question, SAFETY_TABLE)
    answers, all_errors = [], []
    for name in names:
        frames, notes, case_notes = [], [], []
        for group in [cases] if name == WEATHER else [[case] for case in cases]:
            try:
                frame = FRAMES[name](*group, algorithm) if name in ("rq2", "rq2-runs") else FRAMES[name](*group)
            except UnanswerableError as error:
                all_errors.append(error)
                notes.append(f"{error.source}: {error.problem}.")
            else:
                frames.append(frame)
                compared = {*frame["setting"], *frame["other"]} if name == WEATHER else {case.name for case in group}
                case_notes += [note for case in group if case.name in compared for note in _notes(name, case, frame)]
        table = pd.concat(frames, ignore_index=True) if frames else pd.DataFrame()
        answers.append(TableAnswer(name, table, tuple(dict.fromkeys([*notes, *case_notes])), cases))
    if all_errors and all(answer.frame.empty for answer in answers):
        raise all_errors[0]
    return answers


def describe_evaluations(case: Case) -> str:
    """How many settings the algorithms' runs simulate, and why some simulate fewer than the budget."""
    texts = []
    for algorithm, rows in count_evaluations(case).groupby("algorithm", sort=False):
        requested, simulated, budget = rows[["requested", "simulated", "budget"]].mean().round()
        reasons = ["it stops by its own rule"] if requested < budget else []
        reasons += ["equal settings are simulated once"] if simulated < requested else []
        words = f" ({' and '.join(reasons)})" if reasons else ""
        texts.append(f"{case.title_of(str(algorithm))} {simulated:,.0f} of {budget:,.0f}{words}")
    return f"settings that a run simulates, mean: {'; '.join(texts)}."


def _notes(question: str, case: Case, frame: pd.DataFrame) -> Iterator[str]:
    """Notes on a case for the readers of its frame."""
    yield from case.remarks
    prefix, rq = f"{case.name}: ", question.split("-")[0].upper()
    if question in ("rq1", "rq2"):
        few = frame.loc[~frame["enough_runs"], "algorithm" if question == "rq1" else "baseline"].unique()
        if names := ", ".join(map(case.title_of, few)):
            yield (
                f"{prefix}too few runs of {names} for a test ({FEWEST_RUNS[rq]} are needed): "
                "no p-value of pooled solutions stands out."
            )
        for metric in case.scoring.metrics:
            values = solutions_for_metric(case.solutions, metric)[metric.name]
            if undefined := int(values.isna().sum()):
                share = f"{undefined} of {len(values)} solutions"
                yield f"{prefix}{metric.name} is undefined in {share}, which the tests omit."
        undefined_names = ", ".join(metric for metric, value in case.original.items() if math.isnan(value))
        if question == "rq1" and undefined_names:
            yield f"{prefix}the original vehicle's {undefined_names} is undefined, so that no test uses it."
        if question == "rq2" and not case.has_runs:
            yield (
                f"{prefix}igd, igd_plus and hypervolume need runs, which imported solutions do not have; nor is their "
                "number of evaluations known."
            )
        elif question == "rq2" and len(case.evaluations):
            yield prefix + describe_evaluations(case)
    if question in ("rq1-runs", "rq2-runs"):
        tests = frame.dropna(subset="effect_size")
        if few_count := len(tests) - tests["enough_runs"].sum():
            how_many = "all" if few_count == len(tests) else f"{few_count} of the"
            yield f"{prefix}too few runs for {how_many} {len(tests)} tests of {rq} ({FEWEST_RUNS[rq]} are needed)."
    if question.startswith("rq3") or question in ("combinations", WEATHER):
        critical_count, solution_count = len(changes.critical_solutions(case)), len(case.solutions_of(NSGA2))
        yield f"{prefix}{critical_count} of {case.title_of(NSGA2)}'s {solution_count} solutions are critical."
    if question == "combinations" and frame.empty:
        yield f"{prefix}no critical solution has exactly four characteristics changed."
    if question == "rq3.3":
        units = (f"{item.name} {item.unit}" for item in case.characteristics if item.unit != "-")
        yield f"Units of delta: {', '.join(units)}."
