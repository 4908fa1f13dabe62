"""What bad weather keeps from an ADS, for how long, and how it makes it hesitate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safevar_sumo.ads import ADS, GuardedAds, PerVehicle, ScalarAds
from safevar_sumo.plugins import Guard
from safevar_sumo.records import Command, Nominal, Observation
from safevar_sumo.scenarios.base import Scene
from safevar_sumo.study import Weather, load_study
from safevar_sumo.sumo.matrix import simulate
from safevar_sumo.sumo.perception import Perception
from safevar_sumo.sumo.system import assemble

STEP = 0.05
TIMES = np.arange(12) * STEP


def observed(delay: float) -> tuple[np.ndarray, np.ndarray]:
    """Own speeds and (gap, closing speed, lateral, lateral speed) as seen over time, of one vehicle whose scene changes steadily."""
    perception = Perception(Weather(name="any", road_friction=1.0, visibility=0.7, recognition_delay=delay), STEP)
    seen = []
    for time in TIMES:
        scene = Scene(np.array([20 - 5 * time]), np.array([-3 + 2 * time]), np.array([2 + time]), np.zeros(1, dtype=bool))
        seen.append(perception.observe(float(time), np.array([5 + time]), scene))
    assert all(one.visibility == 0.7 for one in seen)
    return (np.array([one.speed[0] for one in seen]),
            np.array([[values[0] for values in (one.gap, one.closing_speed, one.lateral, one.lateral_speed)] for one in seen]))


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.0863, 0.1, 0.15])
def test_the_scene_is_seen_late_and_the_own_speed_at_once(delay: float) -> None:
    speed, scene = observed(delay)
    then = np.maximum(TIMES - delay, 0.0)
    assert speed == pytest.approx(5 + TIMES)
    if delay in (0.05, 0.15):
        assert np.array_equal(scene[4:], observed(0.0)[1][4 - round(delay / STEP):-round(delay / STEP)]), "whole steps are exact"
    assert scene == pytest.approx(np.stack([20 - 5 * then, 5 + then, -3 + 2 * then, 2 + then], axis=1))


def test_what_appears_between_two_steps_is_not_there_yet() -> None:
    perception = Perception(Weather(name="any", road_friction=1.0, visibility=1.0, recognition_delay=0.03), STEP)
    nothing = np.zeros(1)
    gaps = [perception.observe(time, nothing, Scene(np.array([gap]), nothing, nothing, nothing > 0)).gap[0]
            for time, gap in zip(TIMES.tolist(), [np.inf, np.inf, 5.0, 4.0], strict=False)]
    assert gaps == pytest.approx([np.inf, np.inf, np.inf, 4.6])


def pressed(hesitation: float, wanted: list[float]) -> list[float]:
    """How hard one vehicle brakes that wants to brake so hard."""
    perception = Perception(Weather(name="any", road_friction=1.0, visibility=1.0, hesitation=hesitation), STEP)
    return [float(perception.braked(Command(np.ones(1), np.array([brake]))).brake[0]) for brake in wanted]


def test_who_hesitates_brakes_later_and_lets_go_at_once() -> None:
    wanted = [0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.2, 0.0, 0.0]
    assert pressed(0.0, wanted) == wanted
    assert pressed(0.1, wanted) == [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.2, 0.0, 0.0]
    assert pressed(0.12, wanted) == pytest.approx([0.0, 0.0, 0.0, 0.0, 0.6, 1.0, 1.0, 0.2, 0.0, 0.0])


class Careful:
    """An ADS from outside that writes its commands into the same arrays again and again."""

    def start(self, n: int, nominal: Nominal, step: float) -> Command:
        return Command(np.zeros(n), np.zeros(n))

    def drive(self, seen: Observation, memory: Command) -> tuple[Command, Command]:
        memory.throttle[:], memory.brake[:] = np.where(seen.gap < 6, 0.0, 0.6), seen.gap < 6
        return memory, memory


class CarefulForOne(ScalarAds):
    """The same for one vehicle."""

    def drive(self, seen: Observation) -> tuple[float, float]:
        return (0.0, 1.0) if seen.gap < 6 else (0.6, 0.0)


def test_anybodys_ads_hesitates_whatever_it_does_with_its_arrays() -> None:
    rain, guard = assemble(load_study("rain")), Guard("a test", "ads")
    assert rain.weather.hesitation > 0
    settings = np.tile(rain.characteristics.original, (3, 1))
    guarded = GuardedAds(Careful(), guard), PerVehicle(CarefulForOne, guard)
    many, each = (simulate(replace(rain, ads=ads), settings).trace for ads in guarded)
    assert np.array_equal(many.brake, each.brake)
    assert np.array_equal(many.speed, each.speed)
    released, braked = (int(np.argmax(column)) for column in (many.gap[:, 0] < 6, many.brake[:, 0] == 1))
    assert braked - released == np.ceil(rain.weather.hesitation / many.step)


@pytest.mark.parametrize("name", ["competent_driver", "full_braking", "fuzzy_safety", "r157", "rss"])
def test_a_driver_with_reactions_of_its_own_does_not_wait_like_world_on_rails(name: str) -> None:
    """The study rain is sun but for its weather, of which nothing but the reactions differs from clear: these drive as in sun."""
    rain, sun = (assemble(load_study(study)) for study in ("rain", "sun"))
    driver = ADS[name](cruise_speed=5.5)
    wet, dry = (simulate(replace(one, ads=driver), one.characteristics.original[np.newaxis]).trace for one in (rain, sun))
    assert dry.brake.max() > 0
    assert np.array_equal(wet.position, dry.position)


@pytest.mark.parametrize("of_its_own", [True, False])
def test_an_ads_from_outside_may_have_reactions_of_its_own_too(of_its_own: bool) -> None:
    rain, guard = assemble(load_study("rain")), Guard("a test", "ads")
    own = type("Own", (Careful,), {"own_reactions": of_its_own})
    trace = simulate(replace(rain, ads=GuardedAds(own(), guard)), rain.characteristics.original[np.newaxis]).trace
    assert (int(np.argmax(trace.brake[:, 0] > 0)) == int(np.argmax(trace.gap[:, 0] < 6))) == of_its_own
