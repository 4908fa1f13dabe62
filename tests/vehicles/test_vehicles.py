"""Every vehicle model: physics that no parameter may break, and every characteristic acting as physics says."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from safevar_sumo.records import Observation
from safevar_sumo.vehicles import VEHICLES
from safevar_sumo.vehicles.base import delay_signal
from safevar_sumo.vehicles.carla import ENGINE_INERTIA, FINAL_RATIO, GEAR_RATIOS, WHEEL_MASS, WHEELS, Carla
from safevar_sumo.vehicles.lgsvl import Lgsvl
from tests.vehicles.runs import (
    STEP,
    SYSTEMS,
    Drive,
    coasting_after,
    drawn,
    drive,
    ends,
    full_throttle,
    half_throttle,
    original,
)

MODELS = sorted(VEHICLES)


def kinetic_energy(model: str, run: Drive) -> np.ndarray:
    """Kinetic energy of all moving parts [J], shape (T, N)."""
    p, states = run.prepared, run.states
    if isinstance(SYSTEMS[model].vehicle, Carla):
        wheels_and_engine = [
            WHEELS * 0.5 * WHEEL_MASS * p.radius**2 * s.wheel_speed**2 + ENGINE_INERTIA * s.engine_speed**2
            for s in states
        ]
        return np.stack([(p.mass * s.speed**2 + spins) / 2 for s, spins in zip(states, wheels_and_engine, strict=True)])
    if isinstance(SYSTEMS[model].vehicle, Lgsvl):
        return np.stack([(p.body * s.speed**2 + p.inertia * s.wheel_speed**2) / 2 for s in states])
    return np.stack([p.mass * s.speed**2 / 2 for s in states])


def at_random(model: str, then_brake: float | None = None) -> Drive:
    """Many settings with pedals that change at random every second; after four, if so asked, the throttle closed and
    one brake.
    """
    n, rng = 300, np.random.default_rng(12)
    throttle, brake = rng.choice([0.0, 0.4, 1.0], (8, n)), rng.choice([0.0, 0.0, 0.3, 1.0], (8, n))

    def pedals(time: float) -> tuple[object, object]:
        if then_brake is not None and time >= 4:
            return 0.0, then_brake
        return throttle[int(time)], brake[int(time)]

    return drive(model, drawn(model, n, 13), pedals, 8)


@pytest.mark.parametrize("model", MODELS)
def test_energy_is_never_created(model: str) -> None:
    """The energy grows at most by the power of the engine; with the throttle closed it does not grow."""
    run = at_random(model)
    energy = kinetic_energy(model, run)
    gained = np.diff(energy, axis=0)
    throttle = np.stack([state.throttle for state in run.states])
    closed = (throttle[1:] == 0) & (throttle[:-1] == 0)
    if (
        model == "sumo"
    ):  # its acceleration lags behind the throttle, which counts as closed when the acceleration has died away
        closed &= np.stack([state.acceleration for state in run.states[1:]]) <= 0
    assert np.count_nonzero(closed) > 1000
    assert np.all(gained[closed] <= 1e-9 * (1 + energy[:-1][closed]))
    strongest = {
        "carla": 2 * 500 * 7000 * np.pi / 30,
        "lgsvl": 550 * 13000 * np.pi / 30,
        "sumo": 3.2 * 2100 * 60,
        "worn": 3900.0 * 60,
    }[model]
    assert np.all(gained <= strongest * STEP)


@pytest.mark.parametrize("model", MODELS)
def test_braking_never_raises_speed(model: str) -> None:
    """After any drive, a braking vehicle is never faster than a coasting vehicle in the same gear, and it slows down.

    An engine that turns faster than its wheels first loses its momentum through the clutch.
    """
    coasting, braking = at_random(model, 0.0), at_random(model, 1.0)
    slower = braking.speed <= coasting.speed + 1e-9
    if model == "carla":
        gears = [np.stack([state.gear for state in run.states]) for run in (braking, coasting)]
        slower |= np.logical_or.accumulate(gears[0] != gears[1], axis=0)
    assert np.all(slower)
    since = braking.at(4.5)
    slows = np.diff(braking.speed[since:], axis=0) <= 1e-12
    if model == "carla":
        states = braking.states[since:-1]
        ratio = np.stack([GEAR_RATIOS[state.gear.astype(int)] * FINAL_RATIO for state in states])
        shifting = np.stack([state.gear != state.target_gear for state in braking.states])
        shifting = shifting[since:-1] | shifting[since + 1 :]
        slows |= shifting | (
            np.stack([s.engine_speed for s in states]) > ratio * np.stack([s.wheel_speed for s in states])
        )
    assert np.all(slows)


@pytest.mark.parametrize("model", MODELS)
def test_halving_the_time_step_changes_a_trajectory_by_little(model: str) -> None:
    """Stated bound: 2 % of the distance and 0.3 m/s while driving up, coasting and braking to a stop."""

    def pedals(time: float) -> tuple[float, float]:
        return (0.8, 0.0) if time < 3 else (0.0, 0.0) if time < 4 else (0.0, 0.6)

    coarse, fine = (drive(model, original(model), pedals, 8, step) for step in (STEP, STEP / 2))
    assert np.abs(coarse.speed - fine.speed[::2]).max() < 0.3
    assert coarse.distance[-1, 0] == pytest.approx(fine.distance[-1, 0], rel=0.02)


# Measurements in which a characteristic acts, over a grid of its domain.
def speed_at(
    time: float, pedals: Callable[[float], tuple[float, float]] = full_throttle, road: float = 1.0
) -> Callable[..., np.ndarray]:
    return lambda model, population: drive(model, population, pedals, time, road=road).speed[-1]


def stopping_distance(brake: float, road: float = 1.0, wet: bool = False) -> Callable[..., np.ndarray]:
    return lambda model, population: drive(
        model, population, lambda time: (0.0, brake), 15, rolling=8.0, road=road, wet=wet
    ).distance[-1]


def coasting_loss(start: float, duration: float) -> Callable[..., np.ndarray]:
    def measured(model: str, population: np.ndarray) -> np.ndarray:
        run = drive(model, population, coasting_after(start), start + duration + 0.5)
        before, after = run.speed[run.at(start + 0.5)], run.speed[-1]
        return np.asarray((before - after) / before)

    return measured


def lateral_error(model: str, population: np.ndarray) -> np.ndarray:
    return np.abs(drive(model, population, half_throttle, 3).states[-1].lateral)


ACTS = {
    "carla": {
        "max_rpm": (speed_at(30), +1),
        "dampRateFullT": (speed_at(1), -1),
        "dampRateZeroT_CE": (coasting_loss(3, 2), +1),
        "dampRateZeroT_CD": (speed_at(0.8, half_throttle), -1),
        "gearSwitchTime": (speed_at(0.8), -1),
        "clutchStrength": (speed_at(0.65), +1),
        "mass": (speed_at(3), -1),
        "dragCoeff": (speed_at(1.5), -1),
        "tireFric": (stopping_distance(1.0), -1),
        "dampRate": (coasting_loss(3, 2), +1),
        "radius": (stopping_distance(1.0), +1),
        "maxBrakeTorque": (stopping_distance(1.0), -1),
    },
    "lgsvl": {
        "mass": (speed_at(3), -1),
        "wheelMass": (speed_at(3), -1),
        "radius": (speed_at(2), -1),
        "maxRpm": (speed_at(60), +1),
        "minRpm": (speed_at(0.5), +1),
        "maxBrakeTorque": (stopping_distance(0.2), -1),
        "maxMotorTorque": (speed_at(3), +1),
        "maxSteeringAngle": (lateral_error, -1),
        "tireDragCoeff": (coasting_loss(3, 5), +1),
        "wheelDamping": (coasting_loss(3, 5), +1),
        "shiftTime": (speed_at(5), +1),
        "tractionControlSlipLimit": (speed_at(6, road=0.1), -1),
    },
    "sumo": {
        "mass": (speed_at(3), -1),
        "accel": (speed_at(3), +1),
        "decel": (stopping_distance(0.6), -1),
        "maxSpeed": (speed_at(60), +1),
        "tau": (speed_at(1), -1),
        "brakeDelay": (stopping_distance(0.6), +1),
        "brakeGain": (stopping_distance(0.6), -1),
    },
    "worn": {
        "treadDepth": (stopping_distance(1.0, road=0.85, wet=True), -1),
        "brakeTorque": (stopping_distance(0.6), -1),
        "brakeResponse": (stopping_distance(0.6), +1),
        "payload": (stopping_distance(0.6), +1),
    },
}
SENSED = {"sumo": {"sensorRange", "reactionTime"}, "worn": {"sensorRange", "sensorLatency", "payloadCentre"}}
"""Characteristics that act on the observation, or on the limits of single axles (test_worn.py)."""


@pytest.mark.parametrize(("model", "name"), [(model, name) for model, acting in ACTS.items() for name in acting])
def test_a_characteristic_acts_in_the_direction_that_physics_says(model: str, name: str) -> None:
    measure, direction = ACTS[model][name]
    measured = direction * measure(model, ends(model, name))
    assert measured[-1] > measured[0]
    assert np.all(np.diff(measured) >= -1e-3 * np.abs(measured[1:]))


@pytest.mark.parametrize("model", MODELS)
def test_every_characteristic_is_tested_to_act(model: str) -> None:
    assert set(ACTS[model]) | SENSED.get(model, set()) == set(SYSTEMS[model].characteristics.names)


def test_what_comes_into_sight_is_where_it_is_whatever_was_before() -> None:
    past = np.array([[5.0], [np.inf], [np.inf]])  # newest first
    assert delay_signal(past, np.array([0.0]), 0.1).tolist() == [5.0]
    assert delay_signal(past, np.array([0.1]), 0.1).tolist() == [np.inf]


def sensed_gaps(model: str, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Five values of a characteristic, and the gaps that such vehicles report while an obstacle comes nearer at 10 m/s;
    shape (T, 5).
    """
    vehicle, population, names = SYSTEMS[model].vehicle, ends(model, name), SYSTEMS[model].characteristics.names
    prepared = vehicle.prepare(dict(zip(names, np.ascontiguousarray(population.T), strict=True)), 1.0, STEP)
    state, gaps, nothing = vehicle.at_rest(prepared), [], np.zeros(5)
    for k in range(240):
        gap = np.full(5, 130.0 - 10 * k * STEP)
        observation = Observation(k * STEP, nothing, gap, nothing, nothing, nothing, 1.0)
        seen, state = vehicle.sense(prepared, state, observation)
        gaps.append(seen.gap)
    return population[:, names.index(name)], np.stack(gaps)


@pytest.mark.parametrize("model", ["sumo", "worn"])
def test_a_sensor_sees_nothing_beyond_its_range(model: str) -> None:
    reach, gaps = sensed_gaps(model, "sensorRange")
    assert np.allclose(np.where(np.isfinite(gaps), gaps, 0).max(axis=0), reach, atol=0.6)


@pytest.mark.parametrize(("model", "name"), [("sumo", "reactionTime"), ("worn", "sensorLatency")])
def test_a_slow_sensor_reports_the_past(model: str, name: str) -> None:
    latency, gaps = sensed_gaps(model, name)
    assert np.allclose(gaps[200], 130.0 - 10 * 200 * STEP + 10 * latency)
