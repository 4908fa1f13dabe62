"""The worn car's brakes against the balance of two axles, and its tyres and sensors against their numbers."""

from __future__ import annotations

import numpy as np
import pytest

from safevar_sumo.records import Observation
from safevar_sumo.vehicles.slope import GRAVITY
from safevar_sumo.vehicles.worn import WornVehicle

CAR = WornVehicle()
HEALTHY = {"treadDepth": 8.0, "brakeTorque": 1.0, "brakeResponse": 0.1, "payload": 75.0, "payloadCentre": 1.4, "sensorRange": 80.0,
           "sensorLatency": 0.05}


def prepared(road: float, **changes: float):  # type: ignore[no-untyped-def]
    return CAR.prepare({name: np.array([value]) for name, value in {**HEALTHY, **changes}.items()}, road, 0.05)


@pytest.mark.parametrize("road", [1.0, 0.85, 0.5, 0.2])
@pytest.mark.parametrize("changes", [
    {}, {"payload": 525.0, "payloadCentre": 3.2}, {"payload": 525.0, "payloadCentre": 1.2}, {"brakeTorque": 0.5}])
def test_deceleration_is_that_of_two_axles_of_which_none_brakes_more_than_its_load_holds(road: float, changes: dict[str, float]) -> None:
    """Found here by bisection of m a = sum of min(share F, mu N(a)), with the load going forward as it brakes."""
    p = prepared(road, **changes)
    mass, mu, force = float(p.mass[0]), float(p.grip[0]), float(p.brake[0] * p.mass[0])
    values = {**HEALTHY, **changes}
    centre = (CAR.kerb_mass * CAR.kerb_centre + values["payload"] * values["payloadCentre"]) / mass

    def left(a: float) -> float:
        front = mass * (GRAVITY * (CAR.wheelbase - centre) + a * CAR.centre_height) / CAR.wheelbase
        return min(CAR.front_share * force, mu * front) + min((1 - CAR.front_share) * force, mu * (mass * GRAVITY - front)) - mass * a

    low, high = 0.0, 20.0
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if left(middle) > 0 else (low, middle)
    assert CAR.sumo_type(p).decel[0] == pytest.approx(low, rel=1e-9)


def test_where_the_load_lies_counts_once_an_axle_is_at_its_limit() -> None:
    decel = [CAR.sumo_type(prepared(0.85, payload=525.0, payloadCentre=centre)).decel[0] for centre in (1.2, 2.2, 3.2)]
    assert len(set(np.round(decel, 6))) > 1


def test_worn_tyres_have_lost_what_mira_measured_on_a_wet_road_and_nothing_on_a_dry_one() -> None:
    new, worn = prepared(0.85), prepared(0.85, treadDepth=1.6)
    assert worn.grip[0] / new.grip[0] == pytest.approx(0.73)
    assert prepared(1.0, treadDepth=1.6).grip[0] == prepared(1.0).grip[0]


def test_dirty_sensors_see_late_and_not_far() -> None:
    p, seen = prepared(1.0, sensorRange=30.0, sensorLatency=0.2), []
    state, one = CAR.at_rest(p), np.ones(1)
    for k in range(200):
        told, state = CAR.sense(p, state, Observation(k * 0.05, one, (60 - 0.5 * k) * one, 10 * one, 0 * one, 0 * one, 1.0))
        seen.append(float(told.gap[0]))
    assert np.isinf(seen[:64]).all()
    assert seen[64] == pytest.approx(60 - 0.5 * 60)
    assert seen[100] == pytest.approx(60 - 0.5 * 96)
