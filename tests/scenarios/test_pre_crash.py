"""What type of NHTSA's pre-crash scenarios a study is about, and whether it is day or night there."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from safevar_sumo.scenarios import SCENARIOS, WEATHERS, Point, PreCrash, tags
from safevar_sumo.scenarios.base import pre_crash_of
from safevar_sumo.scenarios.car_to_car import CarToCar
from safevar_sumo.study import load_study
from safevar_sumo.sumo.system import assemble

PEDESTRIAN = "pedestrian crash without prior vehicle manoeuvre"


@pytest.mark.parametrize(("study", "told"), [
    ("sun", "pedestrian crash with prior vehicle manoeuvre; by day"), ("lgsvl", "lead vehicle stopped; by day"),
    ("euro_ncap_pedestrian", f"{PEDESTRIAN}; by day and by night"), ("wear", f"{PEDESTRIAN}; by day"),
    ("euro_ncap_car_to_car", "lead vehicle stopped; lead vehicle moving at lower constant speed; lead vehicle decelerating; by day"),
])
def test_the_tags_of_the_shipped_studies(study: str, told: str) -> None:
    assert tags(assemble(load_study(study)).points) == f"NHTSA's pre-crash types: {told}."


def test_every_shipped_scenario_has_a_type_of_nhtsas_list() -> None:
    assert all(pre_crash_of(kind()) in list(PreCrash) for kind in SCENARIOS.values())
    assert {pre_crash_of(CarToCar(test=test)) for test in ("CCRs", "CCRm", "CCRb")} == {*list(PreCrash)[2:]}


def test_it_is_night_where_the_weather_says_so_and_a_scenario_may_tell_no_type() -> None:
    assert {name for name, weather in WEATHERS.items() if weather.light == "night"} == {"night"}
    night = Point(SimpleNamespace(), WEATHERS["night"])  # type: ignore[arg-type]
    assert tags([night]) == "It is by night; the scenario tells no pre-crash type."
