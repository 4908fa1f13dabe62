"""Which cars may drive, and how fast."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.permit import permit
from safevar_sumo.questions.permit.rows import verdict_of
from safevar_sumo.questions.permit.speed_search import Cars
from safevar_sumo.study import Study
from tests.support.in_process import SLOW, InlinePool, write
from tests.support.made_up_studies import places

pytestmark = pytest.mark.usefixtures("made_up_studies")

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


@pytest.fixture
def short(in_tmp: Path) -> Study:
    write("short.toml", SHORT)
    return load_study("short.toml")


@SLOW
def test_a_car_is_answered_alike_in_any_list_and_with_any_jobs(
    short: Study, worker_processes: None
) -> None:
    options: dict[str, Any] = {"fits": 2, "others": "new"}
    cars = {"a": {"treadDepth": 3}, "b": {"brakeTorque": 0.7}}
    both = permit(short, cars=cars, jobs=1, fresh=True, **options)
    again = permit(short, cars=cars, jobs=2, fresh=True, **options)
    assert both.render("json") == again.render("json")
    alone = permit(short, cars={"b": cars["b"]}, **options)
    for name in ("cars", "sets"):
        together = both.tables[name]
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
        "r152",
        cars={"a": {"brakeTorque": 0.9}},
        others="new",
        quick=True,
        pool=InlinePool(),
    ).verdict
    assert '"a" can pass the test up to 40 km/h' in told
    assert "A new car can pass the test up to 40 km/h" in told
    assert "may drive" not in told


def test_all_corners_of_five_measured_values_drive_the_grid() -> None:
    """16 of 32 corners meet each encounter."""
    cars = Cars.measured(np.zeros(5), np.ones(5))
    met = cars.drives_in(places(*np.arange(9.0))).vehicle
    assert (len(met), len(np.unique(met, axis=0))) == (9 * 16, 32)
