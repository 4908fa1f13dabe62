"""The sections of a page besides the answers: what was tested, and how far to trust the results."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd

from safevar_sumo.ads import ADS
from safevar_sumo.questions.answer import (
    Answer,
    tabulate,
)
from safevar_sumo.questions.case import Results
from safevar_sumo.questions.catalogue import description_of
from safevar_sumo.questions.explain.failures import REASONS
from safevar_sumo.questions.model_spread import compute_model_spreads
from safevar_sumo.questions.sentence import Verdict, answer
from safevar_sumo.questions.tables import AnswerTable, shipped_columns
from safevar_sumo.questions.words import counted_in_words, number_of
from safevar_sumo.records import FloatArray, Outcome
from safevar_sumo.reference.agreement import shipped_agreement
from safevar_sumo.results import choose_handle, handles_of
from safevar_sumo.scenarios import SCENARIOS, equals_clear, pre_crash_sentence
from safevar_sumo.study import SAFETY_DEGREE
from safevar_sumo.sumo.matrix import vehicle_remarks
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.vehicles import VEHICLES

FIRST_CHOICES = ("smallest", "most_severe")
"""Choices of solutions that a page replays; `REASONS` has their reasons. The option `--solution` of
`simulate` has the same choices.
"""
NO_RESULT = {
    Outcome.SIMULATOR_ERROR: "could not be simulated and are in no result.",
    Outcome.INVALID_TEST: (
        "drove invalid tests, which count neither as failures nor as successes. In such a test the"
        " vehicle misses the speed of the test, the driving system acts too early, or nothing"
        " happens."
    ),
}
"""Outcomes of vehicles that are neither safe nor unsafe, with the end of a sentence about them."""
GENERAL_LIMITS = (
    "A search that finds no failure proves nothing about vehicles that it did not simulate.",
    (
        "The simulated vehicle keeps its lane. Unless the study states them, the simulation has no"
        " separate wheels and axles, no suspension, no wind, no sensor noise and no further"
        " traffic."
    ),
    (
        "The driving system and the vehicle are models. This section states how far both models"
        " agree with published data, where such data exist."
    ),
)
COLUMNS_BY_TABLE = shipped_columns("report")
"""The columns of the tables of both sections, by the names of the tables in columns.toml."""


@dataclass(frozen=True, kw_only=True)
class ReportedStudy:
    """One study of a page: its results, and the answers about them.

    Attributes
    ----------
    directory
        The directory of the results.
    case
        The results. If the page is about a point, their solutions were simulated again there.
    versions
        The versions of the packages that computed the results, by package.
    answers
        Answers about the results, in the order of the page.
    point
        The only point of the matrix that the page is about; "" for the whole study.
    later_changes
        The changes of files and versions since the results were computed.
    speed
        The answer about the greatest speed on the sheet, which is among `answers`, too; None
        without it.
    simulations
        The largest number of simulations of the replays in a simulator that takes long; None
        without a limit.
    """

    directory: Path
    case: Results
    versions: Mapping[str, str]
    answers: Sequence[Answer] = ()
    point: str = ""
    later_changes: Sequence[str] = ()
    speed: Answer | None = None
    simulations: int | None = None

    @cached_property
    def system(self) -> System:
        return assemble(self.case.study)

    @cached_property
    def choices(self) -> dict[str, str]:
        """The reasons for the solutions that `FIRST_CHOICES` select, by their handles. If no
        solution is unsafe, only the most severe one is selected.
        """
        solutions = self.case.solutions
        if solutions.empty:
            return {}
        names: Sequence[str] = FIRST_CHOICES
        if not self.case.unsafe.rows(solutions).any():
            names = FIRST_CHOICES[-1:]
        chosen: dict[str, list[str]] = {}
        for name in names:
            handle = choose_handle(solutions, self.case.unsafe, name)
            chosen.setdefault(str(handle), []).append(REASONS[name])
        return {handle: ", ".join(reasons) for handle, reasons in chosen.items()}

    @cached_property
    def chosen_solutions(self) -> pd.DataFrame:
        """The rows of the solutions in `choices`, by their handles."""
        solutions = self.case.solutions
        handles = pd.Index(str(handle) for handle in handles_of(solutions))
        return solutions.set_index(handles).loc[list(self.choices)]

    @property
    def has_workshop_parts(self) -> bool:
        """Whether a workshop can measure at least half of the vehicle's characteristics."""
        items = self.case.characteristics.vehicle
        return 2 * sum(item.is_for_workshop for item in items) >= len(items)

    @property
    def chosen_settings(self) -> FloatArray:
        """The settings of the M solutions in `choices`, shape (M, n)."""
        names = list(self.case.characteristics.names)
        return self.chosen_solutions[names].to_numpy(float)


def tested(study: ReportedStudy) -> Answer:
    """The section on what was tested: the vehicle, driving system and scenario, and the search."""
    case = study.case
    models = [
        f"The {kind} is {name_and_sentence(catalogue, table.model)}."
        for kind, catalogue, table in (
            ("vehicle", VEHICLES, case.study.vehicle),
            ("driving system", ADS, case.study.ads),
        )
        if table.model
    ]

    rows = [
        {
            "characteristic": item.name,
            "unit": item.unit,
            "original": item.original,
            "lowest": item.lower,
            "highest": item.upper,
            "threshold": item.threshold,
            "meaning": item.words,
        }
        for item in case.characteristics
    ]
    remarks = [*case.remarks, *vehicle_remarks(study.system)]
    sentences = [*models, _scenario(study), *counted_in_words(case.study)]
    sentences += [_search(study), pre_crash_sentence(study.system.points)]
    return Answer(
        question="what was tested",
        study=case.study,
        verdict=Verdict(answer(sentence) for sentence in sentences),
        numbers={},
        tables={
            "characteristics": tabulate(
                "Characteristics and their domains",
                COLUMNS_BY_TABLE["characteristics"],
                rows,
            ),
            "remarks": _remarks(remarks),
        },
        lead=None,
    )


def _remarks(texts: Sequence[str]) -> AnswerTable:
    return tabulate(
        "Remarks",
        {"remark": "what to bear in mind"},
        [{"remark": text} for text in texts],
    )


def _scenario(study: ReportedStudy) -> str:
    """A sentence on the scenario, with its weather, or with the number of test cases by test."""
    points = study.system.matrix
    weather = study.case.weather
    model = name_and_sentence(SCENARIOS, study.case.study.scenario.model)
    scenario = f"The scenario is {model}, with"
    if study.point:
        return (
            f"{scenario} the test case {study.point} alone, in which all solutions were simulated"
            " again."
        )
    if not study.system.mover.has("weather"):
        number = number_of(max(len(points), 1), "test case")
        return f"{scenario} {number}. The simulator of the scenario moves and drives the vehicle."
    if points:
        tests = Counter(
            f"{point.parameters['test']}, {point.weather.name}" for point in points
        )
        described = "; ".join(
            f"{test}: {number_of(count, 'test case')}" for test, count in tests.items()
        )
        return (
            f"{scenario} {len(points)} test cases, all of which every vehicle drives"
            f" ({described})."
        )
    sentence = f"{scenario} the weather {weather.name}."
    if equals_clear(weather):
        sentence += " This weather changes neither the road nor the sensors."
    return sentence


def _search(study: ReportedStudy) -> str:
    """A sentence on the search that found the solutions, or on their import."""
    case = study.case
    search = case.study.search
    versions = ", ".join(f"{name} {value}" for name, value in study.versions.items())
    if not case.has_runs:
        return f"The {len(case.solutions):,} solutions were imported ({versions})."
    names = [
        f"{case.title_of(name)} ({number_of(count, 'run')})"
        for name, count in case.run_counts.items()
    ]
    return (
        f"The search algorithms are {', '.join(names) or 'without a finished run'}, with at most"
        f" {search.evaluations:,} simulations in each run. All runs together simulated"
        f" {len(case.evaluations):,} different vehicles. The seed is {search.seed}, and the"
        f" versions are {versions}."
    )


def name_and_sentence(models: Mapping[str, type], name: str) -> str:
    """The name of a model with its description in brackets; of user code, only the name."""
    if name in models:
        return f"{name} ({description_of(models[name]).rstrip('.')})"
    return name


def trust(study: ReportedStudy) -> Answer:
    """The section on trust: how far the results agree with published data and with other parameter
    sets of the vehicle model, and what the simulations leave out.
    """
    case = study.case
    tables = dict[str, AnswerTable]()
    sentences = [
        "The simulations of this study were not compared with published ones. Nobody knows whether"
        " another simulator or a real vehicle behaves in the same way."
    ]
    agreement = shipped_agreement(case.study)
    if len(agreement):
        title = "Agreement of the safety degrees with published data"
        tables["agreement"] = tabulate(title, COLUMNS_BY_TABLE["agreement"], agreement)
        ends = [f"{agreement['spearman'].agg(end):.2f}" for end in ("min", "max")]
        sentences = [
            "Nothing was compared with a real car. The safety degrees were compared with"
            f" {number_of(len(agreement), 'file')} of published simulations. The rank correlation"
            f" is {' to '.join(dict.fromkeys(ends))}."
        ]
    elif case.study.spread:
        sentences.append("The vehicle model was fitted to published data.")

    if case.study.spread:
        settings = np.vstack([case.characteristics.original, study.chosen_settings])
        spreads = compute_model_spreads(case.study, settings, study.point)
        degrees = [
            case.original_metrics[SAFETY_DEGREE],
            *study.chosen_solutions["f_safe"],
        ]
        rows = [
            {
                "vehicle": name,
                "safety_degree": degree,
                "safety_degree_low": spread.lower,
                "safety_degree_high": spread.upper,
                "sets": spread.sets,
                "collisions": spread.collisions,
            }
            for name, degree, spread in zip(
                ["original", *study.choices], degrees, spreads, strict=True
            )
        ]
        title = "Uncertainty of the vehicle model: safety degree with its other parameter sets"
        tables["spread"] = tabulate(title, COLUMNS_BY_TABLE["spread"], rows)

    # The quotient is safe: a study refuses a published value of 0.
    published = []
    for name, value in case.study.published.items():
        metric = case.original_metrics.get(name, math.nan)
        if not math.isnan(metric):
            published.append(
                {
                    "metric": name,
                    "published": value,
                    "here": metric,
                    "difference": 100 * (metric / value - 1),
                }
            )
    tables["original"] = tabulate(
        "Metrics of the original vehicle, published and simulated here",
        COLUMNS_BY_TABLE["published"],
        published,
    )

    counts = Counter(case.evaluations["outcome"])
    number = f"{len(case.evaluations):,}"
    remarks = [
        f"{counts[outcome]:,} of {number} vehicles {words}"
        for outcome, words in NO_RESULT.items()
        if counts[outcome]
    ]
    tables["remarks"] = _remarks([*remarks, *GENERAL_LIMITS])
    return Answer(
        question="limits and trust",
        study=case.study,
        verdict=Verdict(answer(sentence) for sentence in sentences),
        numbers={},
        tables=tables,
    )
