"""The sections on the tested system, on the verdict, and on how far to trust the verdict."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from safevar_sumo.ads import ADS
from safevar_sumo.analysis.explain.result import REASONS, ROBUST, CauseEntry, FailureEntry, most_robust
from safevar_sumo.analysis.explain.robustness import MIN_ROBUST_SHARE, is_borderline, robustness_in_words
from safevar_sumo.analysis.model_spread import ModelSpread, compute_model_spreads
from safevar_sumo.analysis.preventability import PreventedShares
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES, are_collisions
from safevar_sumo.analysis.words import number_of, share_in_words
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import KMH_PER_MS, FloatArray, Outcome
from safevar_sumo.reference import Totals, shipped_totals_of
from safevar_sumo.replay.comparison import format_number, superscript_powers
from safevar_sumo.report.causes import FIRST_CHOICES, Explanations
from safevar_sumo.report.input import ChangeRow, FailingPointsTable, ReportInput, load_or_compute
from safevar_sumo.scenarios import SCENARIOS, Point, distance_in_words, equals_clear, pre_crash_sentence
from safevar_sumo.study import SAFETY_DEGREE, unit_text
from safevar_sumo.sumo.matrix import vehicle_remarks
from safevar_sumo.vehicles import VEHICLES


class TestedSystem(NamedTuple):
    """What was tested, in sentences; `characteristics` holds name, unit, original, lower, upper, threshold and meaning of each."""

    subject: str
    tags: str
    search: str
    characteristics: list[tuple[str, ...]]
    remarks: list[str]


def describe_tested_system(data: ReportInput) -> TestedSystem:
    """Describe the tested vehicle, driving system and scenario, and the search."""
    case, study = data.case, data.case.study
    return TestedSystem(
        subject=f"Vehicle: {_first_sentence(VEHICLES, study.vehicle.model) or study.vehicle.model} "
                f"({number_of(len(case.characteristics), 'varied characteristic')}). "
                f"Driving system: {_name_and_sentence(ADS, study.ads.model)}. "
                f"Scenario: {_name_and_sentence(SCENARIOS, study.scenario.model)}; {_describe_conditions(data)}.",
        tags="" if data.system is None else pre_crash_sentence(data.system.points), search=_describe_search(data),
        characteristics=[
            (characteristic.name, superscript_powers(unit_text(characteristic.unit, "{}")),
             *map(format_number, (characteristic.original, characteristic.lower, characteristic.upper, characteristic.threshold)),
             characteristic.words)
            for characteristic in case.characteristics],
        remarks=[*case.remarks, *([data.problem] if data.problem else []), *(vehicle_remarks(data.system) if data.system else [])])


def _describe_conditions(data: ReportInput) -> str:
    """Describe the weather or, by test, the points of the matrix."""
    points = () if data.system is None else data.system.matrix
    if data.point:
        return f"only at the point {data.point} of its matrix, at which all solutions are simulated again"
    if not points:
        no_effect = " (no effect on road and sensors; a driving system may have other parameters in it)"
        return f"weather: {data.case.weather.name}{no_effect if equals_clear(data.case.weather) else ''}"
    return f"every vehicle at all {len(points)} points of a matrix: {', '.join(_describe_tests(points))}"


def _describe_tests(points: Sequence[Point]) -> list[str]:
    """Describe each test of a matrix by its number of points and their weathers."""
    weathers_by_test: dict[str, list[str]] = {}
    for point in points:
        weathers_by_test.setdefault(str(dict(point.parameters)["test"]), []).append(point.weather.name)
    return [f"{test} ({len(weathers)}, {' and '.join(dict.fromkeys(weathers))})" for test, weathers in weathers_by_test.items()]


def _describe_search(data: ReportInput) -> str:
    case, search = data.case, data.case.study.search
    versions = ", ".join(f"{name} {value}" for name, value in data.manifest["versions"].items())
    if not case.has_runs:
        return f"The {len(case.solutions)} solutions are imported ({versions})."
    runs = Counter(algorithm for algorithm, _ in case.finished_runs)
    names = [f"{ALGORITHM_TITLES.get(name, name)} ({number_of(count, 'run')})" for name, count in runs.items()]
    return (f"Searched by {', '.join(names) or 'no finished run'} of at most {search.evaluations} simulations each, "
            f"{len(case.evaluations)} different vehicles in all, from seed {search.seed}, with {versions}.")


def _name_and_sentence(models: Mapping[str, Any], name: str) -> str:
    return f"{name} ({description})" if (description := _first_sentence(models, name)) else name


def _first_sentence(models: Mapping[str, Any], name: str) -> str:
    """The first sentence of a model's description; empty for user code."""
    if name not in models:
        return ""
    sentence = (models[name].__doc__ or "").strip().partition("\n")[0].rstrip(".")
    return sentence[:1].lower() + sentence[1:] if not sentence[1:2].isupper() else sentence


REASON_TITLES = {ROBUST: "Robust with the fewest changes", REASONS["fewest"]: "Fewest changes",
                 REASONS["smallest"]: "Smallest largest change", REASONS["most_severe"]: "Most severe"}
NO_VALUE = "–"  # noqa: RUF001


class SelectedFailure(NamedTuple):
    """A failure that the verdict shows; all values are those of the solution, not scaled back.

    `unsafe_share` is the share of the failure's neighbours that are unsafe, `cause` its most robust minimal cause; None if the failure
    was not explained.
    """

    title: str
    handle: str
    reasons: list[str]
    anchor: str
    changes: list[ChangeRow]
    largest_change: float
    size: str
    end: str
    f_safe: float
    failing_points: FailingPointsTable | None
    unsafe_share: float | None
    cause: CauseEntry | None

    @property
    def needed(self) -> int | None:
        """Number of changes that suffice for the failure."""
        return None if self.cause is None else len(self.cause.changes)

    @property
    def borderline(self) -> bool:
        return self.unsafe_share is not None and is_borderline(self.unsafe_share)


class KeyFigure(NamedTuple):
    """A number in the verdict: title, value and note as texts."""

    title: str
    value: str
    note: str


class PublishedAgreement(NamedTuple):
    """How well a study agrees with published data: a sentence, and a row of texts for each file; without such data, no rows."""

    sentence: str
    rows: list[list[str]]


class Verdict(NamedTuple):
    """The verdict on a study; in `failures`, the robust failure with the fewest changes comes first."""

    headline: str
    unsafe_count: int
    solution_count: int
    criterion: str
    original: str
    agreement: PublishedAgreement
    failures: list[SelectedFailure]
    key_figures: list[KeyFigure]


def reach_verdict(data: ReportInput, explanations: Explanations | None, tolerance: Mapping[str, Any] | None) -> Verdict:
    """Make the verdict on one study."""
    solutions = data.case.solutions
    failures = [] if solutions.empty else _select_failures(data, explanations)
    return Verdict(
        headline=data.no_verdict or ("No solution was found." if solutions.empty else _headline(data, failures, explanations)),
        unsafe_count=sum(data.unsafe_solutions), solution_count=len(solutions),
        criterion=data.case.unsafe.description, original=_describe_original(data), agreement=describe_agreement(data),
        failures=failures, key_figures=[] if solutions.empty else _key_figures(data, failures, explanations, tolerance))


def _describe_original(data: ReportInput) -> str:
    if data.system is None:
        return f"The original vehicle's safety degree is {data.case.original[SAFETY_DEGREE]:.2f} m."
    return f"The original vehicle {data.compare_with_original(data.case.characteristics.original).verdict(0)}."


def _select_failures(data: ReportInput, explanations: Explanations | None) -> list[SelectedFailure]:
    """Select the failures to show, each with the reasons for it; without explanations, select among all solutions."""
    explained = {failure.handle: failure for failure in explanations.failures if failure.handle} if explanations else {}
    reasons = {handle: shown for handle, item in explained.items() if (shown := [name for name in item.reasons if name in REASON_TITLES])}
    if not reasons:
        for choice in REASONS if any(data.unsafe_solutions) else ("most_severe",):
            reasons.setdefault(data.select_handle(choice), []).append(REASONS[choice])
    order = list(REASON_TITLES)
    handles = sorted(reasons, key=lambda handle: min(map(order.index, reasons[handle])))
    return [_select_failure(data, handle, reasons[handle], explained.get(handle)) for handle in handles]


def _select_failure(data: ReportInput, handle: str, reasons: list[str], failure: FailureEntry | None) -> SelectedFailure:
    setting = data.setting_of(handle)
    changes, largest_change = data.list_changes(setting), float(data.case.characteristics.largest_change(setting[np.newaxis])[0])
    title, *titles = [REASON_TITLES[reason] for reason in REASON_TITLES if reason in reasons]
    return SelectedFailure(
        title="; ".join([title, *map(str.lower, titles)]), handle=handle, reasons=reasons, anchor=data.anchor("replay", handle),
        changes=changes, largest_change=largest_change,
        size=f"{len(changes)} of {len(setting)} characteristics changed, by at most {100 * largest_change:.0f} %",
        end=_describe_end(data, handle, setting), f_safe=data.solutions[handle]["f_safe"], failing_points=data.failing_points(setting),
        unsafe_share=failure.robustness if failure else None,
        cause=most_robust(failure.minimal_causes) if failure else None)


def _describe_end(data: ReportInput, handle: str, setting: FloatArray) -> str:
    if data.system is None:
        return f"safety degree {data.solutions[handle]['f_safe']:.2f}"
    comparison = data.compare_with_original(setting)
    return comparison.verdict(comparison.rows[-1])


def _headline(data: ReportInput, failures: Sequence[SelectedFailure], explanations: Explanations | None) -> str:
    if not any(data.unsafe_solutions):
        return f"None of {len(data.case.solutions)} solutions is unsafe; the nearest miss is shown below."
    if data.original_fails:
        return "No change is needed: the original vehicle itself collides."
    first = failures[0]
    if first.needed == 0:
        return "No change is needed: the original vehicle itself is unsafe."
    outcome = "a collision" if are_collisions(data.case.solutions).any() else "an unsafe outcome"
    phrase = f"{outcome} that is robust" if ROBUST in first.reasons else outcome
    borderline = ""
    if explanations and phrase == outcome:
        borderline = f"{_borderline_failures(explanations)} borderline. The one with the fewest changes: "
    versions = "simulated with the present files and versions, " if data.later_changes else ""
    return f"{borderline}{_changes_lead_to(first, phrase)}: {versions}the vehicle {first.end}."


def _changes_lead_to(failure: SelectedFailure, outcome: str) -> str:
    """A sentence such as `10 changes lead to a collision (3 of them suffice ...)`; how many suffice is known only if explained."""
    count, needed = len(failure.changes), failure.needed
    if count == needed:
        return f"{number_of(count, 'change')} suffice{'s' if count == 1 else ''} for {outcome}"
    cause_robustness = failure.cause.robustness if failure.cause else None
    borderline = "" if cause_robustness is None or not is_borderline(cause_robustness) else f", but {robustness_in_words(cause_robustness)}"
    sufficiency = "" if needed is None else f" ({needed} of them suffice{'s' if needed == 1 else ''} to be unsafe{borderline})"
    return f"{number_of(count, 'change')} lead{'s' if count == 1 else ''} to {outcome}{sufficiency}"


def _key_figures(data: ReportInput, failures: Sequence[SelectedFailure], explanations: Explanations | None,
             tolerance: Mapping[str, Any] | None) -> list[KeyFigure]:
    """The key figures: robust failure with the fewest changes, severity, preventability, joint tolerance."""
    by_reason = {reason: failure for failure in failures for reason in failure.reasons}
    return [_robustness_figure(by_reason.get(ROBUST), explanations, data), _severity_figure(by_reason.get(REASONS["most_severe"]), data),
            _preventability_figure(explanations.summary.preventable if explanations else None, data), _tolerance_figure(tolerance)]


def _borderline_failures(explanations: Explanations) -> str:
    """The failures that are borderline, and a verb, if no robust failure was found among those with the fewest changes."""
    all_borderline = all(is_borderline(failure.robustness) for failure in explanations.failures)
    return "Every failure analysed is" if all_borderline else "The failures with the fewest changes are"


def _robustness_figure(robust: SelectedFailure | None, explanations: Explanations | None, data: ReportInput) -> KeyFigure:
    if robust is None:
        reason = f"{_borderline_failures(explanations)} borderline" if explanations else "not computed"
        return KeyFigure(REASON_TITLES[ROBUST], NO_VALUE, reason if any(data.unsafe_solutions) else "no solution is unsafe")
    return KeyFigure(REASON_TITLES[ROBUST], f"{number_of(len(robust.changes), 'change')} of at most {100 * robust.largest_change:.0f} %",
                     f"{100 * (robust.unsafe_share or 0):.0f} % of its neighbours are unsafe too")


def _severity_figure(most_severe: SelectedFailure | None, data: ReportInput) -> KeyFigure:
    degree = float(data.case.solutions["f_safe"].min()) if most_severe is None else most_severe.f_safe
    if degree < 0:
        return KeyFigure("Most severe", f"collision at {-degree:.1f} m/s", f"{-KMH_PER_MS * degree:.0f} km/h")
    distance = distance_in_words(SCENARIOS.get(data.case.study.scenario.model), degree)
    return KeyFigure("Most severe", f"safety degree {distance}", "no collision among the solutions")


def _preventability_figure(preventable: PreventedShares | None, data: ReportInput) -> KeyFigure:
    title = "A competent driver avoids"
    if preventable is None or preventable.competent_driver is None or preventable.interval_competent_driver is None:
        any_collision = are_collisions(data.case.solutions).any()
        return KeyFigure(title, NO_VALUE, "not computed" if any_collision else "there is no collision to avoid")
    low, high = preventable.interval_competent_driver
    sample = "all" if low == high else f"95 % interval {100 * low:.0f} % to {100 * high:.0f} %;"
    return KeyFigure(title, f"{share_in_words(preventable.competent_driver)} of the collisions",
                     f"{preventable.later}, in the same vehicle ({sample} {preventable.looked_at} collisions analysed)")


def _tolerance_figure(tolerance: Mapping[str, Any] | None) -> KeyFigure:
    title = "Joint tolerance of all characteristics"
    if tolerance is None:
        return KeyFigure(title, NO_VALUE, "not computed")
    factor, samples = tolerance["joint"]["factor"], tolerance["joint"]["samples"]
    if not factor:
        return KeyFigure(title, "none", "no box around the original is safe")
    return KeyFigure(title, f"{100 * factor:.1f} % of the way",
                     f"from the original to the ends of their domains; none of {samples} vehicles sampled there is unsafe")


def describe_agreement(data: ReportInput) -> PublishedAgreement:
    """Describe how well the study agrees with published data."""
    totals = shipped_totals_of(data.case.study)
    if not totals:
        return PublishedAgreement("This study was not compared with published data: whether another simulator or a real vehicle behaves in "
                                  "the same way is unknown.", [])
    by_collisions = sorted(totals.items(), key=lambda item: (-item[1].collisions["reference"], -item[1].rows))
    sentences = (_agreement_sentence(file, entry) for file, entry in by_collisions)
    return PublishedAgreement(f"Agreement with published data. {' '.join(sentences)}",
                              [_agreement_row(file, entry) for file, entry in totals.items()])


def _agreement_sentence(file: str, totals: Totals) -> str:
    counts = totals.collisions
    collisions = "no published collision is among them" if totals.recall is None else (
        f"{counts['both']} of the {counts['reference']} published collisions collide here too (recall {totals.recall:.2f})")
    if totals.precision is not None:
        collisions += (f", and {counts['both']} of the {counts['here']} collisions here are published ones "
                       f"(precision {totals.precision:.2f})")
    rho = totals.spearman.get(SAFETY_DEGREE)
    order = "" if rho is None else f" the rank correlation of the safety degrees is {rho:.2f} (1: the same order, 0: none);"
    return f"{file}, {totals.rows} vehicles simulated again:{order} {collisions}."


def _agreement_row(file: str, totals: Totals) -> list[str]:
    """The texts of a row: file, vehicles, rank correlation, mean error, collisions published, here and in both, recall, precision."""
    def decimal(value: float | None) -> str:
        return NO_VALUE if value is None else f"{value:.2f}"

    degree_agreement = totals.spearman.get(SAFETY_DEGREE), totals.mean_absolute_error.get(SAFETY_DEGREE)
    return [file, str(totals.rows), *map(decimal, degree_agreement),
            *(str(totals.collisions[side]) for side in ("reference", "here", "both")),
            *map(decimal, (totals.recall, totals.precision))]


GENERAL_LIMITS = (
    "A search that finds no failure proves nothing about the settings that it did not try.",
    "One vehicle in its lane: no steering beyond lane keeping, no separate wheels and axles, no suspension, no wind, no sensor "
    "noise, no traffic beyond the scenario's own, unless the study says otherwise.",
    "Driving system and vehicle are models: the tables below show how far they agree with published data, where there is any.",
)


class TrustSection(NamedTuple):
    """The limits of one study's findings, and its agreement with published data.

    `published` lists metrics of the original vehicle: name, published value, value here. `spread` lists vehicles: name, safety degree
    here, safety degrees with the study's other parameter sets.
    """

    general_limits: Sequence[str]
    remarks: list[str]
    published: list[tuple[str, float, float]]
    agreement: list[list[str]]
    spread: list[tuple[str, float, ModelSpread]]


def describe_limits(data: ReportInput, explanations: Explanations | None) -> TrustSection:
    """Describe how far the findings of one study hold, and how well it agrees with published data."""
    case = data.case
    published = [(name, case.study.published[name], case.original[name])
                 for name in METRICS if name in case.study.published and not math.isnan(case.original[name])]
    remarks = []
    error_count = int((case.evaluations["outcome"] == str(Outcome.SIMULATOR_ERROR)).sum())
    if error_count:
        remarks.append(f"{error_count} of {len(case.evaluations)} settings could not be simulated; no result contains them.")
    invalid_count = int((case.evaluations["outcome"] == str(Outcome.INVALID_TEST)).sum())
    if invalid_count:
        remarks.append(f"{invalid_count} of {len(case.evaluations)} settings left the tolerance of a test's speed before the driving "
                       "system acted: they are neither failures nor successes.")
    if explanations and explanations.failures:
        borderline_count = sum(is_borderline(failure.robustness) for failure in explanations.failures)
        remarks.append(f"{borderline_count} of {len(explanations.failures)} failures analysed are borderline: "
                       f"fewer than {100 * MIN_ROBUST_SHARE:.0f} % of their neighbours are unsafe too.")
    if not published:
        remarks.append("There are no published values of the original vehicle to compare the study with.")
    return TrustSection(GENERAL_LIMITS, remarks, published, describe_agreement(data).rows, _simulate_spreads(data))


def _simulate_spreads(data: ReportInput) -> list[tuple[str, float, ModelSpread]]:
    """The original vehicle and the first solutions, simulated with the study's other parameter sets; empty without such sets."""
    case = data.case
    if not case.study.spread or data.system is None:
        return []
    handles = list(dict.fromkeys(map(data.select_handle, FIRST_CHOICES))) if any(data.unsafe_solutions) else []
    settings = [case.characteristics.original, *map(data.setting_of, handles)]

    def compute() -> list[dict[str, Any]]:
        return [spread.to_dict() for spread in compute_model_spreads(case.study, np.stack(settings), data.point)]

    spreads = msgspec.convert(load_or_compute(data, "spread", compute), list[ModelSpread])
    degrees = [case.original[SAFETY_DEGREE], *(data.solutions[handle]["f_safe"] for handle in handles)]
    return list(zip(("original vehicle", *handles), degrees, spreads, strict=True))
