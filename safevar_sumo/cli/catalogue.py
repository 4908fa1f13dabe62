"""The commands `list`, which shows studies, models, weathers, algorithms, metrics and objectives, and `check`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import click
import msgspec
from rich.console import Console

from safevar_sumo.ads import ADS
from safevar_sumo.cli.arguments import json_option
from safevar_sumo.cli.program import commands, print_json
from safevar_sumo.metrics import METRIC_OF_OBJECTIVE, METRICS, OPTIONAL_METRICS, RATING_POINTS
from safevar_sumo.questions.words import number_of
from safevar_sumo.records import JsonObject
from safevar_sumo.scenarios import SCENARIOS, WEATHERS, equals_clear
from safevar_sumo.search import DESCRIPTIONS
from safevar_sumo.study import Study, load_study, study_names
from safevar_sumo.terminal import WholeTable, print_meanings, print_text
from safevar_sumo.vehicles import CHANGES, VEHICLES, CharacteristicSet

NAMES = {"name": "{name}", "description": "{description}"}
TABLES = {
    "studies": (
        "Studies",
        {
            "name": "{name}",
            "title": "{title}",
            "vehicle, ADS, scenario, weather": "{vehicle}, {ads}, {scenario}, {weather}",
        },
    ),
    "vehicles": (
        "Vehicle {name}",
        {"characteristic": "{name}", "unit": "{unit}"}
        | {key: f"{{{key}:g}}" for key in ("original", "lower", "upper", "threshold")},
    ),
    "ads": ("ADSs", NAMES),
    "scenarios": ("Scenarios", NAMES),
    "weathers": (
        "Weathers",
        {
            "name": "{name}",
            "friction": "{road_friction:g}",
            "visibility": "{visibility:g}",
            "recognition\ndelay, s": "{recognition_delay:g}",
            "light": "{light}",
            "wet road": "{wet}",
        },
    ),
    "algorithms": ("Algorithms", NAMES),
    "metrics": ("Metrics", NAMES),
    "objectives": ("Objectives (every metric can also be an objective)", NAMES),
}
"""Title of each section's table, and the layout of its cells by the column's head."""


@commands.command(name="list")
@click.argument("section", required=False, type=click.Choice(list(TABLES)), metavar="[SECTION]")
@json_option
def list_command(section: str | None, as_json: bool) -> None:
    """List studies, vehicles, ADSs, scenarios, weathers, algorithms, metrics and objectives; with SECTION, such as
    weathers, only these.
    """
    studies = [load_study(name) for name in study_names()]
    characteristics = {study.vehicle.model: CharacteristicSet.of(study) for study in reversed(studies)}
    catalogue = {key: rows for key, rows in _catalogue(studies, characteristics).items() if section in (None, key)}
    if as_json:
        print_json(catalogue)
        return
    console = Console()
    for key, rows in catalogue.items():
        # One table for each vehicle, one for each other section.
        owners: list[JsonObject] = rows if key == "vehicles" else [{"name": "", "characteristics": rows}]
        for owner in owners:
            title, columns = TABLES[key]
            table = WholeTable(*columns, title=title.format_map(owner))
            for row in owner["characteristics"]:
                table.add_row(*(layout.format_map(row) for layout in columns.values()))
            if table.row_count:
                console.print(table)
                print_meanings(console, characteristics.get(owner["name"], ()))
    for name in (row["name"] for row in catalogue.get("weathers", ()) if equals_clear(WEATHERS[row["name"]])):
        text = "no effect on road and sensors; an ADS drives as in clear weather unless its parameters differ."
        print_text(console, f"{name}: {text}")


def _catalogue(
    studies: Sequence[Study], characteristics: Mapping[str, CharacteristicSet]
) -> dict[str, list[JsonObject]]:
    """All that studies can name, by section; `characteristics` by vehicle."""
    keys = ("name", "unit", "original", "lower", "upper", "threshold", "meaning", "counterpart")
    objectives = {
        **{name: f"The search drives {metric.name} to unsafe values." for name, metric in METRIC_OF_OBJECTIVE.items()},
        **{change.name: f"{change.title.capitalize()} [{change.unit}]." for change in CHANGES.values()},
        RATING_POINTS.name: f"Only in studies that a protocol rates: {RATING_POINTS.description}",
    }
    descriptions: dict[str, Mapping[str, object]] = {
        "ads": ADS,
        "scenarios": SCENARIOS,
        "algorithms": DESCRIPTIONS,
        "metrics": {name: metric.description for name, metric in {**METRICS, **OPTIONAL_METRICS}.items()},
        "objectives": objectives,
    }
    sections: dict[str, list[JsonObject]] = {
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
        "vehicles": [
            {
                "name": name,
                "characteristics": [{key: getattr(row, key) for key in keys} for row in characteristics.get(name, ())],
            }
            for name in VEHICLES
        ],
        "weathers": [msgspec.to_builtins(weather) for weather in WEATHERS.values()],
        **{
            key: [
                {
                    "name": name,
                    "description": model if isinstance(model, str) else (model.__doc__ or "").partition("\n")[0],
                }
                for name, model in models.items()
            ]
            for key, models in descriptions.items()
        },
    }
    return {key: sections[key] for key in TABLES}


@commands.command(name="check")
@click.argument("subject", metavar="SUBJECT")
@json_option
def check_command(subject: str, as_json: bool) -> int:
    """Check whether your driving system, vehicle, scenario, metrics, objectives and algorithms keep the promises that
    results rest on.

    SUBJECT is the name or path of a study, all of whose code is checked, or a driving system, by its name or
    package.module:Name, which then drives in the study smoke. The exit code is 0 if SUBJECT passes, 1 with findings, 2
    if it cannot be loaded.
    """
    from safevar_sumo.plugins.check import CHECKS, check

    findings = check(subject)
    if as_json:
        rows = [finding._asdict() for finding in findings]
        print_json({"subject": subject, "passed": not findings, "findings": rows})
        return 1 if findings else 0
    console = Console()
    for finding in findings:
        print_text(console, str(finding))
        print_text(console, f"  expected: {finding.expected}")
        print_text(console, f"  advice: {CHECKS[finding.check]}")
    print_text(console, f"{subject}: {number_of(len(findings), 'finding') if findings else 'passed'}")
    return 1 if findings else 0
