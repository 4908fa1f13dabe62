"""Many encounters at once: a vehicle without drag or lag, and a point mass that obeys a driver's
rule.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.ads import Ads
from safevar_sumo.records import SimulationRuns
from safevar_sumo.scenarios import Point, TrackScenario
from safevar_sumo.sumo.drive import drive
from safevar_sumo.sumo.lane_world import LaneWorld
from safevar_sumo.sumo.system import System
from safevar_sumo.sumo.traffic import Traffic
from safevar_sumo.vehicles import calibration_drive
from tests.support.planted import Block, Prepared

STEP = 0.05


class Ideal(Block):
    """A vehicle without drag or lag: the pedals are accelerations of up to 3 and 9.9 m/s^2."""

    UNITS: Mapping[str, str] = {}

    def prepare(
        self, characteristics: Any, road_friction: Any, step: float, *_: Any
    ) -> Prepared:
        n = len(next(iter(characteristics.values())))
        return Prepared(np.full(n, 9.9), step)


def ideal(system: System) -> System:
    """A system with the vehicle without drag or lag."""
    vehicle = Ideal()
    return replace(
        system,
        vehicle=vehicle,
        nominal=calibration_drive(vehicle, system.characteristics),
    )


def met_at_once(
    system: System, scenario: TrackScenario, ads: Ads, n: int
) -> SimulationRuns:
    """Runs of the original vehicle in N encounters, whose parameters are arrays."""
    samples = round(float(np.max(scenario.duration)) / STEP) + 1
    points = (Point(scenario, system.points[0].weather),)
    traffic = Traffic(
        points, np.arange(n), n_encounters=n, n_samples=samples, step=STEP
    )
    settings = np.tile(system.characteristics.original, (n, 1))
    world = LaneWorld(traffic, STEP)
    return drive(replace(system, ads=ads, points=points), settings, world, traffic)


class Mass(NamedTuple):
    """How N point masses meet another car: whether the front hits it, at which closing speed [m/s],
    and the least gap in the path [m].
    """

    hits: Any
    speed: Any
    least: Any


def point_mass(
    v: Any,
    gap: Any,
    other: Callable[..., Any],
    rule: Callable[..., Any],
    beside: Any = 0.0,
    released: float = 0.0,
) -> Mass:
    """A driver's rule, integrated in fine steps. He keeps his speed until he sees a danger,
    releases the accelerator for 0.75 s, and then never speeds up again: his deceleration
    rises at 12.65 m/s^3 to that of the rule.

    `rule` says from time, both speeds, gap and own acceleration whether there is a danger, and how
    hard he brakes; `other` is the other car's speed, `beside` how long it stays beside the path
    [s].
    """
    step = 0.005
    braking = acceleration = impact = 0.0 * v
    hits = v < 0
    danger = least = v + np.inf
    for time in np.arange(0.0, 40.0, step):
        is_dangerous, hardest = rule(time, v, other(time), gap, acceleration)
        danger = np.where(is_dangerous, np.minimum(danger, time), danger)
        before = np.where(
            time >= danger, np.minimum(np.maximum(braking, released), hardest), 0.0
        )
        rising = np.minimum(before + 12.65 * step, hardest)
        braking = np.where(time >= danger + 0.75, rising, before)
        acceleration = -(before + braking) / 2
        after = np.maximum(v + acceleration * step, 0.0)
        then = gap + (other(time) + other(time + step) - v - after) / 2 * step
        touches = (time >= beside) & (gap > 0) & (then <= 0) & ~hits
        impact = np.where(touches, after - other(time + step), impact)
        hits = hits | touches
        least = np.where((time >= beside) & (then > -9), np.minimum(least, then), least)
        v, gap = after, then
        if not v.any():
            break
    return Mass(hits, impact, least)


def agreement(runs: SimulationRuns, expected: Mass, path: float) -> tuple[Any, Any]:
    """Where outcomes are equal; and by how much gaps [m], or the closing speeds of two collisions
    [m/s], differ, of cars whose middles are less than `path` [m] aside when they are in the path.
    """
    hits = runs.outcome == "collision"
    closing = runs.collision_speed - runs.contact.speed
    is_in_path = runs.trace.active & (np.abs(runs.trace.lateral) < path)
    gap = np.where(is_in_path, runs.trace.gap, np.inf).min(axis=0)
    with np.errstate(invalid="ignore"):  # nobody is ever in the path
        late = np.nan_to_num(
            np.where(hits, closing - expected.speed, expected.least - gap)
        )
    return hits == expected.hits, late
