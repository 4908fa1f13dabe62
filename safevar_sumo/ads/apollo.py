"""Apollo (Baidu): a modular driving system that plans its stop and follows it through a calibration table."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.ads.base import Ads
from safevar_sumo.ads.driver import interpolate_tables
from safevar_sumo.records import BoolArray, Command, FloatArray, Nominal, Observation

WidePositive = Annotated[float, Meta(gt=0, le=1e5)]
HOLDING_DECELERATION = 2.0  # m/s^2, commanded to hold at standstill
TAPER_TIME = 0.3  # s, over which the deceleration fades into the creep
CREEP_MARGIN = 0.1  # m/s, above the creep speed, where the creep begins
LEAST_DISTANCE = 0.05  # m, smallest distance over which a deceleration is planned
FIRST_COMMAND_ROUNDING = 1e-9  # s


class _Memory(NamedTuple):
    """The original vehicle; time between calls; whether it stops; planned deceleration, commanded acceleration,
    creeping time [SI].
    """

    nominal: Nominal
    step: float
    stops: BoolArray
    planned_deceleration: FloatArray
    commanded_acceleration: FloatArray
    creeping_time: FloatArray


class Apollo(Ads, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Cruises, plans a comfortable stop before the obstacle, creeps to the end of the stop and holds.

    Parameters
    ----------
    first_command
        Time from the start of the run to the first command to a standing vehicle [s].
    perception_range
        Largest gap at which it detects obstacles, in clear weather [m].
    cruise_speed, cruise_gain, cruise_acceleration
        Speed to accelerate to [m/s], acceleration per speed error [1/s], and largest acceleration [m/s^2].
    jerk
        Limit on the change of the commanded acceleration [m/s^3].
    stop_gap
        Gap at which the planned deceleration ends [m].
    comfortable_deceleration
        It begins to brake when stopping at `stop_gap` requires this deceleration [m/s^2].
    largest_deceleration
        Largest deceleration that it commands [m/s^2].
    creep_speed, creep_time
        Speed and duration of the final creep, a soft stop with the brake released [m/s, s].
    pedal_lag
        Lag of the pedals assumed in planning [s].
    """

    first_command: Annotated[float, Meta(ge=0)]
    cruise_speed: WidePositive
    cruise_gain: WidePositive
    cruise_acceleration: WidePositive
    jerk: WidePositive
    stop_gap: Annotated[float, Meta(ge=0)]
    comfortable_deceleration: WidePositive
    largest_deceleration: WidePositive
    creep_speed: Annotated[float, Meta(ge=0)]
    creep_time: Annotated[float, Meta(ge=0)]
    pedal_lag: Annotated[float, Meta(ge=0)]
    perception_range: WidePositive = 100.0

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        zeros = np.zeros(n)
        return _Memory(
            nominal,
            step,
            stops=zeros > 0,
            planned_deceleration=zeros,
            commanded_acceleration=zeros,
            creeping_time=zeros,
        )

    def drive(self, seen: Observation, memory: _Memory) -> tuple[Command, _Memory]:
        plan = self._plan(seen, memory)
        command = self._pedals(seen, plan)
        if seen.time >= self.first_command - FIRST_COMMAND_ROUNDING:
            return command, plan
        is_waiting = seen.speed == 0
        array_fields = (np.where(is_waiting, old, new) for old, new in zip(memory[2:], plan[2:], strict=True))
        return Command(*(np.where(is_waiting, 0.0, pedal) for pedal in command)), _Memory(
            memory.nominal, memory.step, *array_fields
        )

    def _plan(self, seen: Observation, memory: _Memory) -> _Memory:
        """Plan an acceleration: cruise, or brake with v^2 / (2 d) to stop within the distance d; then creep and
        hold.
        """
        speed = seen.speed
        is_detected = seen.gap <= self.perception_range * seen.visibility
        distance = np.where(is_detected, np.minimum(seen.gap, self.perception_range) - self.stop_gap, np.inf)
        needed_deceleration = speed * speed / (2 * np.maximum(distance, LEAST_DISTANCE))
        # The onset allows for the distance lost by the lag of the pedals and while the deceleration rises at the jerk
        # limit.
        lost_distance = speed * (self.pedal_lag + 0.5 * self.comfortable_deceleration / self.jerk)
        planned_deceleration = speed * speed / (2 * np.maximum(distance - lost_distance, LEAST_DISTANCE))
        begins_braking = (planned_deceleration > self.comfortable_deceleration) & ~memory.stops
        stops = memory.stops | begins_braking
        last_acceleration, largest_change = memory.commanded_acceleration, np.array(self.jerk * memory.step)
        if np.count_nonzero(begins_braking):
            # Planning is continuous in time: braking began within the last step, when the needed deceleration passed
            # the limit.
            rise = np.maximum(planned_deceleration - memory.planned_deceleration, 1e-9)
            share = np.where(
                begins_braking, np.minimum((planned_deceleration - self.comfortable_deceleration) / rise, 1.0), 1.0
            )
            last_acceleration = np.where(begins_braking, np.minimum(last_acceleration, 0.0), last_acceleration)
            largest_change = largest_change * share

        braking = np.minimum(needed_deceleration, self.largest_deceleration)
        braking = np.minimum(braking, np.maximum(speed - self.creep_speed, 0.0) / TAPER_TIME)
        cruising = np.minimum(self.cruise_gain * (self.cruise_speed - speed), self.cruise_acceleration)
        change = np.where(stops, -braking, cruising) - last_acceleration
        acceleration = last_acceleration + np.minimum(np.maximum(change, -largest_change), largest_change)

        is_creeping = stops & (speed < self.creep_speed + CREEP_MARGIN)
        creeping_time = memory.creeping_time + memory.step * is_creeping
        acceleration[is_creeping] = 0.0
        acceleration[creeping_time > self.creep_time] = -HOLDING_DECELERATION
        return memory._replace(
            stops=stops,
            planned_deceleration=planned_deceleration,
            commanded_acceleration=acceleration,
            creeping_time=creeping_time,
        )

    def _pedals(self, seen: Observation, memory: _Memory) -> Command:
        """Pedals for the commanded acceleration, from the calibration table of the original vehicle."""
        nominal = memory.nominal
        coasting, full_throttle = interpolate_tables(
            nominal.speeds, seen.speed, nominal.coasting, nominal.full_throttle
        )
        excess = memory.commanded_acceleration + coasting
        throttle = np.minimum(np.maximum(excess / (full_throttle + coasting), 0.0), 1.0)
        brake = np.minimum(np.maximum(-excess / nominal.braking, 0.0), 1.0)
        throttle[memory.stops], brake[~memory.stops] = 0.0, 0.0
        return Command(throttle, brake)
