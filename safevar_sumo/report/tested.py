"""What was tested: vehicle, driving system, scenario, weather, search and versions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from safevar_sumo.ads import ADS
from safevar_sumo.analysis.case import ALGORITHM_TITLES
from safevar_sumo.answers import number_of
from safevar_sumo.report.material import Material
from safevar_sumo.scenarios import SCENARIOS, Point, tags
from safevar_sumo.showing.comparison import number, raised
from safevar_sumo.simulation import vehicle_remarks
from safevar_sumo.vehicles import VEHICLES


def tested(material: Material) -> dict[str, Any]:
    """Two sentences, and the characteristics that were varied."""
    case, study = material.case, material.case.study
    return {
        "who": f"Vehicle: {_described(VEHICLES, study.vehicle.model) or study.vehicle.model} "
               f"({number_of(len(case.characteristics), 'varied characteristic')}). Driving system: {_named(ADS, study.ads.model)}. "
               f"Scenario: {_named(SCENARIOS, study.scenario.model)}; {_where(material)}.",
        "tags": "" if material.system is None else tags(material.system.points),
        "how": _how(material),
        "characteristics": [
            {"name": one.name, "unit": "" if one.unit == "-" else raised(one.unit), "original": number(one.original),
             "lower": number(one.lower), "upper": number(one.upper), "threshold": number(one.threshold),
             "words": one.words} for one in case.characteristics],
        "remarks": [*case.remarks, *([material.lacking] if material.lacking else []),
                    *(vehicle_remarks(material.system) if material.system else [])]}


def _where(material: Material) -> str:
    """The weather, or how many points a matrix has, and in which weathers."""
    points = () if material.system is None else material.system.matrix
    if material.point:
        return f"at the point {material.point} of its matrix alone, at which all that was found is simulated again"
    if not points:
        return f"weather: {material.case.weather.name}"
    return f"every vehicle at all {len(points)} points of a matrix: {', '.join(_tests(points))}"


def _tests(points: Sequence[Point]) -> list[str]:
    """Every test of a matrix with the number of its points and their weathers."""
    of_test: dict[str, list[str]] = {}
    for point in points:
        of_test.setdefault(str(dict(point.place)["test"]), []).append(point.weather.name)
    return [f"{test} ({len(weathers)}, {' and '.join(dict.fromkeys(weathers))})" for test, weathers in of_test.items()]


def _how(material: Material) -> str:
    case, search = material.case, material.case.study.search
    versions = ", ".join(f"{name} {value}" for name, value in material.manifest["versions"].items())
    if not case.has_runs:
        return f"Its {len(case.solutions)} solutions were found elsewhere and imported ({versions})."
    runs = Counter(algorithm for algorithm, _ in case.finished)
    who = ", ".join(f"{ALGORITHM_TITLES.get(name, name)} ({number_of(count, 'run')})" for name, count in runs.items()) or "no finished run"
    return (f"Searched by {who} of at most {search.evaluations} simulations each, {len(case.evaluations)} different vehicles in all, "
            f"from seed {search.seed}, with {versions}.")


def _named(models: Mapping[str, Any], name: str) -> str:
    return f"{name} ({told})" if (told := _described(models, name)) else name


def _described(models: Mapping[str, Any], name: str) -> str:
    """The first sentence of a model's description, nothing for one that comes from outside."""
    if name not in models:
        return ""
    sentence = (models[name].__doc__ or "").strip().partition("\n")[0].rstrip(".")
    return sentence[:1].lower() + sentence[1:] if not sentence[1:2].isupper() else sentence
