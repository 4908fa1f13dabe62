"""The worn car's brakes against the balance of two axles, and its tyres and sensors against their numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays

from safevar_sumo.errors import InputError
from safevar_sumo.records import GRAVITY, Command
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import Characteristic, CharacteristicSet
from safevar_sumo.vehicles.base import LEVEL
from safevar_sumo.vehicles.sensing import WornVehicle

CAR = WornVehicle()
HEALTHY = {
    "treadDepth": 8.0,
    "brakeTorque": 1.0,
    "brakeResponse": 0.1,
    "payload": 75.0,
    "payloadCentre": 1.4,
    "sensorRange": 80.0,
    "sensorLatency": 0.05,
}


def prepared(road: float, wet: bool = False, step: float = 0.05, **changes: float):  # type: ignore[no-untyped-def]
    return CAR.prepare(
        {name: np.array([value]) for name, value in {**HEALTHY, **changes}.items()}, road, step, LEVEL, wet
    )


def stopping_distance(tread: float, wet: bool = True) -> float:
    """Full braking from 50 mph on a straight road: the distance [m]; `wet` is the weather."""
    p = prepared(0.71, wet, 0.001, treadDepth=tread, brakeResponse=0.001)
    state, distance = CAR.at_speed(p, np.full(1, 22.352)), 0.0
    while state.speed[0] > 0:
        last_speed, state = state.speed[0], CAR.advance(p, state, Command(np.zeros(1), np.ones(1)))
        distance += (last_speed + state.speed[0]) / 2 * 0.001
    return distance


@pytest.mark.parametrize("road", [1.0, 0.85, 0.5, 0.2])
@pytest.mark.parametrize(
    "changes",
    [{}, {"payload": 525.0, "payloadCentre": 3.2}, {"payload": 525.0, "payloadCentre": 1.2}, {"brakeTorque": 0.5}],
)
def test_two_axles_brake_together_and_none_beyond_the_friction_of_its_load(
    road: float, changes: dict[str, float]
) -> None:
    """Expected: the bisection of m a = sum of min(share F, mu N(a)); the load N moves forward with the deceleration
    a.
    """
    p = prepared(road, **changes)
    mass, mu, force = float(p.mass[0]), float(p.grip[0]), float(p.brake[0] * p.mass[0])
    values = {**HEALTHY, **changes}
    centre = (CAR.kerb_mass * CAR.kerb_centre + values["payload"] * values["payloadCentre"]) / mass

    def excess_force(a: float) -> float:
        front = mass * (GRAVITY * (CAR.wheelbase - centre) + a * CAR.centre_height) / CAR.wheelbase
        return (
            min(CAR.front_share * force, mu * front)
            + min((1 - CAR.front_share) * force, mu * (mass * GRAVITY - front))
            - mass * a
        )

    low, high = 0.0, 20.0
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if excess_force(middle) > 0 else (low, middle)
    assert CAR.sumo_type(p).decel[0] == pytest.approx(low, rel=1e-9)


def test_sumo_is_told_what_the_worn_car_can_do() -> None:
    """3900 N of engine on dry road, 0.9 of g times the road's friction on ice; the brakes respond after 0.1 s and a
    step.
    """
    dry, icy = CAR.sumo_type(prepared(1.0)), CAR.sumo_type(prepared(0.1))
    assert dry.accel[0] == pytest.approx(3900 / (1500 + 75))
    assert (icy.accel[0], icy.decel[0]) == pytest.approx((0.09 * GRAVITY, 0.09 * GRAVITY))
    assert dry.actuator_lag[0] == pytest.approx(0.1 + 0.05)


@pytest.mark.slow
def test_stopping_distances_of_worn_tyres_are_in_the_published_ratios_on_a_wet_road_and_equal_on_a_dry_one() -> None:
    """MIRA for RoSPA: +36.8 % from 6.7 to 1.6 mm; MIRA for Continental, from 50 mph: 31.7 m at 3 mm, 39.9 m at 1.6
    mm.
    """
    worn = stopping_distance(1.6)
    assert worn / stopping_distance(6.7) == pytest.approx(1.368, rel=0.01)
    assert worn / stopping_distance(3) == pytest.approx(39.9 / 31.7, rel=0.01)
    assert stopping_distance(8) == pytest.approx(stopping_distance(6.7))
    assert stopping_distance(1.6, wet=False) == pytest.approx(stopping_distance(8, wet=False))
    depths = prepared(0.71, True, treadDepth=np.linspace(0.0, 9, 91)).grip[0]
    assert (np.diff(depths) >= 0).all()
    assert depths[0] > 0


@pytest.mark.parametrize(
    ("weather", "is_wet"),
    [
        ("clear", False),
        ("wet", True),
        ("soft_rain", True),
        ("hard_rain", True),
        ("fog", False),
        ("night", False),
        ({"name": "polished", "road_friction": 0.6, "visibility": 1.0}, False),
        ({"name": "puddles", "road_friction": 1.0, "visibility": 1.0, "wet": True}, True),
    ],
)
def test_tread_counts_where_the_weather_is_wet_and_not_where_friction_is_low(weather: object, is_wet: bool) -> None:
    study = load_study(
        {
            "extends": "wear",
            "name": "one",
            "weather": weather,
            "matrix": {"tests": [{"name": "CPNA", "parameters": {"test": "CPNA", "speed": 40}}]},
        }
    )
    new, worn = evaluate(
        assemble(study), np.array([[8, 1, 0.1, 75, 1.4, 80, 0.05], [1.6, 1, 0.1, 75, 1.4, 80, 0.05]])
    ).metrics["ave_dece"]
    assert (worn < 0.9 * new) == is_wet


SUN = CharacteristicSet.of(load_study("sun"))


def one(lower: float, original: float, upper: float) -> Characteristic:
    return Characteristic(name="c", unit="-", original=original, lower=lower, upper=upper)


@pytest.mark.parametrize(
    ("lower", "upper", "threshold"),
    [
        (2040, 2700, 13.2),  # the worked example of the paper: mass
        (0, 1000, 10),
        (0, 999, 0.02 * 999),
        (0, 100, 2),
        (0, 99, 0.04 * 99),
        (0, 1, 0.04),
        (0, 0.5, 0.04),
    ],
)
def test_threshold_is_a_share_of_the_domains_width(lower: float, upper: float, threshold: float) -> None:
    assert one(lower, upper, upper).threshold == pytest.approx(threshold)


settings_in_domain = arrays(float, (5, 12), elements=st.floats(0, 1)).map(
    lambda share: SUN.lower + share * (SUN.upper - SUN.lower)
)


@given(settings_in_domain)
def test_filter_is_idempotent_and_keeps_or_restores(settings: np.ndarray) -> None:
    filtered = SUN.filter(settings)
    assert np.array_equal(SUN.filter(filtered), filtered)
    assert np.all((filtered == settings) | (filtered == SUN.original))


@pytest.mark.parametrize("value", [1.0, 5000.0, float("nan"), float("inf")])
def test_a_value_outside_the_domain_is_refused(value: float) -> None:
    with pytest.raises(InputError, match=r"mass = .*\nexpected: a number in \[2040, 2700\] kg"):
        SUN.setting({"mass": value}, "--set")
    with pytest.raises(InputError, match=r"\nexpected: a number in \[[\d.]+, [\d.]+\]$"):
        SUN.setting({"tireFric": -abs(value)}, "--set")


def test_a_plausible_value_is_up_to_1000_times_the_largest_of_the_domain_and_positive_if_that_is() -> None:
    values = np.array([1e5, 1.001e5, 0.0, -1e5])
    assert one(0, 50, 100).is_legal(values, beyond=True).tolist() == [True, False, True, True]
    assert one(1, 50, 100).is_legal(values, beyond=True).tolist() == [True, False, False, False]


def test_a_change_of_just_the_threshold_is_noise() -> None:
    """Numbers that are exact in binary: 2 % of a width of 100."""
    exact = CharacteristicSet((one(0, 50, 100),))
    assert exact.filter(np.array([[52.0], [48.0], [52.5], [47.5]])).ravel().tolist() == [50, 50, 52.5, 47.5]
