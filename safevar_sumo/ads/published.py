"""The two driving systems of the published study: Apollo, a modular system, and World On Rails, an
end-to-end policy.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta

from safevar_sumo.ads.base import Ads, DelayLine
from safevar_sumo.records import (
    KMH_PER_MS,
    BoolArray,
    Command,
    FloatArray,
    Nominal,
    Observation,
    clip_to_share,
)
from safevar_sumo.study import Proportion, Table

WidePositive = Annotated[float, Meta(gt=0, le=1e5)]
NonNegative = Annotated[float, Meta(ge=0)]
# m/s^2. Apollo commands this deceleration to hold the vehicle at standstill.
HOLDING_DECELERATION = 2.0
# s. Above the creep speed, Apollo brakes with at most the excess of speed divided by this time.
TAPER_TIME = 0.3
# m/s. The creep begins when the speed is less than this margin above the creep speed.
CREEP_MARGIN = 0.1
# m. The planned deceleration divides by the distance: without this lower bound it could be 0.
LEAST_STOPPING_DISTANCE = 0.05
# m/s^2. The rise of the needed deceleration is a divisor: without this lower bound it could be 0.
LEAST_RISE = 1e-9
# s. Largest rounding error of the time at which the first command is due.
FIRST_COMMAND_ROUNDING = 1e-9


class _ApolloMemory(NamedTuple):
    """What `Apollo` remembers of N vehicles; arrays have shape (N,).

    Attributes
    ----------
    nominal, step
        The original vehicle, and the time between two calls of `drive` [s].
    has_begun_to_stop
        Whether the vehicle has begun to brake for its stop. Such a vehicle stops for good.
    needed_after_lag
        The deceleration needed for the stop after the lag of the pedals [m/s^2]. This deceleration
        decides when braking begins.
    commanded_acceleration
        Acceleration of the last command [m/s^2].
    creeping_time
        Time for which the vehicle has crept so far [s].
    """

    nominal: Nominal
    step: float
    has_begun_to_stop: BoolArray
    needed_after_lag: FloatArray
    commanded_acceleration: FloatArray
    creeping_time: FloatArray


class Apollo(Ads, Table, frozen=True, kw_only=True):
    """Apollo (Baidu): plans its stop and follows it through a calibration table.

    Cruises, plans a comfortable stop before the obstacle, creeps to the end of the stop and holds.

    Parameters
    ----------
    first_command
        Time from the start of the run to the first command to a standing vehicle [s].
    perception_range
        Largest gap at which Apollo detects obstacles, in clear weather [m].
    cruise_speed, cruise_gain, cruise_acceleration
        Speed to accelerate to [m/s], acceleration per speed error [1/s], and largest acceleration
        [m/s^2].
    jerk
        Limit on the change of the commanded acceleration [m/s^3].
    stop_gap
        Gap at which the planned deceleration ends [m].
    comfortable_deceleration
        Apollo begins to brake when stopping at `stop_gap` requires this deceleration [m/s^2].
    largest_deceleration
        Largest deceleration that Apollo commands [m/s^2].
    creep_speed, creep_time
        Speed and duration of the final creep, a soft stop with the brake released [m/s, s].
    pedal_lag
        Lag of the pedals assumed in planning [s].
    """

    first_command: NonNegative
    cruise_speed: WidePositive
    cruise_gain: WidePositive
    cruise_acceleration: WidePositive
    jerk: WidePositive
    stop_gap: NonNegative
    comfortable_deceleration: WidePositive
    largest_deceleration: WidePositive
    creep_speed: NonNegative
    creep_time: NonNegative
    pedal_lag: NonNegative
    perception_range: WidePositive = 100.0

    def start(self, n: int, nominal: Nominal, step: float) -> _ApolloMemory:
        zeros = np.zeros(n)
        return _ApolloMemory(
            nominal,
            step,
            has_begun_to_stop=np.zeros(n, bool),
            needed_after_lag=zeros,
            commanded_acceleration=zeros,
            creeping_time=zeros,
        )

    def drive(
        self, observation: Observation, memory: _ApolloMemory
    ) -> tuple[Command, _ApolloMemory]:
        plan = self._plan(observation, memory)
        pedals = self.pedals(
            plan.commanded_acceleration, observation.speed, memory.nominal
        )
        stops = plan.has_begun_to_stop
        command = Command(
            np.where(stops, 0.0, pedals.throttle), np.where(stops, pedals.brake, 0.0)
        )
        if observation.time >= self.first_command - FIRST_COMMAND_ROUNDING:
            return command, plan
        is_waiting = observation.speed == 0
        nominal, step, *old_arrays = memory
        _, _, *new_arrays = plan
        arrays = (
            np.where(is_waiting, old, new)
            for old, new in zip(old_arrays, new_arrays, strict=True)
        )
        throttle = np.where(is_waiting, 0.0, command.throttle)
        brake = np.where(is_waiting, 0.0, command.brake)
        return Command(throttle, brake), _ApolloMemory(nominal, step, *arrays)

    def _plan(self, observation: Observation, memory: _ApolloMemory) -> _ApolloMemory:
        """Plan an acceleration: cruise, then brake with v^2 / (2 d) to stop within the distance d,
        then creep, and finally hold.
        """
        speed = observation.speed
        is_detected = observation.gap <= self.perception_range * observation.visibility
        distance = np.where(
            is_detected,
            np.minimum(observation.gap, self.perception_range) - self.stop_gap,
            np.inf,
        )
        needed_deceleration = (
            speed * speed / (2 * np.maximum(distance, LEAST_STOPPING_DISTANCE))
        )
        # While the pedals lag, and while the deceleration rises at the jerk limit, the vehicle
        # covers distance that braking cannot use.
        lost_distance = speed * (
            self.pedal_lag + 0.5 * self.comfortable_deceleration / self.jerk
        )
        needed_after_lag = (
            speed
            * speed
            / (2 * np.maximum(distance - lost_distance, LEAST_STOPPING_DISTANCE))
        )
        begins_braking = (
            needed_after_lag > self.comfortable_deceleration
        ) & ~memory.has_begun_to_stop
        has_begun_to_stop = memory.has_begun_to_stop | begins_braking
        last_acceleration = memory.commanded_acceleration
        # Apollo plans in continuous time. Braking began within the last step, when
        # `needed_after_lag` passed `comfortable_deceleration`. Only since then, the acceleration
        # has changed.
        rise = np.maximum(needed_after_lag - memory.needed_after_lag, LEAST_RISE)
        share_since_onset = np.minimum(
            (needed_after_lag - self.comfortable_deceleration) / rise, 1.0
        )
        last_acceleration = np.where(
            begins_braking, np.minimum(last_acceleration, 0.0), last_acceleration
        )
        largest_change = (self.jerk * memory.step) * np.where(
            begins_braking, share_since_onset, 1.0
        )

        taper = np.maximum(speed - self.creep_speed, 0.0) / TAPER_TIME
        braking = np.minimum(
            np.minimum(needed_deceleration, self.largest_deceleration), taper
        )
        cruising = np.minimum(
            self.cruise_gain * (self.cruise_speed - speed), self.cruise_acceleration
        )
        change = np.where(has_begun_to_stop, -braking, cruising) - last_acceleration
        acceleration = last_acceleration + np.minimum(
            np.maximum(change, -largest_change), largest_change
        )

        is_creeping = has_begun_to_stop & (speed < self.creep_speed + CREEP_MARGIN)
        creeping_time = memory.creeping_time + np.where(is_creeping, memory.step, 0.0)
        acceleration[is_creeping] = 0.0
        acceleration[creeping_time > self.creep_time] = -HOLDING_DECELERATION
        return memory._replace(
            has_begun_to_stop=has_begun_to_stop,
            needed_after_lag=needed_after_lag,
            commanded_acceleration=acceleration,
            creeping_time=creeping_time,
        )


UpTo60 = Annotated[float, Meta(ge=0, le=60)]
Delay = Annotated[float, Meta(ge=0, le=5)]
SPEED_LIMIT = 20 / KMH_PER_MS
"""Speed above which the agent releases the throttle [m/s] (20 km/h in its source code)."""
SPEED_LEVEL = 8 / 3
"""Distance between the policy's speed levels [m/s]. Its source code has four levels from 0 to 8
m/s. The throttle is linear between the first three levels, and constant above.
"""
PASSED_GAP = -0.5
"""Gap below which an obstacle is beside the vehicle instead of ahead [m]. The policy does not begin
to brake for such an obstacle.
"""


class _RailsMemory(NamedTuple):
    """What `WorldOnRails` remembers of N vehicles.

    Attributes
    ----------
    is_braking
        Whether the policy brakes, shape (N,).
    pending_commands
        Commands that wait for the policy's latency, newest last.
    recognition_line
        Delay line of the gap and the lateral position.
    hesitation_line
        Delay line of the brake command.
    """

    is_braking: BoolArray
    pending_commands: list[Command]
    recognition_line: DelayLine
    hesitation_line: DelayLine


class WorldOnRails(Ads, Table, frozen=True, kw_only=True):
    """World On Rails (Chen, Koltun, Kraehenbuehl 2021): a vision policy at 20 Hz.

    The system brakes fully for a near obstacle in its corridor. If no obstacle is near in its
    corridor, the system opens the throttle up to its speed limit.

    Parameters
    ----------
    first_command
        Time from the start of the run to the first throttle of a standing vehicle [s].
    latency
        Time from an image to its command [s], rounded to whole steps.
    corridor
        Half the width of the corridor in which the policy brakes for obstacles; it releases the
        brake when they leave the corridor [m].
    brake_gap, brake_gap_per_speed
        The policy brakes at gaps up to `brake_gap` + `brake_gap_per_speed` * speed [m, s] for an
        obstacle at the lateral position `brake_place`.
    brake_place
        Lateral position of an obstacle for which the policy brakes earliest [m], negative on the
        side that it comes from.
    brake_gap_before, brake_gap_past
        Slopes [-]: the braking gap shrinks by `brake_gap_before` for each metre that the obstacle
        is short of `brake_place`, and by `brake_gap_past` for each metre past it, so that the
        policy brakes later for obstacles that enter or leave its path. The visibility multiplies
        the result.
    throttle
        Throttle at the policy's speed levels 0, 2.7 and 5.3 m/s.
    recognition_delay
        Additional time to recognise an obstacle, compared with clear weather [s].
    hesitation
        Time between releasing the accelerator and braking, while the policy is not yet sure [s]. It
        releases the brake at once.
    release_gap
        Obstacles nearer than this are below the camera's picture [m]: the policy releases the brake
        and opens the throttle, whether or not the vehicle has stopped.
    """

    first_command: UpTo60
    latency: UpTo60
    corridor: UpTo60
    brake_gap: float
    brake_gap_per_speed: float
    brake_place: float
    brake_gap_before: UpTo60
    brake_gap_past: UpTo60
    throttle: tuple[Proportion, Proportion, Proportion]
    recognition_delay: Delay = 0.0
    hesitation: Delay = 0.0
    release_gap: Annotated[float, Meta(ge=-1, le=60)] = -1.0

    def start(self, n: int, nominal: Nominal, step: float) -> _RailsMemory:
        idle = Command(np.zeros(n), np.zeros(n))
        return _RailsMemory(
            np.zeros(n, bool),
            [idle] * round(self.latency / step),
            DelayLine.by(self.recognition_delay, step),
            DelayLine.by(self.hesitation, step),
        )

    def drive(
        self, observation: Observation, memory: _RailsMemory
    ) -> tuple[Command, _RailsMemory]:
        (gap, lateral), recognition_line = memory.recognition_line.delayed(
            np.array([observation.gap, observation.lateral])
        )
        is_braking = self._decide_to_brake(observation, gap, lateral, memory.is_braking)
        is_waiting = (observation.speed == 0) & (observation.time < self.first_command)
        low, middle, high = self.throttle
        level = observation.speed / SPEED_LEVEL
        above_first_level = middle + (high - middle) * clip_to_share(level - 1)
        throttle = np.where(
            is_braking | is_waiting | (observation.speed > SPEED_LIMIT),
            0.0,
            np.where(level < 1, low + (middle - low) * level, above_first_level),
        )
        command, *pending_commands = (
            *memory.pending_commands,
            Command(throttle, is_braking.astype(float)),
        )
        delayed_brake, hesitation_line = memory.hesitation_line.delayed(command.brake)
        memory = _RailsMemory(
            is_braking, pending_commands, recognition_line, hesitation_line
        )
        return Command(
            command.throttle, np.minimum(command.brake, delayed_brake)
        ), memory

    def _decide_to_brake(
        self,
        observation: Observation,
        gap: FloatArray,
        lateral: FloatArray,
        was_braking: BoolArray,
    ) -> BoolArray:
        """Decide for which vehicles the policy brakes, shape (N,). The recognised obstacle must be
        in the corridor. Braking begins when the obstacle is near, and lasts until the obstacle is
        out of sight or out of the corridor.
        """
        # Negative while the obstacle has not reached `brake_place`.
        past = lateral - self.brake_place
        reduction_past = self.brake_gap_past * np.maximum(past, 0.0)
        reduction = reduction_past + self.brake_gap_before * np.maximum(-past, 0.0)
        largest_gap = self.brake_gap + self.brake_gap_per_speed * observation.speed
        braking_gap = observation.visibility * (largest_gap - reduction)
        is_seen = (np.abs(lateral) <= self.corridor) & (gap > self.release_gap)
        starts_braking = (gap <= braking_gap) & (gap > PASSED_GAP)
        return is_seen & (starts_braking | was_braking)
