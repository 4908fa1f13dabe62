"""Braking of CARLA's vehicle beside the multi-body model of commonroad-vehicle-models (Althoff and Würsching 2020).

That one has 29 states: four wheels with Pacejka's tyres, suspension, a brake split over the axles. Both brake with the same torque, on
the same mass, radius and tyre (peak friction, slope per load), out of gear. It has no engine, so engine drag has no second opinion here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safevar_sumo.records import Command
from safevar_sumo.vehicles.carla import GRAVITY, WHEELS, Carla

SPEED, UNTIL = 15.0, 2.0
"""Between these speeds the mean deceleration is compared [m/s]."""

pytestmark = pytest.mark.slow


def multi_body(deceleration: float, **changed: float) -> float:
    """Mean deceleration for the brake torque that would give `deceleration` to the unchanged vehicle on rigid wheels [m/s^2]."""
    from scipy.integrate import solve_ivp
    from vehiclemodels.init_mb import init_mb
    from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb

    unchanged, vehicle = parameters(), parameters()
    for name, value in changed.items():
        setattr(vehicle.tire if name == "p_dx1" else vehicle, name, value)
    asked = -deceleration * unchanged.m * unchanged.R_w / (vehicle.m * vehicle.R_w)  # its input is a torque over m R_w

    def slow(_: float, x: Any) -> Any:
        return x[3] - UNTIL

    slow.terminal = True  # type: ignore[attr-defined]
    found = solve_ivp(lambda _, x: vehicle_dynamics_mb(list(x), [0.0, asked], vehicle), (0, 12),
                      init_mb([0, 0, 0, SPEED, 0, 0, 0], vehicle), events=slow, max_step=0.01, rtol=1e-4)
    return float((SPEED - found.y[3, -1]) / found.t[-1])


def parameters() -> Any:
    from vehiclemodels.parameters_vehicle2 import parameters_vehicle2

    return parameters_vehicle2()


def ours(deceleration: float, **changed: float) -> float:
    """The same of CARLA's vehicle."""
    other = parameters()
    mass, radius = changed.get("m", other.m), changed.get("R_w", other.R_w)
    vehicle = Carla(tyre_friction=1.0, longitudinal_stiffness=other.tire.p_kx1 * mass / WHEELS, slip_offset=0.1, engine_torque=1.0,
                    brake_rise=1e3, camera_height=1.0)
    values = {"max_rpm": 5800.0, "dampRateFullT": 0.15, "dampRateZeroT_CE": 2.0, "dampRateZeroT_CD": 0.35, "gearSwitchTime": 0.5,
              "clutchStrength": 10.0, "mass": mass, "dragCoeff": 0.0, "tireFric": changed.get("p_dx1", other.tire.p_dx1), "dampRate": 0.0,
              "radius": 100 * radius, "maxBrakeTorque": deceleration * other.m * other.R_w / WHEELS}
    step = 0.005
    prepared = vehicle.prepare({name: np.full(1, value) for name, value in values.items()}, 1.0, step)
    neutral = np.zeros(1)
    state = vehicle.at_rest(prepared)._replace(speed=neutral + SPEED, wheel_speed=neutral + SPEED / radius)
    time = 0.0
    while state.speed[0] > UNTIL:
        state = vehicle.advance(prepared, state, Command(neutral, neutral + 1))
        time += step
    return float((SPEED - state.speed[0]) / time)


@pytest.mark.parametrize("deceleration", [2.0, 6.0, 8.0])
def test_below_the_limit_both_brake_alike(deceleration: float) -> None:
    """Within 3 %: the other one's wheels are heavier (1.7 against 1.2 kg m^2 each) and take a moment more to slow down."""
    assert ours(deceleration) == pytest.approx(multi_body(deceleration), rel=0.03)


@pytest.mark.parametrize(("name", "factor"), [("m", 1.2), ("R_w", 0.9)])
def test_mass_and_radius_act_alike(name: str, factor: float) -> None:
    """The ratio of the decelerations with and without the change: that of the closed form within 2 % on both sides."""
    changed = {name: factor * getattr(parameters(), name)}
    for model in (ours, multi_body):
        assert model(5.0, **changed) / model(5.0) == pytest.approx(1 / factor, rel=0.02)


@pytest.mark.parametrize(("friction", "least"), [(0.8, 0.6), (0.5, 0.55)])
def test_beyond_the_limit_ours_holds_what_the_other_one_loses(friction: float, least: float) -> None:
    """Friction is what limits both. Ours keeps it when the wheels lock, as PhysX's tyre does; Pacejka's loses up to a half."""
    limit = friction * GRAVITY
    assert ours(9.5, p_dx1=friction) == pytest.approx(limit, rel=0.03)
    assert least * limit < multi_body(9.5, p_dx1=friction) < limit


def test_a_brake_split_matters_only_at_the_limit() -> None:
    """Ours has none: four wheels share the load and brake as one. Below the limit that is right, near it up to 15 % off."""
    assert multi_body(5.0, T_sb=0.5) == pytest.approx(multi_body(5.0, T_sb=0.8), rel=0.02)
    near = [multi_body(9.0, T_sb=split) for split in (0.5, 0.66, 0.8)]
    assert max(near) / min(near) > 1.1
    assert min(near) > 0.7 * ours(9.0)
