"""The sections on what was tested, and on limits and trust: how far the findings hold and agree with published data."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from safevar_sumo.ads import ADS
from safevar_sumo.analysis.explain.result import Explained
from safevar_sumo.analysis.explain.robustness import MIN_ROBUST_SHARE
from safevar_sumo.analysis.model_spread import compute_model_spreads
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES
from safevar_sumo.analysis.words import number_of
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import JsonObject, Outcome
from safevar_sumo.reference import Totals, shipped_totals_of
from safevar_sumo.replay.comparison import format_number, superscript_powers
from safevar_sumo.report.causes import FIRST_CHOICES
from safevar_sumo.report.input import ReportInput
from safevar_sumo.results import read_manifest
from safevar_sumo.scenarios import SCENARIOS, equals_clear, pre_crash_sentence
from safevar_sumo.study import SAFETY_DEGREE, Study, unit_text
from safevar_sumo.sumo.matrix import vehicle_remarks
from safevar_sumo.vehicles import VEHICLES

GENERAL_LIMITS = (
    "A search that finds no failure proves nothing about the settings that it did not try.",
    "One vehicle in its lane: no steering beyond lane keeping, no separate wheels and axles, no suspension, no wind, "
    "no sensor noise, no traffic beyond the scenario's own, unless the study says otherwise.",
    "Driving system and vehicle are models: how far they agree with published data is told where there is any.",
)


def describe_tested_system(data: ReportInput) -> JsonObject:
    """Describe the tested vehicle, driving system and scenario, and the search, in sentences.

    `characteristics` holds name, unit, original, lower, upper, threshold and meaning of each.
    """
    case, study = data.case, data.case.study
    return {
        "subject": f"Vehicle: {_name_and_sentence(VEHICLES, study.vehicle.model)}, "
        f"{number_of(len(case.characteristics), 'varied characteristic')}. "
        f"Driving system: {_name_and_sentence(ADS, study.ads.model)}. "
        f"Scenario: {_name_and_sentence(SCENARIOS, study.scenario.model)}; {describe_conditions(data)}.",
        "tags": pre_crash_sentence(data.system.points),
        "search": _describe_search(data),
        "characteristics": [
            (
                item.name,
                superscript_powers(unit_text(item.unit, "{}")),
                *map(format_number, (item.original, item.lower, item.upper, item.threshold)),
                item.words,
            )
            for item in case.characteristics
        ],
        "remarks": [*case.remarks, *vehicle_remarks(data.system)],
    }


def describe_conditions(data: ReportInput) -> str:
    """Describe the weather or, by test, the points of the matrix."""
    points = data.system.matrix
    if data.point:
        return f"only at the point {data.point} of its matrix, at which all solutions are simulated again"
    if not points:
        no_effect = " (no effect on road and sensors; a driving system may have other parameters in it)"
        return f"weather: {data.case.weather.name}{no_effect if equals_clear(data.case.weather) else ''}"
    tests = Counter(f"{dict(point.parameters)['test']}, {point.weather.name}" for point in points)
    described = "; ".join(f"{test}: {number_of(count, 'point')}" for test, count in tests.items())
    return f"every vehicle at all {len(points)} points of a matrix ({described})"


def _describe_search(data: ReportInput) -> str:
    case, search = data.case, data.case.study.search
    versions = ", ".join(f"{name} {value}" for name, value in read_manifest(data.directory)["versions"].items())
    if not case.has_runs:
        return f"The {len(case.solutions)} solutions are imported ({versions})."
    runs = Counter(algorithm for algorithm, _ in case.finished_runs)
    names = [f"{ALGORITHM_TITLES.get(name, name)} ({number_of(count, 'run')})" for name, count in runs.items()]
    return (
        f"Searched by {', '.join(names) or 'no finished run'} of at most {search.evaluations} simulations each, "
        f"{len(case.evaluations)} different vehicles in all, from seed {search.seed}, with {versions}."
    )


def _name_and_sentence(models: Mapping[str, Any], name: str) -> str:
    """A model's name with the first sentence of its description; user code has the name alone."""
    if name not in models:
        return name
    first_line = (models[name].__doc__ or "").strip().partition("\n")[0]
    return f"{name} ({first_line.rstrip('.')})"


def describe_agreement(study: Study) -> str:
    """How well a study agrees with each file of published data, in sentences."""
    totals = shipped_totals_of(study)
    if not totals:
        return (
            "This study was not compared with published data: whether another simulator or a real vehicle behaves in "
            "the same way is unknown."
        )
    by_collisions = sorted(totals.items(), key=lambda item: (-item[1].collisions["reference"], -item[1].rows))
    sentences = (_agreement_sentence(file, entry) for file, entry in by_collisions)
    return f"Agreement with published data. {' '.join(sentences)}"


def _agreement_sentence(file: str, totals: Totals) -> str:
    counts, parts = totals.collisions, [f"{file}, {totals.rows} vehicles simulated again"]
    if (rho := totals.spearman.get(SAFETY_DEGREE)) is not None:
        parts.append(f"the rank correlation of the safety degrees is {rho:.2f} (1: the same order, 0: none)")
    if (error := totals.mean_absolute_error.get(SAFETY_DEGREE)) is not None:
        parts.append(f"their mean error is {error:.2f} m")
    if totals.recall is not None:
        published = f"{counts['both']} of the {counts['reference']} published collisions collide here too"
        parts.append(f"{published} (recall {totals.recall:.2f})")
    if totals.precision is not None:
        here = f"{counts['both']} of the {counts['here']} collisions here are published ones"
        parts.append(f"{here} (precision {totals.precision:.2f})")
    return f"{'; '.join(parts)}."


def describe_limits(data: ReportInput, explained: Explained | None) -> JsonObject:
    """Describe how far the findings of one study hold, and how well it agrees with published data.

    `published` lists metrics of the original vehicle: name, published value, value here. `spread` lists vehicles: name,
    safety degree here, safety degrees with the study's other parameter sets.
    """
    case, failures = data.case, explained.explanations if explained else ()
    published = [
        (name, case.study.published[name], case.original[name])
        for name in METRICS
        if name in case.study.published and not math.isnan(case.original[name])
    ]
    remarks = []
    for outcome, words in (
        (Outcome.SIMULATOR_ERROR, "could not be simulated; no result contains them"),
        (
            Outcome.INVALID_TEST,
            "left the tolerance of a test's speed before the driving system acted: they are neither failures nor "
            "successes",
        ),
    ):
        if count := int((case.evaluations["outcome"] == str(outcome)).sum()):
            remarks.append(f"{count} of {len(case.evaluations)} settings {words}.")
    if failures:
        borderline = sum(failure.robustness.borderline for failure in failures)
        remarks.append(
            f"{borderline} of {len(failures)} failures analysed are borderline: fewer than "
            f"{100 * MIN_ROBUST_SHARE:.0f} % of their neighbours are unsafe too."
        )
    if not published:
        remarks.append("There are no published values of the original vehicle to compare the study with.")
    spread = []
    if case.study.spread:
        handles = data.select_handles(*FIRST_CHOICES) if data.any_unsafe else []
        settings = [case.characteristics.original, *map(data.setting_of, handles)]
        degrees = [case.original[SAFETY_DEGREE], *(data.solutions[handle]["f_safe"] for handle in handles)]
        spreads = compute_model_spreads(case.study, np.stack(settings), data.point)
        spread = list(zip(("original vehicle", *handles), degrees, spreads, strict=True))
    return {"general_limits": GENERAL_LIMITS, "remarks": remarks, "published": published, "spread": spread}
