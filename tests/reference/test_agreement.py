"""The published format, and agreement of two sets of numbers, against values worked out by hand."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.records import Evaluations
from safevar_sumo.reference.agreement import measure_agreement, rank_correlation
from safevar_sumo.reference.rows import ReferenceData, read_reference
from safevar_sumo.study import Study, load_study
from safevar_sumo.vehicles import Characteristic, CharacteristicSet
from tests.made_up import made_up_evaluations

ONE = CharacteristicSet((Characteristic(name="c", unit="kg", original=5.0, lower=1.0, upper=9.0),))


def study(published: dict[str, float], repeatability: float) -> Study:
    return msgspec.structs.replace(
        load_study("smoke"), published=published, repeatability={"safety_degree": repeatability}
    )


def reference(safety: list[float], tet: list[float]) -> ReferenceData:
    values = np.array(safety)
    tet_values = np.where(values <= 0, np.nan, np.array(tet))
    metrics = {"safety_degree": values, "tet": tet_values, "tit": tet_values, "ave_dece": values * np.nan}
    return ReferenceData(np.linspace(1, 9, len(values))[:, np.newaxis], metrics, 0)


def here(safety: list[float], tet: list[float]) -> Evaluations:
    data = reference(safety, tet)
    metrics = {**data.metrics, "ave_dece": np.ones(len(safety))}
    return made_up_evaluations(safety, settings=data.settings, metrics=metrics)


def test_every_number_is_what_it_says() -> None:
    result = measure_agreement(
        reference([1.0, 2.0, 3.0, -1.0], [1.0, 1.2, 1.4, 0]),
        here([1.5, 2.0, 2.0, 1.0], [1.1, 1.2, 1.2, 9.0]),
        study({"safety_degree": 2.7}, 0.4),
        here([2.5], [1.0]),
    )
    assert result.rows == 4
    assert result.mean_absolute_error["safety_degree"] == pytest.approx((0.5 + 0 + 1 + 2) / 4)
    assert result.bias["safety_degree"] == pytest.approx((0.5 + 0 - 1 + 2) / 4)
    assert result.bias["tet"] == pytest.approx((0.1 + 0 - 0.2) / 3), "over rows without collision on either side"
    assert (result.spearman["ave_dece"], result.mean_absolute_error["ave_dece"]) == (None, None)
    assert result.collisions == {"reference": 1, "here": 0, "both": 0}
    assert result.original["safety_degree"] == {"reference": 2.7, "here": 2.5}
    assert result.original["tet"] == {"reference": None, "here": 1.0}
    assert (result.precision, result.recall) == (None, 0.0)
    assert result.in_repeats["safety_degree"] == pytest.approx(3.5 / 4 / 0.4)
    assert result.in_repeats["tet"] is None
    assert result.undecided == {"differ": 1, "within_repeats": 0}
    assert sum(part["rows"] or 0 for part in result.by_predicted) == 4


def test_collisions_are_counted_and_those_that_repeats_may_turn_are_told() -> None:
    """Four collide there and four here, three on both sides; of the two others one is 0.05 m from a collision."""
    result = measure_agreement(
        reference([-1.0, -2.0, -3.0, -1.0, 0.5, 2.0], [1.0] * 6),
        here([-2.0, -2.0, -2.0, 0.05, -1.5, 2.0], [1.0] * 6),
        study({}, 0.03),
        here([2.5], [1.0]),
    )
    assert (result.precision, result.recall) == (0.75, 0.75)
    assert result.collision_speed == {"reference": 2.0, "here": 2.0}
    assert result.undecided == {"differ": 2, "within_repeats": 1}
    assert "4 in the reference, 4 here, 3 in both: precision 0.75, recall 0.75" in result.sentences()[0]


def test_rank_correlation_of_known_orders() -> None:
    assert rank_correlation(np.array([1.0, 2, 3]), np.array([10.0, 20, 30])) == pytest.approx(1)
    assert rank_correlation(np.array([1.0, 2, 3]), np.array([3.0, 2, 1])) == pytest.approx(-1)
    for undefined in ([1.0, 1, 1], [1.0], list[float]()):
        assert rank_correlation(np.arange(len(undefined)), np.array(undefined)) is None


SUN = CharacteristicSet.of(load_study("sun"))
LGSVL = CharacteristicSet.of(load_study("lgsvl"))
SUN_COLUMNS = [
    "max_rpm",
    "dampRateFullT",
    "dampRateZero_CE",
    "dampRateZero_CD",
    "gearSwitchTime",
    "clutchStrength",
    "mass",
    "dragCoeff",
    "tireFric",
    "dampRate",
    "radius",
    "maxBrakeTorque",
]
LGSVL_COLUMNS = [
    "mass",
    "wheel_mass",
    "wheel_radius",
    "MaxRPM",
    "MinRPM",
    "MaxBrakeTorque",
    "MaxMotorTorque",
    "MaxSteeringAngle",
    "TireDragCoeff",
    "WheelDamping",
    "ShiftTime",
    "TractionControlSlipLimit",
]
METRICS = {
    "MaxPercentage": [0.5, 0.1, 0.2],
    "SaftyDegree": [2.5, -1.5, 3.0],
    "numbers": [3, 2, 1],
    "TIT": [0.4, 0.0, 0.5],
    "TET": [1.2, 0.0, 1.3],
    "Dece": [5.0, 3.0, 6.0],
}


def table(characteristics: CharacteristicSet, columns: list[str]) -> pd.DataFrame:
    return (
        pd.DataFrame(np.repeat(characteristics.original[np.newaxis], 3, axis=0), columns=columns)
        .assign(**METRICS)
        .astype(object)
    )


@pytest.mark.parametrize(("characteristics", "columns"), [(SUN, SUN_COLUMNS), (LGSVL, LGSVL_COLUMNS)])
def test_both_published_formats_are_read(
    tmp_path: Path, characteristics: CharacteristicSet, columns: list[str]
) -> None:
    """The lgsvl files have negative decelerations. A row outside the domains is counted and left out."""
    frame = table(characteristics, columns).assign(Dece=[-5.0, -3.0, -6.0])
    frame.loc[0, columns[0]] = characteristics.lower[0]
    frame.loc[3] = frame.loc[0]
    frame.loc[3, "mass"] = 1e6
    frame.to_csv(tmp_path / "data.csv", index=False)
    data = read_reference(tmp_path / "data.csv", characteristics)
    assert data.settings[0].tolist() == [characteristics.lower[0], *characteristics.original[1:]]
    assert data.metrics["safety_degree"].tolist() == [2.5, -1.5, 3.0]
    assert data.metrics["ave_dece"].tolist() == [5.0, 3.0, 6.0]
    for undefined in (data.collided, np.isnan(data.metrics["tet"]), np.isnan(data.metrics["tit"])):
        assert undefined.tolist() == [False, True, False]
    assert data.skipped == 1


PUBLISHED_HEADER = ",".join([*SUN_COLUMNS, "SaftyDegree", "TET", "TIT"])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "is not CSV"),
        (PUBLISHED_HEADER + "\n", "has no rows"),
        ("mass,radius\n1,2\n", "lacks the columns max_rpm"),
        (",".join(SUN_COLUMNS) + "\n" + ",".join(["1"] * 12) + "\n", "lacks the columns SaftyDegree, TET, TIT"),
        ("mass,radius\n1,2,3\n", "more values than the header"),
        ("mass,radius\n1,2\n1,2,3\n", "is not CSV: .*line 3"),
        ('a,b\n"1\n', "is not CSV"),
        *(
            (f"{PUBLISHED_HEADER},{name}\n{','.join(['1'] * 16)}\n", f"more than one column for {column}\n")
            for name, column in (("Mass", "Mass"), ("SaftyDegree", "SaftyDegree"), ("radius ", "radius"))
        ),
    ],
)
def test_a_file_in_another_format_is_refused(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "data.csv").write_text(text)
    with pytest.raises(InputError, match=expected):
        read_reference(tmp_path / "data.csv", SUN)


@pytest.mark.parametrize(
    ("column", "cell"),
    [
        ("mass", "heavy"),
        ("mass", ""),
        ("mass", "nan"),
        ("mass", "inf"),
        ("TET", "-5"),
        ("SaftyDegree", "1e308"),
        ("Dece", "1e9"),
    ],
)
def test_a_cell_that_cannot_be_used_is_told_with_row_and_column(tmp_path: Path, column: str, cell: str) -> None:
    """By its line in the file, though lines are blank."""
    frame = table(SUN, SUN_COLUMNS)
    frame.loc[1, column] = cell
    lines = frame.to_csv(index=False).splitlines()
    (tmp_path / "data.csv").write_text("\n".join([*lines[:2], "", "", *lines[2:]]) + "\n\n")
    with pytest.raises(InputError, match=f"row 5, column {column} .*\nexpected: a.* number"):
        read_reference(tmp_path / "data.csv", SUN)
