"""The robot that holds the speed of a test until the system under test acts, as in tests by Euro
NCAP.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safevar_sumo.records import BoolArray, Command, clip_to_share
from safevar_sumo.scenarios import Point
from safevar_sumo.scenarios.tracks import KMH
from safevar_sumo.sumo.perception import of_vehicles
from safevar_sumo.vehicles import Vehicle, VehicleState
from safevar_sumo.vehicles.base import Prepared, State

# Tolerances of the test speed until the system brakes [m/s]: +1.0 and -0.5 km/h (Euro NCAP, AEB
# test protocols, "test execution").
MAX_ERROR = 1.0 * KMH
MIN_ERROR = -0.5 * KMH
# With these gains `carla` is within 0.1 km/h 3 s after a pedal error of 0.15.
PROPORTIONAL_GAIN = 1.0  # pedal per m/s
INTEGRAL_GAIN = 1.0  # pedal per m
ACTION_THRESHOLD = 0.03
"""Change of the pedal towards braking by which the system acts [-]: it changes the acceleration by
about 0.3 m/s^2, at which Euro NCAP sees the onset of an AEB.
"""


class DrivingRobot:
    """Holds N vehicles at the speeds of their tests, by accelerator and brake and in their initial
    gear.

    The robot drives as long as the system under test neither brakes nor eases off an accelerator
    that the system had pressed. Once the system has braked, it controls the vehicle and its
    automatic gearbox. Euro NCAP (AEB car-to-car, "test execution") requires a steady speed and
    allows a cruise control; an automatic gearbox is in D, a manual one in the highest gear of at
    least 1,500 r/min. The robot holds the gear, since a gearbox that hunts between two gears would
    not keep the speed steady.

    Parameters
    ----------
    points
        Scenario points, each with an equal part of the vehicles; the robot drives only where the
        scenario has a `test_speed`.
    vehicle, prepared, state
        The vehicle model, its prepared settings, and the state at the start; the pedals in this
        state hold the speed.
    step
        Time between two commands [s].
    """

    def __init__(
        self,
        points: Sequence[Point],
        vehicle: Vehicle,
        prepared: Prepared,
        state: VehicleState,
        step: float,
    ) -> None:
        n = len(state.speed)
        # A scenario that is no test has no speed.
        test_speeds = [point.scenario.test_speed for point in points]
        self._test_speed = of_vehicles(test_speeds, n // len(points))
        has_test_speed = ~np.isnan(self._test_speed)
        self._is_driving = has_test_speed
        self._prepared = prepared
        self._vehicle = vehicle
        self._start_pedal = state.throttle - state.brake
        self._brake_threshold = state.brake + ACTION_THRESHOLD
        self._step = step
        self._integral = np.zeros(n)
        self._has_braked = ~has_test_speed
        self._max_system_pedal = np.full(n, -np.inf)
        self.error = np.where(has_test_speed, 0.0, np.nan)
        """Deviation from the test speed while the robot drove [m/s], shape (N,): the deviation that
        was largest relative to its tolerance; NaN without a test.
        """
        # The error over its tolerance [-]: the tolerances of higher and lower speeds differ.
        self._error_share = np.zeros(n)

    def drive(
        self, command: Command, state: State, is_open: BoolArray
    ) -> tuple[Command, State]:
        """The robot's command while it drives a vehicle, and the system's command afterwards; and
        the state, with the gear held while the robot drives.

        `is_open` is true for runs that have not ended; speeds of other runs are not compared with
        the tolerance.
        """
        # Once all systems have braked, the robot has nothing to do.
        if self._has_braked.all():
            return command, state

        error = np.where(self._is_driving, state.speed - self._test_speed, 0.0)
        error_share = np.where(error > 0, error / MAX_ERROR, error / MIN_ERROR)
        is_larger = is_open & (error_share > self._error_share)
        np.copyto(self.error, error, where=is_larger)
        np.copyto(self._error_share, error_share, where=is_larger)

        # Some systems release the accelerator before they brake: this counts as acting, too.
        self._has_braked |= command.brake > self._brake_threshold
        system_pedal = command.throttle - command.brake
        self._max_system_pedal = np.maximum(self._max_system_pedal, system_pedal)
        self._is_driving = ~self._has_braked & (
            system_pedal
            >= np.minimum(self._max_system_pedal, self._start_pedal) - ACTION_THRESHOLD
        )

        error = np.where(self._is_driving, error, 0.0)
        self._integral = np.clip(
            self._integral - error * self._step, -1 / INTEGRAL_GAIN, 1 / INTEGRAL_GAIN
        )
        pedal = (
            self._start_pedal
            - PROPORTIONAL_GAIN * error
            + INTEGRAL_GAIN * self._integral
        )
        robot_command = Command(
            np.where(
                self._is_driving,
                clip_to_share(pedal),
                command.throttle,
            ),
            np.where(
                self._is_driving,
                clip_to_share(-pedal),
                command.brake,
            ),
        )
        return robot_command, self._vehicle.hold_gear(
            self._prepared, state, self._is_driving
        )

    @property
    def invalid(self) -> BoolArray:
        """Whether each vehicle left the tolerance of its test speed before the system acted, shape
        (N,).
        """
        return self._error_share > 1
