"""The robot that holds the speed of a test until the system under test acts, as in Euro NCAP's tests."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safevar_sumo.records import BoolArray, Command, FloatArray
from safevar_sumo.scenarios import Point
from safevar_sumo.scenarios.euro_ncap import KMH
from safevar_sumo.vehicles import Vehicle, VehicleState

TOO_FAST, TOO_SLOW = 1.0 * KMH, -0.5 * KMH
"""Tolerance of the test speed until the system brakes [m/s]: +1.0 and -0.5 km/h (Euro NCAP, test protocols of AEB, test execution)."""
PROPORTIONAL, INTEGRAL = 1.0, 1.0
"""Gains of the robot [pedal per m/s, pedal per m], chosen so that `carla` is within 0.1 km/h 3 s after a pedal error of 0.15."""
ACTS = 0.03
"""Pedal change below the holding pedal that counts as the system acting [-]: about 0.3 m/s^2, Euro NCAP's onset of an AEB."""


class DrivingRobot:
    """Holds N vehicles at the speeds of their tests by accelerator and brake, in their initial gear.

    It drives as long as the system under test neither brakes nor eases off an accelerator that it had pressed; once the system
    has braked, it controls the vehicle and its automatic gearbox. Euro NCAP (test protocol AEB car-to-car, "test execution")
    requires a steady speed, with an automatic gearbox in D and a manual one in the highest gear of at least 1,500 r/min, and allows a
    cruise control; the robot holds the gear, as a gearbox that hunts between two gears would not keep the speed steady.

    Parameters
    ----------
    points
        Points, each with an equal part of the vehicles; the robot drives only where the scenario has a `test_speed`.
    vehicle, prepared, state
        The vehicles, and their state at the start, whose pedals hold the speed and are the robot's first command.
    step
        Time between two commands [s].
    """

    def __init__(self, points: Sequence[Point], vehicle: Vehicle, prepared: Any, state: VehicleState, step: float) -> None:
        n = len(state.speed)
        speeds = [getattr(point.scenario, "test_speed", None) for point in points]
        self._target = np.repeat([np.nan if speed is None else speed for speed in speeds], n // len(points))
        self.tested: BoolArray = ~np.isnan(self._target)
        """Which vehicles are in a test at a speed."""
        self._drives = self.tested.copy()
        self._any = bool(self.tested.any())
        self._prepared, self._hold_gear = prepared, getattr(vehicle, "hold_gear", None)
        self._pedal, self._least_brake = state.throttle - state.brake, state.brake + ACTS
        self._step, self._integral = step, np.zeros(n)
        self._braked, self._most = ~self.tested, np.full(n, -np.inf)
        self.error = np.where(self.tested, 0.0, np.nan)
        """Largest deviation from the test speed, relative to the tolerance, while the robot acted [m/s]; NaN without a test."""

    def drive(self, command: Command, state: Any, open_: BoolArray) -> tuple[Command, Any]:
        """The robot's command in place of the system's while the robot acts, and the state with the gear held.

        `open_` are the runs that are not over: only they are checked against the tolerance.
        """
        if not self._any:
            return command, state
        error = np.where(self._drives, state.speed - self._target, 0.0)
        self.error = np.where(open_ & (_share(error) > _share(self.error)), error, self.error)
        self._braked |= command.brake > self._least_brake
        wanted = command.throttle - command.brake
        self._most = np.maximum(self._most, wanted)
        self._drives = ~self._braked & (wanted >= np.minimum(self._most, self._pedal) - ACTS)
        error = np.where(self._drives, error, 0.0)
        self._integral = np.minimum(np.maximum(self._integral - error * self._step, -1 / INTEGRAL), 1 / INTEGRAL)
        pedal = self._pedal - PROPORTIONAL * error + INTEGRAL * self._integral
        robot = Command(np.where(self._drives, np.minimum(np.maximum(pedal, 0.0), 1.0), command.throttle),
                       np.where(self._drives, np.minimum(np.maximum(-pedal, 0.0), 1.0), command.brake))
        return robot, state if self._hold_gear is None else self._hold_gear(self._prepared, state, self._drives)

    @property
    def invalid(self) -> BoolArray:
        """Which tests left the tolerance before the system acted; shape (N,)."""
        return self.tested & (_share(self.error) > 1)


def _share(error: FloatArray) -> FloatArray:
    """A speed error over the tolerance in its direction [-]; 0 without a test."""
    return np.nan_to_num(np.where(error > 0, error / TOO_FAST, error / TOO_SLOW))
