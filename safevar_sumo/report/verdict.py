"""The sections about the tested system, the verdict, and how far to trust it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from safevar_sumo.ads import ADS
from safevar_sumo.analysis.explain.necessity import BORDERLINE, is_borderline
from safevar_sumo.analysis.explain.result import REASONS, ROBUST
from safevar_sumo.analysis.model_spread import model_spreads
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES, collided
from safevar_sumo.analysis.words import number_of
from safevar_sumo.metrics import METRICS, Unsafe
from safevar_sumo.records import KMH_PER_MS, FloatArray, Outcome
from safevar_sumo.reference import Totals, quoted
from safevar_sumo.replay.comparison import number, raised
from safevar_sumo.report.findings import FIRST, Failures, handle_of
from safevar_sumo.report.input import ReportInput, stored_answer
from safevar_sumo.results import SolutionId, chosen_handle
from safevar_sumo.scenarios import SCENARIOS, Point, tags
from safevar_sumo.study import SAFETY_DEGREE
from safevar_sumo.sumo.matrix import vehicle_remarks
from safevar_sumo.vehicles import VEHICLES


def tested(data: ReportInput) -> dict[str, Any]:
    """What was tested: sentences, and the varied characteristics."""
    case, study = data.case, data.case.study
    return {
        "subject": f"Vehicle: {_described(VEHICLES, study.vehicle.model) or study.vehicle.model} "
                   f"({number_of(len(case.characteristics), 'varied characteristic')}). Driving system: {_named(ADS, study.ads.model)}. "
                   f"Scenario: {_named(SCENARIOS, study.scenario.model)}; {_where(data)}.",
        "tags": "" if data.system is None else tags(data.system.points),
        "search": _search(data),
        "characteristics": [
            {"name": member.name, "unit": "" if member.unit == "-" else raised(member.unit), "original": number(member.original),
             "lower": number(member.lower), "upper": number(member.upper), "threshold": number(member.threshold),
             "words": member.words} for member in case.characteristics],
        "remarks": [*case.remarks, *([data.problem] if data.problem else []),
                    *(vehicle_remarks(data.system) if data.system else [])]}


def _where(data: ReportInput) -> str:
    """The weather, or the points of the matrix by test."""
    points = () if data.system is None else data.system.matrix
    if data.point:
        return f"only at the point {data.point} of its matrix, at which all solutions are simulated again"
    if not points:
        return f"weather: {data.case.weather.name}"
    return f"every vehicle at all {len(points)} points of a matrix: {', '.join(_tests(points))}"


def _tests(points: Sequence[Point]) -> list[str]:
    """Every test of a matrix with the number of its points and their weathers."""
    of_test: dict[str, list[str]] = {}
    for point in points:
        of_test.setdefault(str(dict(point.place)["test"]), []).append(point.weather.name)
    return [f"{test} ({len(weathers)}, {' and '.join(dict.fromkeys(weathers))})" for test, weathers in of_test.items()]


def _search(data: ReportInput) -> str:
    case, search = data.case, data.case.study.search
    versions = ", ".join(f"{name} {value}" for name, value in data.manifest["versions"].items())
    if not case.has_runs:
        return f"Its {len(case.solutions)} solutions are imported ({versions})."
    runs = Counter(algorithm for algorithm, _ in case.finished)
    names = [f"{ALGORITHM_TITLES.get(name, name)} ({number_of(count, 'run')})" for name, count in runs.items()]
    return (f"Searched by {', '.join(names) or 'no finished run'} of at most {search.evaluations} simulations each, "
            f"{len(case.evaluations)} different vehicles in all, from seed {search.seed}, with {versions}.")


def _named(models: Mapping[str, Any], name: str) -> str:
    return f"{name} ({description})" if (description := _described(models, name)) else name


def _described(models: Mapping[str, Any], name: str) -> str:
    """The first sentence of a model's description; empty for user code."""
    if name not in models:
        return ""
    sentence = (models[name].__doc__ or "").strip().partition("\n")[0].rstrip(".")
    return sentence[:1].lower() + sentence[1:] if not sentence[1:2].isupper() else sentence


TITLES = {ROBUST: "Smallest robust failure", REASONS["fewest"]: "Fewest changes", REASONS["smallest"]: "Smallest changes",
          REASONS["most_severe"]: "Most severe"}
UNKNOWN = "–"  # noqa: RUF001


def verdict(data: ReportInput, failures: Failures | None, tolerance: Mapping[str, Any] | None) -> dict[str, Any]:
    """The original's outcome, and the selected failures, the smallest robust failure first.

    All values of a failure are its solution's, not scaled back.
    """
    case = data.case
    unsafe = case.solutions[case.unsafe.rows(case.solutions)]
    any_collision = bool(collided(case.solutions).any())
    result: dict[str, Any] = {"unsafe": len(unsafe), "solutions": len(case.solutions), "rule": _rule(case.unsafe), "findings": [],
                              "original": _original(data), "any_collision": any_collision, "figures": [],
                              "agreement": agreement_with_published(data)}
    if unsafe.empty and case.solutions.empty:
        result["headline"] = "No solution was found."
        return result
    result["findings"] = _findings(data, failures or [], any_unsafe=not unsafe.empty)
    result["headline"] = _headline(result, data, failures)
    result["figures"] = _figures(result, data, failures or [], tolerance)
    return result


def _rule(unsafe: Unsafe) -> str:
    if unsafe.below is None:
        return "a collision"
    return f"a safety degree below {unsafe.below:.2f} m, half of the original's (no solution collides)"


def _original(data: ReportInput) -> str:
    if data.system is None:
        return f"The original vehicle's safety degree is {data.case.original[SAFETY_DEGREE]:.2f} m."
    return f"The original vehicle {data.compared(data.case.characteristics.original).verdict(0)}."


def _findings(data: ReportInput, failures: Failures, *, any_unsafe: bool) -> list[dict[str, Any]]:
    """The selected failures with the reasons for their selection; without explanations, selected only among the solutions."""
    reasons: dict[str, list[str]] = {}
    shares: dict[str, float] = {}
    for failure in failures:
        for reason in failure.get("reasons", []):
            if reason in TITLES and handle_of(failure):
                reasons.setdefault(handle_of(failure), []).append(reason)
                shares[handle_of(failure)] = failure["robustness"]
    if not reasons:
        for choice in REASONS if any_unsafe else ("most_severe",):
            handle = chosen_handle(data.case.solutions, data.case.unsafe, choice, data.directory)
            reasons.setdefault(str(handle), []).append(REASONS[choice])
    order = list(TITLES)
    needed = {handle_of(failure): len(failure["minimal_causes"][0]["changes"]) for failure in failures if failure.get("minimal_causes")}
    chosen = sorted(reasons.items(), key=lambda item: min(order.index(reason) for reason in item[1]))
    return [{**_finding(data, handle, why, shares.get(handle)), "needed": needed.get(handle)} for handle, why in chosen]


def _finding(data: ReportInput, handle: str, reasons: list[str], share: float | None) -> dict[str, Any]:
    setting = data.setting_of(SolutionId.parse(handle))
    changes = data.changes(setting)
    largest = float(data.case.characteristics.largest_change(setting[np.newaxis])[0])
    titles = [TITLES[reason] for reason in TITLES if reason in reasons]
    return {"title": "; ".join([titles[0], *(title.lower() for title in titles[1:])]), "handle": handle, "reasons": reasons,
            "anchor": data.anchor("replay", handle), "changes": changes, "end": _end(data, handle, setting),
            "where": data.where(setting), "share": share, "borderline": share is not None and is_borderline(share),
            "size": f"{len(changes)} of {len(setting)} characteristics changed, by at most {largest:.0%}",
            "short": f"{number_of(len(changes), 'change')} of at most {largest:.0%}", "f_safe": data.solutions[handle]["f_safe"]}


def _end(data: ReportInput, handle: str, setting: FloatArray) -> str:
    if data.system is None:
        return f"safety degree {data.solutions[handle]['f_safe']:.2f}"
    comparison = data.compared(setting)
    return comparison.verdict(comparison.rows[-1])


def _headline(result: Mapping[str, Any], data: ReportInput, failures: Failures | None) -> str:
    if not result["unsafe"]:
        return f"None of {result['solutions']} solutions is unsafe; the nearest miss is shown below."
    if data.original_fails:
        return "No change is needed: the original vehicle itself collides."
    first = result["findings"][0]
    if first["needed"] == 0:
        return "No change is needed: the original vehicle itself is unsafe."
    outcome = "a collision" if result["any_collision"] else "an unsafe outcome"
    robust = f"{outcome} that is robust" if ROBUST in first["reasons"] else outcome
    borderline = "Every failure analysed is borderline. The one with the fewest changes: " if failures and robust == outcome else ""
    now = "simulated with the present files and versions, " if data.changed else ""
    return f"{borderline}{_changes_lead_to(first, robust)}: {now}the vehicle {first['end']}."


def _changes_lead_to(finding: Mapping[str, Any], outcome: str) -> str:
    """Such as `10 changes lead to a collision (3 of them suffice)`; only for an explained failure is it known how many suffice."""
    number, needed = len(finding["changes"]), finding["needed"]
    if number == needed:
        return f"{number_of(number, 'change')} suffice{'s' if number == 1 else ''} for {outcome}"
    some = "" if needed is None else f" ({needed} of them suffice{'s' if needed == 1 else ''} to be unsafe)"
    return f"{number_of(number, 'change')} lead{'s' if number == 1 else ''} to {outcome}{some}"


def _figures(result: Mapping[str, Any], data: ReportInput, failures: Failures,
             tolerance: Mapping[str, Any] | None) -> list[dict[str, str]]:
    """The four key figures, each a title, a value and a note."""
    by_reason = {reason: finding for finding in result["findings"] for reason in finding["reasons"]}
    preventable = next((one["summary"].get("preventable") for one in failures if "summary" in one), None)
    return [_smallest(by_reason.get(ROBUST), failures, result), _severity(by_reason.get(REASONS["most_severe"]), data),
            _avoided(preventable, result), _together(tolerance)]


def _smallest(robust: Mapping[str, Any] | None, failures: Failures, result: Mapping[str, Any]) -> dict[str, str]:
    title = TITLES[ROBUST]
    if robust is None:
        reason = "every failure analysed is borderline" if failures else "not computed"
        note = reason if result["unsafe"] else "no solution is unsafe"
        return {"title": title, "value": UNKNOWN, "note": note}
    return {"title": title, "value": robust["short"], "note": f"{robust['share']:.0%} of its neighbours are unsafe too"}


def _severity(worst: Mapping[str, Any] | None, data: ReportInput) -> dict[str, str]:
    degree = float(data.case.solutions["f_safe"].min()) if worst is None else worst["f_safe"]
    if degree < 0:
        return {"title": "Most severe", "value": f"collision at {-degree:.1f} m/s", "note": f"{-KMH_PER_MS * degree:.0f} km/h"}
    return {"title": "Most severe", "value": f"{degree:.2f} m to spare", "note": "no collision among the solutions"}


def _avoided(preventable: Mapping[str, Any] | None, result: Mapping[str, Any]) -> dict[str, str]:
    title = "A competent driver avoids"
    if preventable is None or preventable["competent_driver"] is None:
        return {"title": title, "value": UNKNOWN, "note": "not computed" if result["any_collision"] else "there is no collision to avoid"}
    low, high = preventable["interval_competent_driver"]
    sampled = "all" if low == high else f"95 % interval {low:.0%} to {high:.0%};"
    note = f"in the same vehicle ({sampled} {preventable['looked_at']} collisions analysed)"
    return {"title": title, "value": f"{preventable['competent_driver']:.0%} of the collisions", "note": note}


def _together(tolerance: Mapping[str, Any] | None) -> dict[str, str]:
    title = "All characteristics together may go"
    if tolerance is None:
        return {"title": title, "value": UNKNOWN, "note": "not computed"}
    factor, samples = tolerance["joint"]["factor"], tolerance["joint"]["samples"]
    if not factor:
        return {"title": title, "value": "nowhere", "note": "no box around the original is safe"}
    return {"title": title, "value": f"{factor:.1%} of the way",
            "note": f"from the original to the ends of their domains; none of {samples} vehicles sampled there is unsafe"}


def agreement_with_published(data: ReportInput) -> dict[str, Any]:
    """How well the study agrees with published data: a sentence, and the rows of a table; no rows without such data."""
    totals = quoted(data.case.study)
    if not totals:
        return {"sentence": "This study was not compared with published data: how far another simulator or a real vehicle does the same "
                            "is unknown.", "rows": []}
    first = max(totals, key=lambda one: (one.reference, one.rows))
    shares = "no published collision is among them" if first.recall is None else (
        f"{first.both} of the {first.reference} published collisions collide here too (recall {first.recall:.2f})")
    if first.precision is not None:
        shares += f", and {first.both} of the {first.here} collisions here are published ones (precision {first.precision:.2f})"
    rho = first.spearman.get(SAFETY_DEGREE)
    order = "" if rho is None else f" safety degrees are in the same order with a rank correlation of {rho:.2f} (1 is perfect);"
    return {"sentence": f"Agreement with published data, {first.rows} vehicles simulated again:{order} {shares}.",
            "rows": [_row(one) for one in totals]}


def _row(totals: Totals) -> dict[str, str]:
    def decimal(value: float | None) -> str:
        return UNKNOWN if value is None else f"{value:.2f}"

    return {"file": totals.file, "vehicles": str(totals.rows), "rho": decimal(totals.spearman.get(SAFETY_DEGREE)),
            "error": decimal(totals.mean_absolute_error.get(SAFETY_DEGREE)), "reference": str(totals.reference), "here": str(totals.here),
            "both": str(totals.both), "recall": decimal(totals.recall), "precision": decimal(totals.precision)}


NOT_MODELLED = (
    "A search that finds no failure proves nothing about the settings that it did not try.",
    "One vehicle in its lane: no steering beyond lane keeping, no separate wheels and axles, no suspension, no wind, no sensor "
    "noise, no traffic beyond the scenario's own, unless the study says otherwise.",
    "Driving system and vehicle are models: the tables below show how far they agree with published data, where there is any.",
)


def trust(data: ReportInput, failures: Failures | None) -> dict[str, Any]:
    """The limits of one study's findings, and its agreement with published data."""
    case = data.case
    rows = [{"name": name, "published": case.study.published[name], "here": case.original[name]}
            for name in METRICS if name in case.study.published and not math.isnan(case.original[name])]
    remarks = []
    failed = int((case.evaluations["outcome"] == str(Outcome.SIMULATOR_ERROR)).sum())
    if failed:
        remarks.append(f"{failed} of {len(case.evaluations)} settings could not be simulated; no result contains them.")
    invalid = int((case.evaluations["outcome"] == str(Outcome.INVALID_TEST)).sum())
    if invalid:
        remarks.append(f"{invalid} of {len(case.evaluations)} settings left the tolerance of a test's speed before the driving system "
                       "acted: they are neither failures nor successes.")
    if failures:
        shares = [failure["robustness"] for failure in failures if failure.get("robustness") is not None]
        if shares:
            fragile = sum(map(is_borderline, shares))
            remarks.append(f"{fragile} of {len(shares)} failures analysed are borderline: "
                        f"fewer than {BORDERLINE:.0%} of their neighbours are unsafe too.")
    if not rows:
        remarks.append("There are no published values of the original vehicle to compare the study with.")
    return {"published": rows, "remarks": remarks, "general": NOT_MODELLED, "agreement": agreement_with_published(data)["rows"],
            "spread": own_uncertainty(data)}


def own_uncertainty(data: ReportInput) -> list[dict[str, Any]]:
    """Results of the original vehicle and of the first solutions with the study's other parameter sets; empty without such sets."""
    case = data.case
    if not case.study.spread or data.system is None:
        return []
    unsafe = not case.solutions.empty and case.unsafe.rows(case.solutions).any()
    chosen = [str(chosen_handle(case.solutions, case.unsafe, choice, data.directory)) for choice in FIRST] if unsafe else []
    handles = list(dict.fromkeys(chosen))
    settings = [case.characteristics.original, *(data.setting_of(SolutionId.parse(handle)) for handle in handles)]

    def compute() -> list[dict[str, Any]]:
        return [one.to_dict() for one in model_spreads(case.study, np.stack(settings), data.point)]

    here = [case.original[SAFETY_DEGREE], *(data.solutions[handle]["f_safe"] for handle in handles)]
    return [{"name": name, "here": value, **one} for name, value, one in zip(
        ("original vehicle", *handles), here, stored_answer(data, "spread", compute), strict=True)]
