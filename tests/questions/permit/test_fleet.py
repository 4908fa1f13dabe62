"""Lists of cars are read alike in every dialect, and refused where they could be misread."""

from __future__ import annotations

import re
import tomllib
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, strategies as st

import safevar_sumo as sv
from safevar_sumo.errors import InputError
from safevar_sumo.questions.permit.fleet import Fleet, read_fleet
from safevar_sumo.questions.permit.permits import cars_of
from safevar_sumo.questions.permit.rows import assumed_cells, assumed_sentences
from safevar_sumo.questions.sentence import Verdict
from safevar_sumo.scenarios.declared import with_ranges
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet
from tests.support.in_process import SLOW

JOINT = with_ranges(sv.load_study("wear"))
VEHICLE = CharacteristicSet.of(JOINT).vehicle
LIMIT = [{"sum": {"payload": 1, "payloadCentre": -100}, "at_most": 200, "unit": "kg"}]
BOUND = sv.load_study("wear", encounters="ranges", constraints=LIMIT)
MEASURED = ("treadDepth", "brakeTorque", "payload")
DIALECTS = [
    (separator, decimal, encoding, end)
    for separator, decimal in ((",", "."), (";", "."), (";", ","))
    for encoding, end in (("utf-8", "\n"), ("utf-8-sig", "\r\n"))
]


def read(cars: Any, *values: str, study: Study = JOINT, **options: Any) -> Fleet:
    options = {"others": None, "ignore": (), **options}
    vehicle = CharacteristicSet.of(study).vehicle
    answer = ("car", "up_to", "verdict", "because", "rough")
    return read_fleet(study, vehicle, cars, values, **options, answer_columns=answer)


def written(folder: Path, text: str | bytes) -> Path:
    path = folder / "fleet.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def are_no_thousands(value: float) -> bool:
    """Whether the text of a value has no three decimals, which may be thousands."""
    return len(repr(value).partition(".")[2]) != 3


@SLOW
@given(
    rows=st.lists(
        st.tuples(
            st.text("aä0 ,;\"'=-", min_size=1).map("a{}".format).map(str.strip),
            st.floats(1.6, 8.0).filter(are_no_thousands),
            st.floats(0.55, 1.0),
            st.floats(75, 525).filter(are_no_thousands),
        ),
        min_size=1,
        unique_by=lambda row: " ".join(row[0].lower().split()),
    )
)
def test_a_frame_that_is_written_in_any_dialect_is_read_alike(
    rows: list[Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    frame = pd.DataFrame(rows, columns=["plate", *MEASURED])
    fleet = read(frame)
    assert fleet.names == list(frame["plate"])
    settings = pd.DataFrame(fleet.settings, columns=VEHICLE.names)[[*MEASURED]]
    assert np.array_equal(settings, frame[[*MEASURED]])
    assert {*compress(VEHICLE.names, fleet.measured[0])} == {*MEASURED}
    path = tmp_path_factory.mktemp("fleet") / "fleet.csv"
    for separator, decimal, encoding, end in DIALECTS:
        frame.to_csv(
            path,
            index=False,
            sep=separator,
            decimal=decimal,
            encoding=encoding,
            lineterminator=end,
        )
        again = read(str(path))
        assert again.names == fleet.names
        assert np.array_equal(again.settings, fleet.settings)


def test_cars_are_read_from_files_of_excel_frames_mappings_and_the_command_line(
    tmp_path: Path,
) -> None:
    excel = (
        "\ufeffsep=;\r\nplate;payload [kg];brakeTorque;note;treadDepth [mm]\r\n"
        '007;75;0,9;"a;b";3,5\r\n8;75;1;;4\r\n;;;;\r\n\r\n'
    )
    fleet = read(written(tmp_path, excel), ignore=("note",))
    assert fleet.names == ["007", "8"]
    assert list(fleet.table) == [
        "plate",
        "payload [kg]",
        "brakeTorque",
        "note",
        "treadDepth [mm]",
    ]
    assert fleet.table["note"].tolist() == ["a;b", ""]
    assert fleet.table["brakeTorque"].tolist() == ["0,9", "1"], "as it was given"
    values = {"treadDepth": 3.5, "brakeTorque": 0.9, "payload": 75}
    stated = {**values, **JOINT.unmeasured_values}
    expected = [stated[name] for name in VEHICLE.names]
    assert fleet.settings[0].tolist() == expected
    assert {*compress(VEHICLE.names, fleet.measured[0])} == {*MEASURED}
    typed = [f"{name}={value}" for name, value in values.items()]
    for other in (read({"007": values}), read(None, *typed)):
        assert other.settings.tolist() == [expected]
    assert other.names == ["This car"]


def test_what_is_not_measured_is_as_the_study_states_and_as_new_only_if_the_user_says_so() -> (
    None
):
    frame = pd.DataFrame(
        {"car": ["a", "b"], "treadDepth": [3, None], "sensorRange": ["20", ""]}
    )
    told = r"row 0: no value of treadDepth, brakeTorque, payload, .* \(2 of 2 cars lack one\)"
    with pytest.raises(InputError, match=told):
        read(frame)
    fleet = read(frame, others="new")
    first, second = map(VEHICLE.named, fleet.settings)
    originals = VEHICLE.named(VEHICLE.original)
    assert (first["treadDepth"], first["sensorRange"]) == (3, 20)
    assert second == {**originals, **JOINT.unmeasured_values}
    assert fleet.measured.sum() == 2


def test_what_is_assumed_is_named_with_its_value_and_where_that_is_from() -> None:
    frame = pd.DataFrame(
        {"car": ["a", "b"], "treadDepth": [3, None], "sensorRange": [20, 30]}
    )
    fleet = read(frame, others="new")
    own = "brakeTorque 1, brakeResponse 0.2 s, payload 75 kg, payloadCentre 2.6 m"
    assert assumed_cells(VEHICLE, fleet) == [
        f"{own}, sensorLatency 0.1 s",
        f"treadDepth 8 mm, {own}, sensorLatency 0.1 s",
    ]
    assert Verdict(assumed_sentences(JOINT, VEHICLE, fleet)) == (
        "This answer assumes values that were not measured, as the study states under [unmeasured]:"
        " brake actuator delay 0.2 s, longitudinal position of the payload 2.6 m and perception"
        " latency 0.1 s. This answer assumes values that were not measured, as in a new car:"
        " relative brake torque 1 and payload 75 kg. In 1 of 2 cars, further values are assumed,"
        ' which the column "assumed" names (--details).'
    )
    whole = read({"a": VEHICLE.named(VEHICLE.original)})
    assert not any(assumed_sentences(JOINT, VEHICLE, whole))
    assert assumed_cells(VEHICLE, whole) == [None]


def test_a_written_answer_is_read_as_the_list_that_it_is_about() -> None:
    frame = pd.DataFrame({"plate": ["a"], "treadDepth": ["3,5"]})
    for text, is_rough in (("yes", True), ("no", False)):
        answer = frame.assign(because="", verdict="", up_to="", rough=text)
        answer = answer.rename(columns={"rough": " rough "})
        fleet = read(answer, others="new")
        assert fleet.settings[0, 0] == 3.5
        assert fleet.is_rough is is_rough
        pd.testing.assert_frame_equal(fleet.table, frame)


def test_a_measured_value_may_be_any_within_its_precision_and_the_domain() -> None:
    """`wear` states 0.05 for brakeTorque, and no precision of the others."""
    frame = pd.DataFrame({"car": ["a", "b", "c"], "brakeTorque": [0.9, 0.55, None]})
    fleet = read(frame.assign(treadDepth=3, payload=75), others="new")
    column = VEHICLE.names.index("brakeTorque")
    others = np.arange(len(VEHICLE)) != column
    # An assumed value is none that was measured.
    ends = [(0.85, 0.95), (0.5, 0.6), (1.0, 1.0)]
    for cars, setting, (low, high) in zip(
        cars_of(VEHICLE, fleet), fleet.settings, ends, strict=True
    ):
        assert (cars.lower[column], cars.upper[column]) == (low, high)
        assert {*cars.vehicles[:, column]} == {low, high}
        assert (cars.vehicles[:, others] == setting[others]).all()


HEAD = "car,treadDepth,brakeTorque,payload\n"
TABLE = tomllib.loads(
    Path(__file__).with_name("fleets.toml").read_text(encoding="utf-8")
)
REFUSED = [
    *((row["list"], row["told"]) for row in TABLE["refused"]),
    (HEAD.encode() + b"\xe4,3,1,75\n", "line 2: is not encoded in UTF-8"),
    (
        pd.DataFrame({"treadDepth": [3]}, index=["a"]),
        "cars: the first column is 'treadDepth'",
    ),
    (
        pd.DataFrame({"car": ["a"], "treadDepth": [np.inf]}),
        "cars, row 0, column 'treadDepth'",
    ),
    ({"a": {"treadDepth": np.nan}}, "cars, 'a', column 'treadDepth': 'nan'"),
    ({"a": {"treadDepth": True}}, "'True' is no number"),
    ({7: {"treadDepth": 3}, "7": {"treadDepth": 3}}, "the car '7' is there twice"),
    ({"a": 3}, "cars: 'a': 3"),
    ({}, "cars: no car"),
    (3, "cars: 3"),
]


@pytest.mark.parametrize(("cars", "told"), REFUSED, ids=[told for _, told in REFUSED])
def test_what_may_be_misread_is_refused_with_its_place(
    cars: Any, told: str, tmp_path: Path
) -> None:
    given_cars = written(tmp_path, cars) if isinstance(cars, str | bytes) else cars
    with pytest.raises(InputError, match=re.escape(told)):
        read(given_cars, others="new")


def test_all_bad_cells_are_in_one_message_and_none_has_the_end_of_a_domain_as_advice(
    tmp_path: Path,
) -> None:
    path = written(tmp_path, HEAD + "a,35,55,75\nb,3,1,75\nc,x,1,75\n")
    with pytest.raises(InputError) as caught:
        read(path)
    first, second, third, expected = str(caught.value).splitlines()
    assert first.endswith(
        "line 2, column 'treadDepth': 35 is outside 1.6 to 8 mm: is this of another unit?"
    )
    assert second.endswith(
        "line 2, column 'brakeTorque': 55 is outside 0.5 to 1: is this percent?"
    )
    assert "line 4, column 'treadDepth': 'x' is no number" in third
    assert expected == "expected: a number in [1.6, 8] mm; a number in [0.5, 1]"
    with pytest.raises(
        InputError, match=r"--set, column 'brakeTorque': 55 is outside .*percent"
    ):
        read(None, "brakeTorque=55")


def test_options_and_constraints_are_refused_too(tmp_path: Path) -> None:
    path = written(tmp_path, HEAD + "a,3,1,75\nb,3,1,525\n")
    with pytest.raises(InputError, match="no such column; did you mean 'payload'"):
        read(path, ignore=["payloa"])
    with pytest.raises(InputError, match="--others: 'old'"):
        read(path, others="old")
    told = r"line 3: violates a constraint: payload - 100 payloadCentre = 385 kg"
    with pytest.raises(InputError, match=told):
        read(path, study=BOUND, others="new")
    with pytest.raises(InputError, match="--set: no value of brakeTorque, payload"):
        read(None, "treadDepth=3")
    with pytest.raises(InputError, match="cannot be read"):
        read(tmp_path / "gone.csv")
