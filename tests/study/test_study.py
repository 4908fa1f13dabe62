"""Study files are read strictly, limits too: every error names file, key, value and the expected
values; and the shipped JSON schema, as an editor uses it.
"""

from __future__ import annotations

import json
import pickle
import tomllib
import warnings
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.results.identity import evaluation_keys
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.shipped import STUDIES, STUDY_SCHEMA
from safevar_sumo.study import (
    Limit,
    Origin,
    Study,
    limits_of,
    study_names,
    tables_of,
    write_study,
)
from safevar_sumo.sumo.system import assemble
from tests.support.in_process import write
from tools.study_schema import schema_text

VALIDATOR = jsonschema.Draft7Validator(json.loads(STUDY_SCHEMA.read_text()))


def is_accepted(text: str) -> bool:
    """An editor has no number that is not one: it becomes null."""
    return VALIDATOR.is_valid(
        msgspec.json.decode(msgspec.json.encode(tomllib.loads(text)))
    )


def with_remarks(study: str, **changes: Any) -> tuple[Study, list[str]]:
    """A study, and what reading it warns of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        return read_study(study, **changes), [str(one.message) for one in caught]


@pytest.mark.parametrize(
    ("text", "inherits"),
    [
        ('weather = "fog"', False),
        ('[ads]\nmodel = "krauss"', False),
        ("[ads.parameters]\nlatency = 0.1", True),
        ('[scenario.parameters]\nnetwork = "my_town"', False),
        ('[[matrix.tests]]\nname = "late"\n', False),
        ("[scenario.parameters]\nduration = 5.0", True),
        ("[search]\nruns = 3", True),
        ('[ads]\nmodel = "world_on_rails"', True),
    ],
)
def test_another_system_inherits_neither_title_nor_published_values(
    text: str, inherits: bool, tmp_path: Path
) -> None:
    (tmp_path / "mine.toml").write_text(f'extends = "sun"\n{text}\n')
    study, remarks = with_remarks(str(tmp_path / "mine.toml"))
    sun = read_study("sun")
    assert study.name == "mine", "a study without a name is called as its file"
    assert (study.title == sun.title) == inherits
    assert (study.published == sun.published) == inherits
    assert bool(remarks) != inherits
    assert all(": has a different " in remark for remark in remarks)


def test_an_axis_of_all_tests_that_no_test_takes_is_named(in_tmp: Path) -> None:
    shared = "[scenario.over]\nspeed = { at = [20, 35], upper = 45 }\n"
    write("mine.toml", f'extends = "wear"\n{shared}')
    _, remarks = with_remarks("mine.toml")
    assert remarks == [
        "scenario.over.speed has no effect: each test has an axis of this name"
    ]
    write("mine.toml", f'extends = "wear"\n{shared}[[matrix.tests]]\nname = "one"\n')
    _, remarks = with_remarks("mine.toml")
    assert not [text for text in remarks if "no effect" in text]


def test_a_study_without_a_title_is_called_as_itself_and_never_as_the_study_that_it_extends(
    in_tmp: Path,
) -> None:
    write("mine.toml", 'extends = "sun"\n[ads]\nmodel = "krauss"\n')
    write("metric.toml", 'extends = "mine.toml"\nname = "own"\n')
    write("rash.toml", 'extends = "metric.toml"\n')
    write("headed.toml", 'extends = "metric.toml"\ntitle = "A heading"\n')
    write("heir.toml", 'extends = "headed.toml"\n')
    titles = [
        read_study(f"{name}.toml").title
        for name in ("mine", "metric", "rash", "headed", "heir")
    ]
    assert titles == ["mine", "own", "rash", "A heading", "A heading"]


def test_the_shipped_schema_is_that_of_the_code_and_refuses_mistakes_of_form() -> None:
    assert schema_text() == STUDY_SCHEMA.read_text(encoding="utf-8")
    VALIDATOR.check_schema(VALIDATOR.schema)
    for text in (
        "evaluatons = 5",
        '[search]\nruns = "x"',
        "[search]\nruns = 0",
        "[repair.brake_gap]\nlow = 1",
    ):
        assert not is_accepted(text), text


@pytest.mark.parametrize("name", study_names())
def test_a_shipped_study_names_the_schema_which_accepts_it_and_all_that_it_extends(
    name: str, tmp_path
) -> None:  # type: ignore[no-untyped-def]
    text = (STUDIES / f"{name}.toml").read_text()
    assert text.startswith(f"#:schema ./{STUDY_SCHEMA.name}\n")
    assert is_accepted(text)
    write_study(tmp_path / "whole.toml", read_study(name), "")
    whole = (tmp_path / "whole.toml").read_text()
    assert whole.startswith(f"#:schema {STUDY_SCHEMA}\n")
    assert is_accepted(whole)


ROWS = read_study("native").vehicle.characteristics


def test_a_text_replaces_a_limit_of_the_study_and_names_follow_the_study() -> None:
    stated = {
        "decel": Limit(at_least=5, source="workshop"),
        "mass": Limit(at_most=1900),
    }
    texts = ["decel >= 6.5", "actuatorLag<=.3", " mass >= 1.4e3", "mass <= 1800"]
    limits = limits_of(texts, ROWS, stated)
    assert list(limits) == ["mass", "decel", "actuatorLag"]
    assert limits["decel"] == Limit(at_least=6.5)
    assert limits["decel"].interval(ROWS["decel"]) == (6.5, 9.5)
    assert limits["actuatorLag"].interval(ROWS["actuatorLag"]) == (0.1, 0.3)
    assert limits["mass"].interval(ROWS["mass"]) == (1400, 1800)
    assert limits_of([], ROWS, stated) == {
        "mass": stated["mass"],
        "decel": stated["decel"],
    }


@pytest.mark.parametrize("name", study_names())
def test_a_study_that_another_process_received_has_the_same_tables(name: str) -> None:
    study = read_study(
        name,
        variation={
            next(iter(read_study(name).domains)): {"distribution": "triangular"}
        },
    )
    assert json.loads(json.dumps(tables_of(study))) == tables_of(study)
    assert tables_of(pickle.loads(pickle.dumps(study))) == tables_of(study)
    assert read_study(tables_of(study)) == msgspec.structs.replace(
        study, origin=Origin()
    )


def test_limits_change_no_result_and_a_study_without_them_keeps_its_tables() -> None:
    study = read_study(
        "native", limits={"decel": {"at_least": 6, "source": "workshop manual"}}
    )
    assert evaluation_keys(tables_of(study)) == evaluation_keys(
        tables_of(read_study("native"))
    )
    assert "limits" not in tables_of(read_study("native"))
    assert read_study(tables_of(study)).limits == study.limits


def test_what_was_not_measured_changes_no_result_and_is_not_inherited(
    in_tmp: Path,
) -> None:
    stated = {"decel": {"value": 8, "source": "assumption"}, "mass": 1600}
    study = read_study("native", unmeasured=stated)
    assert study.unmeasured_values == {"decel": 8, "mass": 1600}
    assert evaluation_keys(tables_of(study)) == evaluation_keys(
        tables_of(read_study("native"))
    )
    assert read_study(tables_of(study)).unmeasured == study.unmeasured
    write_study(in_tmp / "mine.toml", study, "")
    assert read_study("mine.toml").unmeasured == study.unmeasured
    assert not read_study({"extends": "mine.toml", "name": "heir"}).unmeasured
    assert all(one.source for one in read_study("wear").unmeasured.values())  # type: ignore[union-attr]


CRASH = {
    "name": "crash",
    "model": "car_to_car",
    "parameters": {"vut_length": 4.7, "vut_width": 1.85, "test": "CCRs"},
}


def test_what_is_about_tests_that_a_study_replaces_ends_with_them() -> None:
    """Constraints that name them or their axes, axes of other models, distributions and ranges."""
    crash = {"tests": [{**CRASH, "over": {"speed": [20, 40]}}]}
    assert read_study("alks", matrix=crash).constraints == []
    assert read_study("alks", matrix={"tests": []}, weather="clear").constraints == []
    cut_out = next(
        test for test in tables_of(read_study("alks"))["matrix"]["tests"][1:]
    )
    (kept,) = read_study(
        "alks", matrix={"tests": [cut_out, *crash["tests"]]}
    ).constraints
    assert kept.tests == ["cut_out"]

    varied = {
        "walking_speed": {"distribution": "normal", "mean": 1.8, "deviation": 0.2}
    }
    base = tables_of(read_study("sun", encounters="ranges", variation=varied))
    heir = read_study({"extends": "sun", "name": "heir", "variation": {}}, matrix=crash)
    assert {*heir.scenario.over} == {"road_friction", "recognition_delay"}
    assert read_study(base, matrix=crash).variation == {}
    with pytest.raises(InputError, match="variation"):
        read_study("sun", matrix=crash, variation=5)


@pytest.mark.parametrize("scenario", [{"model": "mine:Deer"}, {"model": "along"}])
def test_a_study_of_another_scenario_does_not_inherit_a_matrix_and_says_so(
    scenario: dict[str, str], in_tmp: Path
) -> None:
    ((key, value),) = scenario.items()
    write("mine.toml", f'extends = "wear"\n[scenario]\n{key} = "{value}"\n')
    study, remarks = with_remarks("mine.toml")
    assert study.matrix is None
    text = "mine.toml: has a different scenario than 'wear', so not its [matrix]"
    assert remarks == [f"{text}, vut_length of [scenario], vut_width of [scenario]"]
    own, _ = with_remarks(
        "wear", scenario=scenario, matrix={"tests": [{"name": "own"}]}
    )
    assert [test.name for test in own.matrix.tests] == ["own"]
    same, remarks = with_remarks(
        "wear", scenario={"model": "crossing", "parameters": {"speed": 30}}
    )
    assert (same.matrix, remarks) == (read_study("wear").matrix, [])


def test_a_value_counts_in_tests_and_a_range_of_the_same_parameter_in_its_place() -> (
    None
):
    over = {
        "impact_location": {
            "original": 50,
            "lower": 20,
            "upper": 80,
            "short_name": "place",
        }
    }
    scenario = {
        "model": "crossing",
        "parameters": {"impact_location": 25},
        "over": over,
    }
    for encounters, place in ("tests", 25), ("ranges", 50):
        study = read_study(
            "wear", encounters=encounters, scenario=scenario, matrix={"tests": []}
        )
        assert assemble(study).points[0].scenario.impact_location == place


@pytest.mark.parametrize("encounters", ["tests", "ranges"])
def test_the_worn_car_has_one_size_in_all_tests_of_un_r157(encounters: str) -> None:
    for point in assemble(read_study("alks", encounters=encounters)).points:
        assert (point.scenario.vut_length, point.scenario.vut_width) == (4.7, 1.85)


def test_a_study_of_another_driving_system_says_all_that_it_does_not_inherit() -> None:
    study, remarks = with_remarks("wear", ads={"model": "krauss"})
    assert study.spread == {}
    assert not read_study("sun", ads={"model": "full_braking"}).model_error
    assert len(remarks) == 1
    assert remarks[0].endswith("has a different ADS than 'wear', so not its [spread]")
    assert with_remarks("wear_rss")[1] == [], (
        "a shipped study leaves keys out on purpose"
    )
