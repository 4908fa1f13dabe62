"""The published format, and agreement of two sets of numbers, against values worked out by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.records import Evaluations
from safevar_sumo.reference.agreement import (
    agreement_counts,
    measure_agreement,
    rank_correlation,
    shipped_agreement,
)
from safevar_sumo.reference.rows import ReferenceData, package_filter, read_reference
from safevar_sumo.sumo import drive_worst
from safevar_sumo.sumo.batch import score
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from tests.support.made_up import (
    SUN,
    made_up_evaluations,
    original_of,
    system_of,
    uniform,
)


def reference(safety: list[float], tet: list[float]) -> ReferenceData:
    values = np.array(safety)
    tet_values = np.where(values <= 0, np.nan, np.array(tet))
    metrics = {
        "safety_degree": values,
        "tet": tet_values,
        "tit": tet_values,
        "ave_dece": values * np.nan,
    }
    return ReferenceData(np.linspace(1, 9, len(values))[:, np.newaxis], metrics)


def here(safety: list[float], tet: list[float]) -> Evaluations:
    data = reference(safety, tet)
    metrics = {**data.metrics, "ave_dece": np.ones(len(safety))}
    return made_up_evaluations(safety, settings=data.settings, metrics=metrics)


def test_every_number_is_what_it_says() -> None:
    there = reference([1.0, 2.0, 3.0, -1.0], [1.0, 1.2, 1.4, 0])
    table = measure_agreement(
        there, here([1.5, 2.0, 2.0, 1.0], [1.1, 1.2, 1.2, 9.0])
    ).set_index("metric")
    degrees = table.loc["safety_degree"]
    assert degrees["mean_absolute_error"] == pytest.approx((0.5 + 0 + 1 + 2) / 4)
    assert degrees["bias"] == pytest.approx((0.5 + 0 - 1 + 2) / 4)
    assert table.loc["tet", "bias"] == pytest.approx((0.1 + 0 - 0.2) / 3), (
        "over rows without collision on either side"
    )
    assert table.loc["ave_dece"].drop("unit").isna().all()


def test_collisions_are_counted_on_each_side_and_on_both() -> None:
    there = reference([-1.0, -2.0, -3.0, -1.0, 0.5, 2.0], [1.0] * 6)
    assert agreement_counts(
        there, here([-2.0, -2.0, -2.0, 0.05, -1.5, 2.0], [1.0] * 6)
    ) == {
        "rows": 6,
        "collisions_here": 4,
        "collisions_reference": 4,
        "collisions_both": 3,
    }


def test_a_study_that_simulates_alike_shares_the_shipped_agreement() -> None:
    sun = load_study("sun")
    assert shipped_agreement(sun)["rows"].tolist() == [1486, 1035, 1500]
    assert len(shipped_agreement(load_study(sun, name="mine", search={"runs": 2}))) == 3
    assert shipped_agreement(
        load_study(sun, ads={"parameters": {"brake_gap": 7.0}})
    ).empty


def test_equal_values_and_too_few_have_no_rank_correlation() -> None:
    for undefined in ([1.0, 1, 1], [1.0], []):
        assert np.isnan(
            rank_correlation(np.arange(len(undefined)), np.array(undefined))
        )


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
        pd.DataFrame(
            np.repeat(characteristics.original_settings, 3, axis=0), columns=columns
        )
        .assign(**METRICS)
        .astype(object)
    )


@pytest.mark.parametrize(
    ("characteristics", "columns"), [(SUN, SUN_COLUMNS), (LGSVL, LGSVL_COLUMNS)]
)
def test_both_published_formats_are_read(
    tmp_path: Path, characteristics: CharacteristicSet, columns: list[str]
) -> None:
    """The lgsvl files have negative decelerations. A row outside the domains is counted and left
    out.
    """
    frame = table(characteristics, columns).assign(Dece=[-5.0, -3.0, -6.0])
    frame.loc[0, columns[0]] = characteristics.lower[0]
    frame.loc[3] = frame.loc[0]
    frame.loc[3, "mass"] = 1e6
    frame.to_csv(tmp_path / "data.csv", index=False)
    with pytest.warns(
        UserWarning,
        match="data.csv: 1 rows with values outside the domains are left out",
    ):
        data = read_reference(tmp_path / "data.csv", characteristics)
    assert data.settings[0].tolist() == [
        characteristics.lower[0],
        *characteristics.original[1:],
    ]
    assert data.metrics["safety_degree"].tolist() == [2.5, -1.5, 3.0]
    assert data.metrics["ave_dece"].tolist() == [5.0, 3.0, 6.0]
    for undefined in (
        data.collided,
        np.isnan(data.metrics["tet"]),
        np.isnan(data.metrics["tit"]),
    ):
        assert undefined.tolist() == [False, True, False]


PUBLISHED_EFFECTS = {
    "tireFric": 1.2,
    "mass": -0.8,
    "maxBrakeTorque": 0.6,
    "dampRateZeroT_CE": 0.4,
    "radius": 0.4,
    "max_rpm": 0.2,
    "dampRateZeroT_CD": 0.2,
}
"""Linear effect on the safety degree over a whole domain in the published random search in sun [m].
"""


@pytest.mark.parametrize(
    ("study", "within"),
    [
        ("sun", {"safety_degree": 0.05, "tet": 0.05, "tit": 0.05, "ave_dece": 0.055}),
        ("lgsvl", {"safety_degree": 0.05, "tet": 0.05, "tit": 0.05, "ave_dece": 0.05}),
        (
            "rain",
            {"safety_degree": 0.40 / 2.2, "tet": 0.05, "tit": 0.15, "ave_dece": 0.05},
        ),
    ],
)
def test_the_original_vehicle_is_as_near_to_the_published_one_as_is_said(
    study: str, within: dict[str, float]
) -> None:
    """Rain's published vehicle is one simulation, 0.3 to 0.4 m above its own neighbours."""
    read = load_study(study)
    system = assemble(read)
    settings = original_of(system)
    here = score(system, settings, drive_worst(system, settings)).metrics
    for name, share in within.items():
        assert here[name][0] == pytest.approx(read.published[name], rel=share), name


@pytest.mark.parametrize("study", ["sun", "rain"])
def test_vehicles_come_in_the_order_of_the_published_effects(study: str) -> None:
    """Spearman's rho over 150 vehicles with the published linear effects, which know nothing of
    what saturates or comes together.
    """
    system = system_of(study)
    characteristics = system.characteristics
    width = characteristics.upper - characteristics.lower
    settings = uniform(characteristics, 150, 14)
    effects = np.array(
        [PUBLISHED_EFFECTS.get(name, 0.0) for name in characteristics.names]
    )
    here = score(system, settings, drive_worst(system, settings)).f_safe
    assert (
        rank_correlation(
            ((settings - characteristics.original) / width) @ effects, here
        )
        > 0.55
    )


def test_the_published_filter_undoes_changes_below_their_share_of_the_domain() -> None:
    """The share is rounded to three decimals, and a change of exactly beta stays."""
    width = SUN.upper - SUN.lower
    sign = np.where(SUN.original + 0.1 * width > SUN.upper, -1, 1)
    for beyond, is_kept in ((-0.002, False), (-0.0004, True), (0.0, True)):
        share = SUN.threshold / width + beyond
        changed = (SUN.original + sign * share * width)[np.newaxis]
        kept = package_filter(SUN, changed)
        expected = changed if is_kept else SUN.original_settings
        assert kept == pytest.approx(expected, abs=0)
