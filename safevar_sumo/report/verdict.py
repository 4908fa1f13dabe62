"""The sections on the tested system, on the verdict, and on how far to trust the verdict."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from safevar_sumo.ads import ADS
from safevar_sumo.analysis.explain.necessity import BORDERLINE, in_words, is_borderline
from safevar_sumo.analysis.explain.result import REASONS, ROBUST, CauseEntry, FailureEntry
from safevar_sumo.analysis.model_spread import ModelSpread, model_spreads
from safevar_sumo.analysis.preventability import PreventedShares
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES, are_collisions
from safevar_sumo.analysis.words import number_of
from safevar_sumo.metrics import METRICS, Unsafe
from safevar_sumo.records import KMH_PER_MS, FloatArray, Outcome
from safevar_sumo.reference import Totals, quoted
from safevar_sumo.replay.comparison import number, raised
from safevar_sumo.report.findings import FIRST_CHOICES, Explanations
from safevar_sumo.report.input import ChangeRow, FailingPoints, ReportInput, stored_answer
from safevar_sumo.scenarios import SCENARIOS, Point, tags
from safevar_sumo.study import SAFETY_DEGREE
from safevar_sumo.sumo.matrix import vehicle_remarks
from safevar_sumo.vehicles import VEHICLES


class TestedSystem(NamedTuple):
    """What was tested: sentences, and a row of texts for each characteristic: name, unit, original, lower, upper, threshold, meaning."""

    subject: str
    tags: str
    search: str
    characteristics: list[tuple[str, ...]]
    remarks: list[str]


def tested_system(data: ReportInput) -> TestedSystem:
    """The tested vehicle, driving system and scenario, and the search."""
    case, study = data.case, data.case.study
    return TestedSystem(
        subject=f"Vehicle: {_first_sentence(VEHICLES, study.vehicle.model) or study.vehicle.model} "
                f"({number_of(len(case.characteristics), 'varied characteristic')}). "
                f"Driving system: {_name_and_sentence(ADS, study.ads.model)}. "
                f"Scenario: {_name_and_sentence(SCENARIOS, study.scenario.model)}; {_conditions(data)}.",
        tags="" if data.system is None else tags(data.system.points), search=_search(data),
        characteristics=[
            (member.name, "" if member.unit == "-" else raised(member.unit),
             *map(number, (member.original, member.lower, member.upper, member.threshold)), member.words)
            for member in case.characteristics],
        remarks=[*case.remarks, *([data.problem] if data.problem else []), *(vehicle_remarks(data.system) if data.system else [])])


def _conditions(data: ReportInput) -> str:
    """The weather, or the points of the matrix, by test."""
    points = () if data.system is None else data.system.matrix
    if data.point:
        return f"only at the point {data.point} of its matrix, at which all solutions are simulated again"
    if not points:
        return f"weather: {data.case.weather.name}"
    return f"every vehicle at all {len(points)} points of a matrix: {', '.join(_tests(points))}"


def _tests(points: Sequence[Point]) -> list[str]:
    """Each test of a matrix, with the number of points and their weathers."""
    weathers_by_test: dict[str, list[str]] = {}
    for point in points:
        weathers_by_test.setdefault(str(dict(point.place)["test"]), []).append(point.weather.name)
    return [f"{test} ({len(weathers)}, {' and '.join(dict.fromkeys(weathers))})" for test, weathers in weathers_by_test.items()]


def _search(data: ReportInput) -> str:
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


TITLES = {ROBUST: "Smallest robust failure", REASONS["fewest"]: "Fewest changes", REASONS["smallest"]: "Smallest changes",
          REASONS["most_severe"]: "Most severe"}
NO_VALUE = "–"  # noqa: RUF001


class SelectedFailure(NamedTuple):
    """A selected failure in the verdict; all values are those of the solution, not scaled back.

    `share` is the unsafe share of the failure's neighbours, `cause` its first minimal cause; None if the failure was not explained.
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
    failing: FailingPoints | None
    share: float | None
    cause: CauseEntry | None

    @property
    def needed(self) -> int | None:
        """Number of changes that suffice for the failure."""
        return None if self.cause is None else len(self.cause.changes)

    @property
    def borderline(self) -> bool:
        return self.share is not None and is_borderline(self.share)


class KeyFigure(NamedTuple):
    """A key figure of the verdict: title, value and note as texts."""

    title: str
    value: str
    note: str


class AgreementRows(NamedTuple):
    """How well a study agrees with published data: a sentence, and a row of texts for each file; without such data, no rows."""

    sentence: str
    rows: list[list[str]]


class Verdict(NamedTuple):
    """The verdict on a study; in `findings`, the smallest robust failure comes first."""

    headline: str
    unsafe: int
    solutions: int
    rule: str
    original: str
    agreement: AgreementRows
    findings: list[SelectedFailure]
    figures: list[KeyFigure]


def verdict(data: ReportInput, explanations: Explanations | None, tolerance: Mapping[str, Any] | None) -> Verdict:
    """The verdict on one study."""
    solutions = data.case.solutions
    findings = [] if solutions.empty else _findings(data, explanations)
    return Verdict(
        headline="No solution was found." if solutions.empty else _headline(data, findings, explanations),
        unsafe=sum(data.unsafe_solutions), solutions=len(solutions), rule=_rule(data.case.unsafe), original=_original(data),
        agreement=agreement_with_published(data), findings=findings,
        figures=[] if solutions.empty else _figures(data, findings, explanations, tolerance))


def _rule(unsafe: Unsafe) -> str:
    if unsafe.below is None:
        return "a collision"
    return f"a safety degree below {unsafe.below:.2f} m, half of the original's (no solution collides)"


def _original(data: ReportInput) -> str:
    if data.system is None:
        return f"The original vehicle's safety degree is {data.case.original[SAFETY_DEGREE]:.2f} m."
    return f"The original vehicle {data.compared(data.case.characteristics.original).verdict(0)}."


def _findings(data: ReportInput, explanations: Explanations | None) -> list[SelectedFailure]:
    """The failures to show, with the reasons for their selection; without explanations, they are selected among the solutions."""
    failures = {failure.handle: failure for failure in explanations.failures if failure.handle} if explanations else {}
    reasons = {handle: names for handle, failure in failures.items() if (names := [name for name in failure.reasons if name in TITLES])}
    if not reasons:
        for choice in REASONS if any(data.unsafe_solutions) else ("most_severe",):
            reasons.setdefault(data.chosen(choice), []).append(REASONS[choice])
    order = list(TITLES)
    handles = sorted(reasons, key=lambda handle: min(map(order.index, reasons[handle])))
    return [_finding(data, handle, reasons[handle], failures.get(handle)) for handle in handles]


def _finding(data: ReportInput, handle: str, reasons: list[str], failure: FailureEntry | None) -> SelectedFailure:
    setting = data.setting_of(handle)
    changes, largest_change = data.changes(setting), float(data.case.characteristics.largest_change(setting[np.newaxis])[0])
    title, *titles = [TITLES[reason] for reason in TITLES if reason in reasons]
    return SelectedFailure(
        title="; ".join([title, *map(str.lower, titles)]), handle=handle, reasons=reasons, anchor=data.anchor("replay", handle),
        changes=changes, largest_change=largest_change,
        size=f"{len(changes)} of {len(setting)} characteristics changed, by at most {largest_change:.0%}",
        end=_end(data, handle, setting), f_safe=data.solutions[handle]["f_safe"], failing=data.failing_points(setting),
        share=failure.robustness if failure else None,
        cause=failure.minimal_causes[0] if failure and failure.minimal_causes else None)


def _end(data: ReportInput, handle: str, setting: FloatArray) -> str:
    if data.system is None:
        return f"safety degree {data.solutions[handle]['f_safe']:.2f}"
    comparison = data.compared(setting)
    return comparison.verdict(comparison.rows[-1])


def _headline(data: ReportInput, findings: Sequence[SelectedFailure], explanations: Explanations | None) -> str:
    if not any(data.unsafe_solutions):
        return f"None of {len(data.case.solutions)} solutions is unsafe; the nearest miss is shown below."
    if data.original_fails:
        return "No change is needed: the original vehicle itself collides."
    first = findings[0]
    if first.needed == 0:
        return "No change is needed: the original vehicle itself is unsafe."
    outcome = "a collision" if are_collisions(data.case.solutions).any() else "an unsafe outcome"
    phrase = f"{outcome} that is robust" if ROBUST in first.reasons else outcome
    borderline = "Every failure analysed is borderline. The one with the fewest changes: " if explanations and phrase == outcome else ""
    versions = "simulated with the present files and versions, " if data.changed else ""
    return f"{borderline}{_changes_lead_to(first, phrase)}: {versions}the vehicle {first.end}."


def _changes_lead_to(finding: SelectedFailure, outcome: str) -> str:
    """A sentence such as `10 changes lead to a collision (3 of them suffice ...)`; only explanations tell how many suffice."""
    number, needed = len(finding.changes), finding.needed
    if number == needed:
        return f"{number_of(number, 'change')} suffice{'s' if number == 1 else ''} for {outcome}"
    share = finding.cause.robustness if finding.cause else None
    borderline = "" if share is None or not is_borderline(share) else f", but {in_words(share)}"
    sufficiency = "" if needed is None else f" ({needed} of them suffice{'s' if needed == 1 else ''} to be unsafe{borderline})"
    return f"{number_of(number, 'change')} lead{'s' if number == 1 else ''} to {outcome}{sufficiency}"


def _figures(data: ReportInput, findings: Sequence[SelectedFailure], explanations: Explanations | None,
             tolerance: Mapping[str, Any] | None) -> list[KeyFigure]:
    """The four key figures."""
    by_reason = {reason: finding for finding in findings for reason in finding.reasons}
    return [_smallest_robust(by_reason.get(ROBUST), explanations, data), _severity(by_reason.get(REASONS["most_severe"]), data),
            _preventability(explanations.summary.preventable if explanations else None, data), _joint_tolerance(tolerance)]


def _smallest_robust(robust: SelectedFailure | None, explanations: Explanations | None, data: ReportInput) -> KeyFigure:
    if robust is None:
        reason = "every failure analysed is borderline" if explanations else "not computed"
        return KeyFigure(TITLES[ROBUST], NO_VALUE, reason if any(data.unsafe_solutions) else "no solution is unsafe")
    return KeyFigure(TITLES[ROBUST], f"{number_of(len(robust.changes), 'change')} of at most {robust.largest_change:.0%}",
                     f"{robust.share:.0%} of its neighbours are unsafe too")


def _severity(most_severe: SelectedFailure | None, data: ReportInput) -> KeyFigure:
    degree = float(data.case.solutions["f_safe"].min()) if most_severe is None else most_severe.f_safe
    if degree < 0:
        return KeyFigure("Most severe", f"collision at {-degree:.1f} m/s", f"{-KMH_PER_MS * degree:.0f} km/h")
    return KeyFigure("Most severe", f"{degree:.2f} m to spare", "no collision among the solutions")


def _preventability(preventable: PreventedShares | None, data: ReportInput) -> KeyFigure:
    title = "A competent driver avoids"
    if preventable is None or preventable.competent_driver is None or preventable.interval_competent_driver is None:
        any_collision = are_collisions(data.case.solutions).any()
        return KeyFigure(title, NO_VALUE, "not computed" if any_collision else "there is no collision to avoid")
    low, high = preventable.interval_competent_driver
    sample = "all" if low == high else f"95 % interval {low:.0%} to {high:.0%};"
    return KeyFigure(title, f"{preventable.competent_driver:.0%} of the collisions",
                     f"in the same vehicle ({sample} {preventable.looked_at} collisions analysed)")


def _joint_tolerance(tolerance: Mapping[str, Any] | None) -> KeyFigure:
    title = "All characteristics together may go"
    if tolerance is None:
        return KeyFigure(title, NO_VALUE, "not computed")
    factor, samples = tolerance["joint"]["factor"], tolerance["joint"]["samples"]
    if not factor:
        return KeyFigure(title, "nowhere", "no box around the original is safe")
    return KeyFigure(title, f"{factor:.1%} of the way",
                     f"from the original to the ends of their domains; none of {samples} vehicles sampled there is unsafe")


def agreement_with_published(data: ReportInput) -> AgreementRows:
    """How well the study agrees with published data."""
    totals = quoted(data.case.study)
    if not totals:
        return AgreementRows("This study was not compared with published data: how far another simulator or a real vehicle does the same "
                         "is unknown.", [])
    largest = max(totals, key=lambda entry: (entry.reference, entry.rows))
    shares = "no published collision is among them" if largest.recall is None else (
        f"{largest.both} of the {largest.reference} published collisions collide here too (recall {largest.recall:.2f})")
    if largest.precision is not None:
        shares += f", and {largest.both} of the {largest.here} collisions here are published ones (precision {largest.precision:.2f})"
    rho = largest.spearman.get(SAFETY_DEGREE)
    order = "" if rho is None else f" safety degrees are in the same order with a rank correlation of {rho:.2f} (1 is perfect);"
    sentence = f"Agreement with published data, {largest.rows} vehicles simulated again:{order} {shares}."
    return AgreementRows(sentence, list(map(_row, totals)))


def _row(totals: Totals) -> list[str]:
    """A row of texts: file, vehicles, rank correlation, mean error, collisions published, here and in both, recall, precision."""
    def decimal(value: float | None) -> str:
        return NO_VALUE if value is None else f"{value:.2f}"

    degree_agreement = totals.spearman.get(SAFETY_DEGREE), totals.mean_absolute_error.get(SAFETY_DEGREE)
    return [totals.file, str(totals.rows), *map(decimal, degree_agreement), *map(str, (totals.reference, totals.here, totals.both)),
            *map(decimal, (totals.recall, totals.precision))]


GENERAL_LIMITS = (
    "A search that finds no failure proves nothing about the settings that it did not try.",
    "One vehicle in its lane: no steering beyond lane keeping, no separate wheels and axles, no suspension, no wind, no sensor "
    "noise, no traffic beyond the scenario's own, unless the study says otherwise.",
    "Driving system and vehicle are models: the tables below show how far they agree with published data, where there is any.",
)


class Trust(NamedTuple):
    """The limits of one study's findings, and its agreement with published data.

    `published` lists metrics of the original vehicle: name, published value, value here. `spread` lists vehicles: name, safety degree
    here, safety degrees with the study's other parameter sets.
    """

    general: Sequence[str]
    remarks: list[str]
    published: list[tuple[str, float, float]]
    agreement: list[list[str]]
    spread: list[tuple[str, float, ModelSpread]]


def trust(data: ReportInput, explanations: Explanations | None) -> Trust:
    """The limits of one study's findings, and its agreement with published data."""
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
                       f"fewer than {BORDERLINE:.0%} of their neighbours are unsafe too.")
    if not published:
        remarks.append("There are no published values of the original vehicle to compare the study with.")
    return Trust(GENERAL_LIMITS, remarks, published, agreement_with_published(data).rows, _spreads(data))


def _spreads(data: ReportInput) -> list[tuple[str, float, ModelSpread]]:
    """The original vehicle and the first solutions, simulated with the study's other parameter sets; empty without such sets."""
    case = data.case
    if not case.study.spread or data.system is None:
        return []
    handles = list(dict.fromkeys(map(data.chosen, FIRST_CHOICES))) if any(data.unsafe_solutions) else []
    settings = [case.characteristics.original, *map(data.setting_of, handles)]

    def compute() -> list[dict[str, Any]]:
        return [spread.to_dict() for spread in model_spreads(case.study, np.stack(settings), data.point)]

    spreads = msgspec.convert(stored_answer(data, "spread", compute), list[ModelSpread])
    degrees = [case.original[SAFETY_DEGREE], *(data.solutions[handle]["f_safe"] for handle in handles)]
    return list(zip(("original vehicle", *handles), degrees, spreads, strict=True))
