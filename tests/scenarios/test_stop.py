"""The scenario `stop` against the closed form and against SUMO, with every shipped vehicle."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import safevar_sumo as sv
from safevar_sumo.records import GRAVITY, KMH_PER_MS, FloatArray
from safevar_sumo.replay.simulate import show_simulation
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import System
from tests.support.made_up import system_of


def stops(weather: Any, *speeds: float, **tables: Any) -> System:
    """The worn car's stops from `speeds` [km/h]."""
    return system_of(
        {
            "extends": "stop",
            "name": "some",
            "weather": weather,
            "matrix": {"tests": [{"name": "stop", "over": {"speed": [*speeds]}}]},
            **tables,
        }
    )


def distances(system: System, **changes: float) -> FloatArray:
    """Stopping distances of the original vehicle with some changes, from every speed [m]."""
    values = system.characteristics.named(system.characteristics.original) | changes
    results = simulate_all_points(system, np.array([[*values.values()]]))
    return np.array(
        [result.evaluations.metrics["stopping_distance"][0] for result in results]
    )


@pytest.mark.parametrize(
    ("brake_response", "friction"),
    [(0.1, 0.3), (0.149, 0.3), (0.11, 0.3), (0.125, 0.75), (0.05, 0.75), (0.3, 0.5)],
)
def test_a_stop_by_constant_friction_is_v_squared_over_two_mu_g(
    brake_response: float, friction: float
) -> None:
    """From the first brake force on: a delay of the brake changes nothing, also within a step."""
    speeds = np.array([10.0, 30.0, 50.0, 80.0, 81.7, 120.0, 250.0])
    system = stops(
        {"name": "polished", "road_friction": friction, "visibility": 1.0},
        *speeds.tolist(),
    )
    mu = system.vehicle.tyre_friction * friction  # type: ignore[attr-defined]
    expected = (speeds / KMH_PER_MS) ** 2 / (2 * mu * GRAVITY)
    assert distances(system, brakeResponse=brake_response) == pytest.approx(
        expected, abs=0.01
    )


def test_the_driving_system_is_not_asked_and_simulate_says_how_far_it_went() -> None:
    study = {
        "extends": "sun",
        "name": "some",
        "scenario": {"model": "stop", "parameters": {"speed": 30}},
    }
    stop = sv.simulate(study)
    other = sv.simulate({**study, "ads": {"model": "aeb"}})
    assert stop.metrics == pytest.approx(other.metrics, nan_ok=True)
    assert (stop.outcome, stop.no_verdict) == ("stopped", "")
    assert stop.to_dict()["stopping_distance"] == stop.metrics["stopping_distance"] > 0
    assert stop.units["stopping_distance"] == "m"


def test_simulate_prints_the_stop_from_every_speed() -> None:
    answer = show_simulation("stop", set=("treadDepth=1.6",))
    assert answer.tables["points"]["stopping_distance"].tolist() == pytest.approx(
        distances(stops("wet", 30, 50, 80, 100, 120), treadDepth=1.6)
    )
    assert "times the stopping distance of the original" in answer.verdict
