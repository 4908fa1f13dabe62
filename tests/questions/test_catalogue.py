"""Characteristics as a supplier and a workshop know them: their names, how they are measured, and
what is done with a vehicle beyond a limit.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from safevar_sumo.questions.catalogue import list_models
from safevar_sumo.results.manifest import evaluation_keys
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.study import tables_of
from safevar_sumo.vehicles import CharacteristicSet
from tests.in_process import json_of, refused, run

TEXTS = {
    "short_name": "towed load",
    "measurement": "weighbridge",
    "remedy": "leave the trailer behind",
}
OWN = {
    "extends": "native",
    "name": "own",
    "vehicle": {
        "characteristics": {
            "mass": {"meaning": "mass, all of it", **TEXTS},
            "tau": {"measurement": "", "remedy": "", "meaning": ""},
        }
    },
}


@pytest.mark.parametrize(
    ("study", "name", "short_name"),
    [
        ("wear", "sensorLatency", "perception latency"),
        ("wear", "brakeResponse", "brake actuator delay"),
        ("wear", "payloadCentre", "longitudinal position of the payload"),
        ("native", "decel", "maximum deceleration"),
        ("sun", "dampRateZeroT_CE", "engine drag, closed throttle, clutch engaged"),
    ],
)
def test_a_characteristic_has_the_name_that_a_supplier_understands(
    study: str, name: str, short_name: str
) -> None:
    names = {item.name: item.short_name for item in CharacteristicSet.of(read_study(study))}
    assert names[name] == short_name


def test_the_texts_of_a_study_name_its_characteristics_and_affect_no_evaluation() -> None:
    study = read_study(OWN)
    items = {item.name: item for item in CharacteristicSet.of(study)}
    mass = items["mass"]
    assert {key: getattr(mass, key) for key in TEXTS} == TEXTS
    assert items["tau"].short_name == "tau", "without any text it has its key as name"
    native = tables_of(read_study({"extends": "native", "name": "own"}))
    assert evaluation_keys(tables_of(study)) == evaluation_keys(native)


def test_a_list_of_characteristics_says_how_they_are_measured_and_what_to_do(
    tmp_path: Path,
) -> None:
    answer = json_of("list", "characteristics", "sensing")
    rows = {row["name"]: row for row in answer["tables"]["characteristics"]["rows"]}
    domains = read_study("sensing").vehicle.characteristics
    assert [*rows] == [*domains]
    for name, row in rows.items():
        for key in ("unit", "original", "lower", "upper", "measurement", "remedy"):
            assert row[key] == getattr(domains[name], key)
    printed = " ".join(run("list", "characteristics", "sensing").stdout.split())
    assert (
        f"treadDepth: {domains['treadDepth'].measurement}; beyond its limit:"
        f" {domains['treadDepth'].remedy} " in printed
    )
    file = tmp_path / "own.toml"
    file.write_text(
        'extends = "native"\nname = "own"\n[vehicle.characteristics]\n'
        'mass.remedy = "unload"\nmass.measurement = ""\n'
    )
    (mass,) = [
        row
        for row in list_models("characteristics", str(file)).table().to_dict("records")
        if row["name"] == "mass"
    ]
    assert mass["workshop"] == "beyond its limit: unload"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("characteristics",), ("study: no study", "list characteristics wear")),
        (("characteristics", "waer"), ("waer", "wear")),
        (("studies", "wear"), ("study: studies of 'wear'", "after characteristics alone")),
        (("characteristcs",), ("did you mean 'characteristics'?",)),
    ],
)
def test_a_list_that_there_is_not_is_refused(
    arguments: tuple[str, ...], message: tuple[str, ...]
) -> None:
    refused("list", *arguments, message=message)
