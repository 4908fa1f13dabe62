"""The robot that drives a test at its speed until the system under test acts, as Euro NCAP's tests are driven."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safevar_sumo.records import BoolArray, Command, FloatArray
from safevar_sumo.scenarios import Point
from safevar_sumo.scenarios.euro_ncap import KMH
from safevar_sumo.vehicles import Vehicle, VehicleState

TOO_FAST, TOO_SLOW = 1.0 * KMH, -0.5 * KMH
"""Tolerance of a test's speed until the system brakes [m/s]: +1.0 and -0.5 km/h (Euro NCAP, test protocols of AEB, test execution)."""
PROPORTIONAL, INTEGRAL = 1.0, 1.0
"""Gains of the robot [pedal per m/s, pedal per m]: chosen, so that `carla` is within 0.1 km/h 3 s after its pedal stood 0.15 off."""
ACTS = 0.03
"""Pedal below what holds the speed at which the system acts [-]: about 0.3 m/s^2, at which Euro NCAP has an AEB begin."""


class DrivingRobot:
    """Holds N vehicles at the speeds of their tests by accelerator and brake, in the gear that they begin in.

    It drives as long as the system under test neither brakes nor lets up on an accelerator that it had pressed; once the system
    has braked, the vehicle and its automatic gearbox are the system's own. Euro NCAP (test protocol AEB car-to-car, "test execution")
    has an automatic driven in D at a steady speed, a manual one in the highest gear of at least 1,500 r/min, and allows a cruise
    control for the speed: a gearbox that hunts between two gears at a steady speed would be no test.

    Parameters
    ----------
    points
        Of which every one has its part of the vehicles; without a `test_speed` of their scenario there is no robot.
    vehicle, prepared, state
        The vehicles, and their state at the start: the pedals that hold the speed there are where the robot begins.
    step
        Time between two commands [s].
    """

    def __init__(self, points: Sequence[Point], vehicle: Vehicle, prepared: Any, state: VehicleState, step: float) -> None:
        n = len(state.speed)
        speeds = [getattr(point.scenario, "test_speed", None) for point in points]
        self._target = np.repeat([np.nan if speed is None else speed for speed in speeds], n // len(points))
        self.tested: BoolArray = ~np.isnan(self._target)
        """Whose scenario is a test at a speed."""
        self._drives = self.tested.copy()
        self._any = bool(self.tested.any())
        self._prepared, self._hold_gear = prepared, getattr(vehicle, "hold_gear", None)
        self._pedal, self._least_brake = state.throttle - state.brake, state.brake + ACTS
        self._step, self._integral = step, np.zeros(n)
        self._braked, self._most = ~self.tested, np.full(n, -np.inf)
        self.error = np.where(self.tested, 0.0, np.nan)
        """The deviation from the test's speed that was worst beside the tolerance, while the robot acted [m/s]; NaN without a test."""

    def drive(self, command: Command, state: Any, open_: BoolArray) -> tuple[Command, Any]:
        """What is commanded instead of a system's command while the robot acts, and the state with the gear held there.

        `open_` are the runs that are not over: only they are held against the tolerance.
        """
        if not self._any:
            return command, state
        error = np.where(self._drives, state.speed - self._target, 0.0)
        self.error = np.where(open_ & (_share(error) > _share(self.error)), error, self.error)
        self._braked |= command.brake > self._least_brake
        asked = command.throttle - command.brake
        self._most = np.maximum(self._most, asked)
        self._drives = ~self._braked & (asked >= np.minimum(self._most, self._pedal) - ACTS)
        error = np.where(self._drives, error, 0.0)
        self._integral = np.minimum(np.maximum(self._integral - error * self._step, -1 / INTEGRAL), 1 / INTEGRAL)
        pedal = self._pedal - PROPORTIONAL * error + INTEGRAL * self._integral
        held = Command(np.where(self._drives, np.minimum(np.maximum(pedal, 0.0), 1.0), command.throttle),
                       np.where(self._drives, np.minimum(np.maximum(-pedal, 0.0), 1.0), command.brake))
        return held, state if self._hold_gear is None else self._hold_gear(self._prepared, state, self._drives)

    @property
    def invalid(self) -> BoolArray:
        """Which tests left the tolerance before the system acted."""
        return self.tested & (_share(self.error) > 1)


def _share(error: FloatArray) -> FloatArray:
    """An error over what the tolerance allows in its direction; 0 without a test."""
    return np.nan_to_num(np.where(error > 0, error / TOO_FAST, error / TOO_SLOW))
