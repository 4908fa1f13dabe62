"""Checks that a study can judge its ADS: on an empty road, the original vehicle must drive to the
place of the encounter.
"""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import SimulationError
from safevar_sumo.records import Outcome, SimulationRuns
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import System

MIN_PEDAL = 0.03
"""Position of the brake pedal above which the vehicle brakes [-], as for the robot of tests by Euro
NCAP (`driving_robot.py`).
"""
MIN_SLOWDOWN = 2.0
"""Loss of speed above which braking counts as a fault [m/s]: cruise controls brake to hold a speed,
some with a fully pressed pedal.
"""
SLOW_APPROACH = 0.5
"""Closing speed below which a vehicle only follows the obstacle [m/s]: such a vehicle need not
reach the obstacle within a test.
"""


class Reason(StrEnum):
    """Why a drive on an empty road leads to no encounter: the ADS brakes; the vehicle never gets
    there; or it is late, because others have left or stay beside its way.
    """

    BRAKES = "brakes"
    LATE = "late"
    STANDS = "stands"


class EmptyRoadFault(NamedTuple):
    """A fault of the original vehicle on an empty road: its kind, and words that follow the subject
    of a sentence ("brakes without an obstacle").
    """

    reason: Reason
    words: str


def why_no_verdict(system: System) -> str:
    """The reason why simulations tell nothing about the ADS, as a sentence; "" if they tell
    something.
    """
    return sentence_on(find_problems(system), len(system.points))


def find_problems(system: System) -> dict[str, EmptyRoadFault]:
    """The faults that keep the original vehicle from the encounter, by the name of the point.

    At every point the original vehicle drives once with an ADS that sees nobody, as on an empty
    road. If it does not reach the place of the encounter before the encounter is over, or brakes on
    its way, it would avoid a collision without reacting to the obstacle.
    """
    # A simulator of the user's own cannot be told that nobody is there.
    if not system.mover.has("a driving system"):
        return {}
    original = system.characteristics.original_settings
    try:
        results = simulate_all_points(replace(system, sees_nobody=True), original)
    # The study's own simulations will report the error.
    except SimulationError:
        return {}
    problems = {}
    for point, _, runs in results:
        if not point.scenario.brakes_fully:
            problem = _problem(runs, point.scenario.test_speed)
            if problem is not None:
                problems[point.name] = problem
    return problems


def sentence_on(problems: dict[str, EmptyRoadFault], n_points: int) -> str:
    """A sentence on the first problem, and the number of points that have a problem of the same
    kind; "" without problems.
    """
    if not problems:
        return ""
    point, problem = next(iter(problems.items()))
    count = sum(fault.reason is problem.reason for fault in problems.values())
    place = ""
    if n_points > 1:
        place = f" at {count} of {n_points} points, such as {point}"
    return (
        f"On a first drive, with nobody in sight, the original vehicle {problem.words}{place}. So"
        " its drives with somebody in sight do not show how it reacts to them: no verdict."
    )


def _problem(runs: SimulationRuns, test_speed: float | None) -> EmptyRoadFault | None:
    """The fault of the original vehicle, the only one in `runs`, on an empty road; None if it has
    driven as it should.

    A vehicle that still has its test speed at the end, and closes in on nobody, has driven as it
    should. A vehicle that still has its first speed when the others have left is late.
    """
    # The sample after the last active one ended the run.
    trace = runs.trace
    end = np.count_nonzero(trace.active) + 1
    gap, lateral, speed, position, throttle, brake, obstacle_speed, obstacle_width = (
        column[:end, 0]
        for column in (
            trace.gap,
            trace.lateral,
            trace.speed,
            trace.position,
            trace.throttle,
            trace.brake,
            trace.obstacle_speed,
            trace.obstacle_width,
        )
    )

    # Braking that only holds a speed, as cruise controls do, is no fault.
    is_slower = speed < np.maximum.accumulate(speed) - MIN_SLOWDOWN
    if (is_slower & (brake > MIN_PEDAL)).any():
        return EmptyRoadFault(Reason.BRAKES, "brakes without an obstacle")

    last_gap = gap[-1]
    last_speed = speed[-1]
    approach = last_speed - obstacle_speed[-1]
    is_alone = not np.isfinite(last_gap) or approach < SLOW_APPROACH
    keeps_speed = test_speed is not None and last_speed > test_speed - MIN_SLOWDOWN
    if runs.outcome[0] == Outcome.COLLISION:
        return None

    # A vehicle that drives past somebody who stays beside its way has met nobody.
    beside = np.abs(lateral) - (trace.vehicle_width + obstacle_width) / 2
    stays_beside = (beside > 0).all() and beside[-1] >= beside[-2:][0]
    if last_gap <= 0 and stays_beside:
        return EmptyRoadFault(
            Reason.LATE,
            "meets nobody: whoever is there stays beside its way, and comes no nearer to it",
        )
    if last_gap <= 0 or (keeps_speed and is_alone):
        return None

    driven = position[-1] - position[0]
    distance = f"{driven:.1f}"
    if np.isfinite(last_gap):
        distance += f" of {driven + last_gap:.1f}"
    slow_speed = max(speed[0], MIN_SLOWDOWN) - SLOW_APPROACH
    if runs.outcome[0] == Outcome.PASSED and last_speed > slow_speed:
        words = f"is late for the encounter: the others have left after {trace.time[end - 1]:.1f} s"
        return EmptyRoadFault(
            Reason.LATE,
            f"{words}, when it has come {distance} m at {last_speed:.1f} m/s",
        )
    commanded = (
        f"with at most {throttle.max():.2g} of the throttle and {brake.max():.2g} of the"
        " brake"
    )
    return EmptyRoadFault(
        Reason.STANDS,
        f"never reaches the encounter (it gets {distance} m, {commanded})",
    )
