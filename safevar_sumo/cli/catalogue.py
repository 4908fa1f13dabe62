"""The commands `list`, which shows studies, models, weathers, algorithms, metrics and objectives, and `check`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import click
import msgspec
from rich.console import Console

from safevar_sumo.ads import ADS
from safevar_sumo.cli.arguments import json_option
from safevar_sumo.cli.program import commands, print_json
from safevar_sumo.metrics import METRIC_OF_OBJECTIVE, METRICS, OPTIONAL_METRICS, RATING_POINTS
from safevar_sumo.records import JsonObject
from safevar_sumo.scenarios import SCENARIOS, WEATHERS, equals_clear
from safevar_sumo.search import ALGORITHMS
from safevar_sumo.study import Study, load_study, study_names
from safevar_sumo.terminal import print_meanings, print_names, print_text
from safevar_sumo.vehicles import CHANGES, VEHICLES, CharacteristicSet

SECTIONS = ("studies", "vehicles", "ads", "scenarios", "weathers", "algorithms", "metrics", "objectives")


@commands.command(name="list")
@click.argument("section", required=False, type=click.Choice(SECTIONS), metavar="[SECTION]")
@json_option
def list_command(section: str | None, as_json: bool) -> None:
    """List studies, vehicles, ADSs, scenarios, weathers, algorithms, metrics and objectives; with SECTION, such as
    weathers, only these.
    """
    studies = [load_study(name) for name in study_names()]
    if as_json:
        catalogue = _catalogue(studies)
        print_json({section: catalogue[section]} if section else catalogue)
    else:
        _print_catalogue(Console(), studies, [section] if section else SECTIONS)


def _catalogue(studies: list[Study]) -> JsonObject:
    keys = ("name", "unit", "original", "lower", "upper", "threshold", "meaning", "counterpart")
    characteristics = {
        name: [{key: getattr(characteristic, key) for key in keys} for characteristic in members]
        for name, members in _characteristics(studies).items()
    }
    return {
        "studies": [
            {
                "name": study.name,
                "title": study.title,
                "vehicle": study.vehicle.model,
                "ads": study.ads.model,
                "scenario": study.scenario.model,
                "weather": study.weather if isinstance(study.weather, str) else study.weather.name,
            }
            for study in studies
        ],
        "vehicles": [{"name": name, "characteristics": characteristics.get(name, [])} for name in VEHICLES],
        "ads": _described(ADS),
        "scenarios": _described(SCENARIOS),
        "weathers": [msgspec.to_builtins(weather) for weather in WEATHERS.values()],
        "algorithms": _described(ALGORITHMS),
        "metrics": [
            {"name": name, "description": metric.description}
            for name, metric in {**METRICS, **OPTIONAL_METRICS}.items()
        ],
        "objectives": [
            *(
                {"name": name, "description": f"The search drives {metric.name} to unsafe values."}
                for name, metric in METRIC_OF_OBJECTIVE.items()
            ),
            *(
                {"name": change.name, "description": f"{change.title.capitalize()} [{change.unit}]."}
                for change in CHANGES.values()
            ),
            {
                "name": RATING_POINTS.name,
                "description": f"Only in studies that a protocol rates: {RATING_POINTS.description}",
            },
        ],
    }


def _characteristics(studies: list[Study]) -> dict[str, CharacteristicSet]:
    """The characteristics of each vehicle, in the first study that has it."""
    return {study.vehicle.model: CharacteristicSet.of(study) for study in reversed(studies)}


def _described(models: Mapping[str, Callable[..., Any]]) -> list[dict[str, str]]:
    """The names of models, and the first lines of their docstrings."""
    return [
        {"name": name, "description": (model.__doc__ or "").strip().partition("\n")[0]}
        for name, model in models.items()
    ]


def _print_catalogue(console: Console, studies: list[Study], sections: Sequence[str]) -> None:
    catalogue = {key: rows if key in sections else [] for key, rows in _catalogue(studies).items()}

    def show(title: str, rows: Sequence[tuple[str, ...]], *heads: str) -> None:
        if rows:
            print_names(console, title, rows, heads)

    def numbers_as_text(row: JsonObject, *keys: str) -> tuple[str, ...]:
        return tuple(f"{row[key]:g}" for key in keys)

    study_rows = [(name, title, ", ".join(models)) for name, title, *models in map(dict.values, catalogue["studies"])]
    show("Studies", study_rows, "name", "title", "vehicle, ADS, scenario, weather")
    for vehicle in catalogue["vehicles"]:
        keys = ("original", "lower", "upper", "threshold")
        rows = [(row["name"], row["unit"], *numbers_as_text(row, *keys)) for row in vehicle["characteristics"]]
        show(f"Vehicle {vehicle['name']}", rows, "characteristic", "unit", *keys)
        print_meanings(console, _characteristics(studies).get(vehicle["name"], ()))
    weather_rows = [
        (
            row["name"],
            *numbers_as_text(row, "road_friction", "visibility", "recognition_delay"),
            row["light"],
            "wet" if row["wet"] else "dry",
        )
        for row in catalogue["weathers"]
    ]
    show("Weathers", weather_rows, "name", "friction", "visibility", "recognition\ndelay, s", "light", "road")
    for name, *_ in weather_rows:
        if equals_clear(WEATHERS[name]):
            print_text(
                console,
                f"{name}: no effect on road and sensors; an ADS drives as in clear weather unless its parameters "
                "differ.",
            )
    for title, key in (
        ("ADSs", "ads"),
        ("Scenarios", "scenarios"),
        ("Algorithms", "algorithms"),
        ("Metrics", "metrics"),
        ("Objectives (every metric can also be an objective)", "objectives"),
    ):
        show(title, [(row["name"], row["description"]) for row in catalogue[key]], "name", "description")


@commands.command(name="check")
@click.argument("subject", metavar="SUBJECT")
@click.option(
    "--study",
    metavar="STUDY",
    help="Study to try SUBJECT in.  [default: a study beside it that names it, else a shipped study]",
)
@json_option
def check_command(subject: str, study: str | None, as_json: bool) -> int:
    """Check whether your driving system, vehicle, scenario, metric, objective, algorithm or TraCI controller works with
    this package.

    SUBJECT is package.module:Name, the name of a shipped model, or the name or path of a study to check everything that
    it names. The exit code is 0 if SUBJECT passes, 1 with findings, 2 if it cannot be loaded.
    """
    from safevar_sumo.plugins.check import check

    report = check(subject, study)
    if as_json:
        print_json(report.to_dict())
        return 0 if report.passed else 1
    console = Console()
    for finding in report.findings:
        print_text(console, str(finding))
        print_text(console, f"  expected: {finding.expected}")
        print_text(console, f"  advice: {finding.advice}")
    if report.remark:
        print_text(console, f"note: {report.remark}")
    verdict = "passed" if report.passed else f"{len(report.findings)} finding{'s' * (len(report.findings) > 1)}"
    print_text(console, f"{subject} ({report.kind}): {verdict}, {report.seconds:.1f} s")
    return 0 if report.passed else 1
