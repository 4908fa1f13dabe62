"""What stands on a page beside the answers: what was tested, how far to trust it, replays, and
commands.
"""

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
    Column,
    Columns,
    tabulate,
    with_interval,
)
from safevar_sumo.questions.case import Case
from safevar_sumo.questions.catalogue import description_of
from safevar_sumo.questions.explain.failures import REASONS
from safevar_sumo.questions.model_spread import compute_model_spreads
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
"""Choices of `REASONS` that select the solutions to replay, as the flags of `simulate` do."""
NO_RESULT = {
    Outcome.SIMULATOR_ERROR: "could not be simulated, and no result contains them",
    Outcome.INVALID_TEST: (
        "are invalid tests, which are neither failures nor successes: the vehicle left the"
        " tolerance of the test's speed, the driving system acted before the test allows it, or"
        " nothing happened"
    ),
}
"""Outcomes of settings about which nothing is known."""
GENERAL_LIMITS = (
    "A search that finds no failure proves nothing about vehicles that it did not simulate.",
    (
        "The simulation has one vehicle that keeps its lane. Unless the study says otherwise, the"
        " model leaves out single wheels, suspension, wind, sensor noise and other traffic."
    ),
    (
        "The driving system and the vehicle are models. Where published data exist, this section"
        " says how far the models agree with them."
    ),
)
CHARACTERISTICS: Columns = {
    "characteristic": "characteristic of the vehicle, or of its encounter",
    "unit": "unit of its values",
    "original": Column("as in column unit", "value of the original vehicle"),
    "lowest": Column("as in column unit", "lower end of its domain"),
    "highest": Column("as in column unit", "upper end of its domain"),
    "threshold": Column("as in column unit", "a change smaller than this is undone"),
    "meaning": "full name",
}
AGREEMENT: Columns = {
    "file": "published data",
    "rows": "vehicles",
    "spearman": Column("-", "Spearman's rank correlation of the safety degrees", ".2f"),
    "mean_absolute_error": Column("m", "mean of the absolute differences", ".2f"),
    "bias": Column("m", "mean difference (here minus published)", ".2f"),
    "collisions_here": "vehicles that collide here",
    "collisions_reference": "vehicles that collide in the published data",
    "collisions_both": "vehicles that collide in both",
}
SPREAD: Columns = {
    "vehicle": "the original, or a solution",
    **with_interval(
        SAFETY_DEGREE,
        Column(
            "m or -m/s",
            "simulated value, with the interval of 90 % of parameter sets and the model's error",
            ".2f",
        ),
    ),
    "sets": "parameter sets of the vehicle model that agree with published data about as well",
    "collisions": "parameter sets in which it collides",
}
PUBLISHED: Columns = {
    "metric": "safety metric of the original vehicle",
    "published": "its published value",
    "here": "its value here",
    "difference": Column(
        "%", "here minus published, in per cent of the published value", ".1f"
    ),
}


@dataclass(frozen=True, kw_only=True)
class ReportedStudy:
    """One study of a page.

    Attributes
    ----------
    directory
        The results.
    case
        The results; at a point, with their solutions simulated again there.
    versions
        The packages that the results were computed with.
    answers
        Answers about the results.
    point
        The only point of the matrix that the page is about; "" for the whole study.
    later_changes
        The files and versions that have changed since.
    speed
        The answer to `speed_values`, which is among the answers, too.
    simulations
        The largest number of simulations of its replays in a simulator of the user's own.
    """

    directory: Path
    case: Case
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
        """The handles of the solutions that `FIRST_CHOICES` select, and why; if none is unsafe, of
        the most severe.
        """
        solutions = self.case.solutions
        chosen = dict[str, list[str]]()
        if solutions.empty:
            return {}
        has_failures = self.case.unsafe.rows(solutions).any()
        for name in FIRST_CHOICES if has_failures else FIRST_CHOICES[-1:]:
            handle = choose_handle(solutions, self.case.unsafe, name)
            chosen.setdefault(str(handle), []).append(REASONS[name])
        return {handle: ", ".join(reasons) for handle, reasons in chosen.items()}

    @cached_property
    def chosen_solutions(self) -> pd.DataFrame:
        """The rows of these solutions, by their handles."""
        solutions = self.case.solutions
        handles = pd.Index(map(str, handles_of(solutions)))
        return solutions.set_index(handles).loc[list(self.choices)]

    @property
    def has_workshop_parts(self) -> bool:
        """Whether a workshop can measure at least half of the vehicle's characteristics."""
        items = self.case.characteristics.vehicle
        return 2 * sum(item.is_for_workshop for item in items) >= len(items)

    @property
    def chosen_settings(self) -> FloatArray:
        """Their settings, shape (M, n)."""
        return self.chosen_solutions[list(self.case.characteristics.names)].to_numpy(
            float
        )


def tested(study: ReportedStudy) -> Answer:
    """The tested vehicle, driving system and scenario, and the search."""
    case = study.case
    models = [
        f"{title}: {name_and_sentence(catalogue, table.model)}"
        for title, catalogue, table in (
            ("Vehicle", VEHICLES, case.study.vehicle),
            ("Driving system", ADS, case.study.ads),
            ("Scenario", SCENARIOS, case.study.scenario),
        )
        if table.model
    ]

    rows = [
        (
            item.name,
            item.unit,
            item.original,
            item.lower,
            item.upper,
            item.threshold,
            item.words,
        )
        for item in case.characteristics
    ]
    remarks = [*case.remarks, *vehicle_remarks(study.system)]
    sentences = [
        f"{'. '.join(models)}; {_conditions(study)}.",
        *counted_in_words(case.study),
        _search(study),
        pre_crash_sentence(study.system.points),
    ]
    return Answer(
        question="what was tested",
        study=case.study,
        verdict=" ".join(filter(None, sentences)),
        numbers={},
        tables={
            "characteristics": tabulate(
                "Characteristics and their domains", CHARACTERISTICS, rows
            ),
            "remarks": _remarks(remarks),
        },
        lead=None,
    )


def _remarks(texts: Sequence[str]) -> pd.DataFrame:
    return tabulate(
        "Remarks", {"remark": "what to bear in mind"}, [(text,) for text in texts]
    )


def _conditions(study: ReportedStudy) -> str:
    """The weather or, by test, the points of the matrix."""
    points = study.system.matrix
    if study.point:
        return (
            f"only the test case {study.point} of its matrix, in which all solutions were simulated"
            " again"
        )
    if not study.system.mover.has("weather"):
        words = "the simulator of the scenario moves and drives the vehicle"
        if points:
            words += f", in {number_of(len(points), 'test case')}"
        return words
    weather = study.case.weather
    if not points and equals_clear(weather):
        return (
            f"weather: {weather.name} (it changes neither road nor sensors, but possibly"
            " parameters of the driving system)"
        )
    if not points:
        return f"weather: {weather.name}"
    tests = Counter(
        f"{dict(point.parameters)['test']}, {point.weather.name}" for point in points
    )
    described = "; ".join(
        f"{test}: {number_of(count, 'test case')}" for test, count in tests.items()
    )
    return (
        f"every vehicle drives all {len(points)} test cases of a matrix ({described})"
    )


def _search(study: ReportedStudy) -> str:
    case = study.case
    search = study.case.study.search
    versions = ", ".join(f"{name} {value}" for name, value in study.versions.items())
    if not case.has_runs:
        return f"The {len(case.solutions)} solutions are imported ({versions})."
    runs = Counter(algorithm for algorithm, _ in case.finished_runs)
    names = [
        f"{case.title_of(name)} ({number_of(count, 'run')})"
        for name, count in runs.items()
    ]
    return (
        f"The search has {', '.join(names) or 'no finished run'}, with at most"
        f" {search.evaluations} simulations in a run. All runs together simulated"
        f" {len(case.evaluations)} different vehicles. The seed is {search.seed}. The versions are"
        f" {versions}."
    )


def name_and_sentence(models: Mapping[str, type], name: str) -> str:
    """A model's name with its description; user code has the name alone."""
    if name in models:
        return f"{name} ({description_of(models[name]).rstrip('.')})"
    return name


def trust(study: ReportedStudy) -> Answer:
    """How far the results agree with published data and with other parameter sets, and what
    they leave out.
    """
    case = study.case
    tables = {}
    fitted = (
        "Published data were used to fit the vehicle. " if case.study.spread else ""
    )
    verdict = (
        f"{fitted}The simulations of this study were not compared with published ones. Nobody knows"
        " whether another simulator or a real vehicle behaves in the same way."
    )
    agreement = shipped_agreement(case.study)
    if len(agreement):
        tables["agreement"] = tabulate(
            "Agreement with published data: safety degrees", AGREEMENT, agreement
        )
        lowest = agreement["spearman"].min()
        highest = agreement["spearman"].max()
        ending = ""
        if lowest != highest:
            ending = f" to {highest:.2f}"
        verdict = (
            f"The safety degrees were compared with {number_of(len(agreement), 'file')} of"
            f" published simulations. The rank correlation is {lowest:.2f}{ending}. Nothing was"
            " compared with a real car."
        )

    if case.study.spread:
        settings = np.vstack([case.characteristics.original, study.chosen_settings])
        spreads = compute_model_spreads(case.study, settings, study.point)
        degrees = [case.original[SAFETY_DEGREE], *study.chosen_solutions["f_safe"]]
        rows = [
            (name, degree, spread.lower, spread.upper, spread.sets, spread.collisions)
            for name, degree, spread in zip(
                ["original", *study.choices], degrees, spreads, strict=True
            )
        ]
        tables["spread"] = tabulate("The vehicle model's own uncertainty", SPREAD, rows)

    # No published value is 0: the study refuses it.
    published = [
        (name, value, metric, 100 * (metric / value - 1))
        for name, value in case.study.published.items()
        if not math.isnan(metric := case.original.get(name, math.nan))
    ]
    tables["original"] = tabulate(
        "The original vehicle, published and here", PUBLISHED, published
    )

    counts = Counter(case.evaluations["outcome"])
    remarks = [
        f"{counts[outcome]} of {len(case.evaluations)} vehicles {words}."
        for outcome, words in NO_RESULT.items()
        if counts[outcome]
    ]
    tables["remarks"] = _remarks([*remarks, *GENERAL_LIMITS])
    return Answer(
        question="limits and trust",
        study=case.study,
        verdict=verdict,
        numbers={},
        tables=tables,
    )
