"""Which cars may drive, and how fast."""

from __future__ import annotations

import re
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from msgspec.structs import replace
from numpy.random import default_rng

from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.drives import Encounters
from safevar_sumo.questions.model_spread import studies_of_sets
from safevar_sumo.questions.permit import permit
from safevar_sumo.questions.permit.rows import verdict_of
from safevar_sumo.questions.permit.speed_search import Cars
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble
from tests.in_process import SLOW, numbers_of, write

SHORT = """
extends = "wear"
name = "short"
title = "A child from behind a parked car on a wet road"
encounters = "ranges"
[scenario.over]
speed           = { unit = "km/h", original = 34, lower = 34, upper = 45, meaning = "speed" }
impact_location = { unit = "%",    original = 50, lower = 25, upper = 75, meaning = "location" }
[[matrix.tests]]
name = "CPNCO"
parameters = { test = "CPNCO" }
[unmeasured]
payloadCentre = 1.4
sensorRange = { value = 80, source = "assumption" }
"""
PLACES = np.linspace(25, 75, 21)  # impact locations [%]


@pytest.fixture
def short(in_tmp: Path) -> Study:
    write("short.toml", SHORT)
    return load_study("short.toml")


def are_unsafe(
    study: Study,
    fit: int,
    cars: FloatArray,
    values: FloatArray,
    places: FloatArray,
    keep: float,
) -> BoolArray:
    """Second computation: which cars are unsafe at each speed, shape (cars, speeds), at any of the
    impact locations `places` in any test alone, whether or not the original is safe there.
    """
    found = np.zeros((len(cars), len(values)), dtype=bool)
    own = studies_of_sets(study)[fit]
    assert own.matrix is not None
    for test in own.matrix.tests:
        system = assemble(replace(own, matrix=replace(own.matrix, tests=[test])))
        rows = [[*car, *at] for car in cars for at in product(values, places)]
        runs = drive_and_score(system, np.array(rows), with_originals=False)
        fails = runs.collided | (runs.f_safe < (keep if fit == 0 else 0.0))
        found |= fails.reshape(len(cars), len(values), -1).any(axis=2)
    return found


@SLOW
def test_no_encounter_is_unsafe_up_to_a_speed_and_one_is_just_above_it() -> None:
    study = load_study("wear", encounters="ranges")
    members = assemble(study).characteristics.vehicle
    rng = default_rng(5)
    lower = members.lower + [item.error for item in members]
    settings = np.vstack(
        [members.original, lower + rng.random((3, 7)) * (members.upper - lower)]
    )
    frame = pd.DataFrame(settings, columns=[*members.names])
    frame.insert(0, "car", ["new", "a", "b", "c"])
    answer = permit("wear", cars=frame, fits=6)
    sets = answer.tables["sets"].set_index(["car", "fit"])
    up_to = sets["up_to"].unstack()  # noqa: PD010 - of a series
    assert up_to.loc["new", 0] <= 50
    assert up_to.loc["new", 5] <= 44, "new cars hit somebody at 45 km/h with this set"
    speeds = np.arange(10.0, 60.5, 0.5)
    for fit in range(6):
        fails = are_unsafe(study, fit, settings, speeds, PLACES, keep=0.1)
        for car, name in enumerate(frame["car"]):
            reached = up_to.loc[name, fit]
            assert np.isnan(reached) or not fails[car, speeds <= reached].any(), (
                name,
                fit,
            )
            # The encounter that is named for what lies above fails as printed.
            (speed,) = re.findall(r"speed (\S+) km/h", sets.encounter[name, fit])
            assert float(speed) <= (10.0 if np.isnan(reached) else reached + 1), (
                name,
                fit,
            )
            command = sets.simulate[name, fit]
            assert numbers_of(command)["f_safe"] < (0.1 if fit == 0 else 0), command
    rows = answer.table().set_index("car")
    assert rows["up_to"].equals(up_to.min(axis=1, skipna=False)[rows.index])
    assert (rows["new_car_up_to"] == up_to.loc["new"].min()).all()
    assert (answer.numbers["fits"], answer.numbers["margin"]) == (6, 0.1)
    assert not answer.numbers["rough"]


@SLOW
def test_a_car_is_answered_alike_in_any_list_and_with_any_jobs(
    short: Study, worker_processes: None
) -> None:
    options: dict[str, Any] = {"fits": 3, "others": "new"}
    cars = {"a": {"treadDepth": 3}, "b": {"brakeTorque": 0.7}, "c": {"payload": 400}}
    all_three = permit(short, cars=cars, jobs=1, fresh=True, **options)
    again = permit(short, cars=cars, jobs=2, fresh=True, **options)
    assert all_three.render("json") == again.render("json")
    alone = permit(short, cars={"b": cars["b"]}, **options)
    for name in ("cars", "sets"):
        together = all_three.tables[name]
        own = together[together["car"] == "b"].reset_index(drop=True)
        pd.testing.assert_frame_equal(own, alone.tables[name], check_dtype=False)


def test_a_needed_speed_is_no_less_where_the_new_car_is_unsafe_too() -> None:
    for up_to, need, expected in (
        (50, 55, "up to"),
        (55, 55, "drive"),
        (45, 55, "up to"),
        (50, None, "drive"),
        (49, None, "up to"),
        (None, None, "stop"),
    ):
        assert verdict_of(up_to, 50, 60, need, is_proven=True) == expected, (
            up_to,
            need,
        )


@SLOW
def test_a_car_passes_a_test_of_a_regulation() -> None:
    """It is no promise for the road."""
    told = permit(
        "r152", cars={"a": {"brakeTorque": 0.9}}, others="new", quick=True
    ).verdict
    assert '"a" can pass the test up to 40 km/h' in told
    assert "A new car can pass the test up to 40 km/h" in told
    assert "may drive" not in told


def test_all_corners_of_five_measured_values_drive_the_grid() -> None:
    """16 of 32 corners meet each encounter."""
    cars = Cars.measured(np.zeros(5), np.ones(5))
    places = np.arange(9.0)[:, np.newaxis]
    encounters = Encounters(np.zeros(9, dtype=np.intp), np.zeros(9), places)
    met = cars.drives_in(encounters).vehicle
    assert (len(met), len(np.unique(met, axis=0))) == (9 * 16, 32)
