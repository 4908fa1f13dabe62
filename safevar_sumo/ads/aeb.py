"""Automatic emergency braking, which begins when the gap falls below a braking distance. Before, a
cruise control drives.

`Aeb` brakes like production systems. `AutowareAeb` stands in for Autoware's module, with its
published formula and parameters, and with the deceleration of its stop operator.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.ads.base import (
    CORRIDOR,
    Ads,
    NonNegativeParameter,
    PositiveParameter,
    Trim,
    blocks_the_way,
    cruise_at,
    is_ahead,
    is_in_the_way,
    time_to_reach,
)
from safevar_sumo.records import (
    TIME_ROUNDING,
    BoolArray,
    Command,
    FloatArray,
    Nominal,
    Observation,
)
from safevar_sumo.study import PositiveProportion, Proportion, Table

LEAST_DECELERATION = 0.5
"""Least deceleration of an obstacle that counts as braking [m/s^2]."""
# The braking stages of `Aeb`.
NO_BRAKING = 0.0
PARTIAL_BRAKING = 1.0
FULL_BRAKING = 2.0


class _Memory(NamedTuple):
    """What `Aeb` remembers of N vehicles; arrays have shape (N,).

    Attributes
    ----------
    nominal, step
        The original vehicle, and the time between two calls of `drive` [s].
    cruise
        The speed to hold [m/s] and the trim at the first call; None before the first call.
    stage
        The braking stage.
    intervened
        Whether the system has braked at any time so far.
    obstacle, obstacle_speed
        The obstacle's number [-] and speed [m/s] at the last call.
    warns
        Whether the system warns its driver now.
    """

    nominal: Nominal
    step: float
    cruise: tuple[FloatArray, Trim] | None
    stage: FloatArray
    intervened: BoolArray
    obstacle: FloatArray
    obstacle_speed: FloatArray
    warns: BoolArray


class Aeb(Ads, Table, frozen=True, kw_only=True):
    """Holds its speed; brakes in part, then fully, when the gap to an obstacle in its way falls
    below its braking distances.

    distance = v rt + max(v_rel^2 / (2 b), v^2 / (2 b) - u^2 / (2 b_u)) + margin, with speed v and
    deceleration b of the vehicle, u and b_u of the obstacle, their closing speed v_rel, and
    `response_time` rt; b is `braking_share` of the original vehicle's greatest deceleration. After
    braking, the system never accelerates again.

    The system warns its driver while it brakes, and while the time to collision with an obstacle in
    its way (gap / closing speed) is below `warning_time`. The simulated driver does not react to
    warnings.

    Parameters
    ----------
    cruise_speed, cruise_gain
        Speed to hold [m/s], by default the initial speed, and acceleration per speed error [1/s].
    response_time
        Response time assumed in planning [s].
    braking_share
        Share of the original vehicle's greatest deceleration with which the system plans to brake
        [-].
    margin
        Gap to keep at the stop [m].
    partial_share, partial_time
        Pedal of the partial stage [-], and time by which this stage precedes the full stage [s].
    corridor
        Half the width of the corridor that the driving system watches [m].
    reach
        Range of its sensors in clear weather [m].
    warning_time
        Time to collision at which the system warns [s]; with 0 the system warns only while it
        brakes. The default is an assumption: Euro NCAP requires a warning by 1.7 s, and 0.3 s allow
        for late sensors.

    Notes
    -----
    The defaults are assumptions, not measurements: with them the original vehicle of `carla` just
    avoids a collision at the standard points of Euro NCAP's pedestrian and car-to-car tests.
    docs/scenarios.md lists the exceptions.
    """

    cruise_speed: PositiveParameter | None = None
    cruise_gain: PositiveParameter = 1.0
    response_time: NonNegativeParameter = 0.15
    braking_share: PositiveProportion = 0.95
    margin: NonNegativeParameter = 0.5
    partial_share: Proportion = 0.4
    partial_time: NonNegativeParameter = 0.15
    corridor: PositiveParameter = CORRIDOR
    reach: PositiveParameter = 100.0
    warning_time: NonNegativeParameter = 2.0

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        zeros = np.zeros(n)
        nobody = np.zeros(n, bool)
        return _Memory(
            nominal,
            step,
            None,
            zeros,
            intervened=nobody,
            obstacle=zeros,
            obstacle_speed=zeros,
            warns=nobody,
        )

    def drive(
        self, observation: Observation, memory: _Memory
    ) -> tuple[Command, _Memory]:
        nominal = memory.nominal

        # Without a threat, the system holds its speed. After its first braking, it never
        # accelerates.
        cruise = memory.cruise or cruise_at(nominal, observation, self.cruise_speed)
        cruise_speed, cruise_trim = cruise
        blocks = is_in_the_way(observation, self.corridor, self.reach)
        is_threatened = blocks & (observation.closing_speed > 0)
        stage = self._stage(observation, memory, is_threatened)
        has_intervened = memory.intervened | (stage > NO_BRAKING)
        cruising = self.cruise_gain * (cruise_speed - observation.speed)
        pedals = self.pedals(cruising, observation.speed, nominal, cruise_trim)
        throttle = np.where(has_intervened, 0.0, pedals.throttle)
        cruise_brake = np.where(has_intervened, 0.0, pedals.brake)
        stage_brake = np.where(stage == FULL_BRAKING, 1.0, self.partial_share)
        brake = np.where(stage > NO_BRAKING, stage_brake, cruise_brake)
        command = Command(throttle, brake)

        # The system warns earlier than it brakes.
        warns = is_threatened & (time_to_reach(observation) < self.warning_time)
        return command, memory._replace(
            cruise=cruise,
            stage=stage,
            intervened=has_intervened,
            obstacle=observation.obstacle,
            obstacle_speed=observation.obstacle_speed,
            warns=warns | (stage > NO_BRAKING),
        )

    def warns(self, memory: _Memory) -> BoolArray:
        """Return whether the system warns each driver now."""
        return memory.warns

    def _stage(
        self, observation: Observation, memory: _Memory, is_threatened: BoolArray
    ) -> FloatArray:
        """The braking stage of each vehicle. The stage does not fall while the obstacle still
        blocks the way, or while the vehicle stands.
        """
        speed = observation.speed
        obstacle_speed = observation.obstacle_speed

        # The deceleration of the obstacle since the last step. A new obstacle has lost no speed
        # yet.
        deceleration = self.braking_share * memory.nominal.decel
        is_same = observation.obstacle == memory.obstacle
        lost_speed = memory.obstacle_speed - obstacle_speed
        obstacle_deceleration = np.where(is_same, lost_speed, 0.0) / memory.step

        # The distance that the vehicle loses until both speeds are equal, or until both vehicles
        # stand.
        obstacle_stop = (
            obstacle_speed
            * obstacle_speed
            / (2 * np.maximum(obstacle_deceleration, LEAST_DECELERATION))
        )
        stop_difference = speed * speed / (2 * deceleration) - obstacle_stop
        closing_speed = np.maximum(observation.closing_speed, 0.0)
        braking_distance = np.maximum(
            closing_speed * closing_speed / (2 * deceleration),
            np.where(obstacle_deceleration > LEAST_DECELERATION, stop_difference, 0.0),
        )

        # A braking stage begins when the gap is less than the stage's distance.
        full_gap = speed * self.response_time + braking_distance + self.margin
        partial_gap = full_gap + speed * self.partial_time
        gap = observation.gap
        stage_at_gap = np.where(gap < partial_gap, PARTIAL_BRAKING, NO_BRAKING)
        stage_at_gap = np.where(gap < full_gap, FULL_BRAKING, stage_at_gap)
        stage = np.where(is_threatened, stage_at_gap, NO_BRAKING)

        # A stage ends when nobody who blocks the way comes nearer any more.
        comes_nearer = is_ahead(observation) & (closing_speed > 0)
        still_blocks = comes_nearer & blocks_the_way(observation, self.corridor)
        stays = still_blocks | (speed <= 0)
        return np.where(stays, np.maximum(stage, memory.stage), stage)


class _AutowareMemory(NamedTuple):
    """What `AutowareAeb` remembers of N vehicles.

    Attributes
    ----------
    nominal, step
        The original vehicle, and the time between two calls of `drive` [s].
    cruise
        The speed to hold [m/s] and the trim at the first call; None before the first call.
    decision_time
        Time since the decision to brake [s], shape (N,); negative before the decision.
    """

    nominal: Nominal
    step: float
    cruise: tuple[FloatArray, Trim] | None
    decision_time: FloatArray


class AutowareAeb(Ads, Table, frozen=True, kw_only=True):
    """Holds its speed until an obstacle in its way is nearer than the distance of Autoware's
    emergency braking; then stops with a target acceleration, reached with a target jerk.

    distance = v t_response + v^2 / (2 a_ego_min) - u^2 / (2 a_obj_min) +
    longitudinal_offset_margin, with the speeds v and u of vehicle and obstacle. Once the system has
    decided to brake, the system brakes until the vehicle stands.

    Parameters
    ----------
    cruise_speed, cruise_gain
        Speed to hold [m/s], by default the initial speed, and acceleration per speed error [1/s].
    t_response, longitudinal_offset_margin
        Response time [s] and gap [m] in the distance.
    a_ego_min, a_obj_min
        Decelerations of vehicle and obstacle in the distance [m/s^2]; Autoware states them as
        negative accelerations.
    target_acceleration, target_jerk
        Deceleration of the emergency stop [m/s^2], and the rate at which it is reached [m/s^3].
    command_delay
        Time from the decision to the first command [s]: an assumption, two cycles of 10 Hz.
    corridor
        Half the width of the corridor that the driving system watches [m].

    Notes
    -----
    The formula is that of the README of autoware_autonomous_emergency_braking; the defaults are the
    values of autoware_launch since commit 1ded9c3a of 2024-12-12. It is a stand-in for one module
    of several in that stack.
    """

    cruise_speed: PositiveParameter | None = None
    cruise_gain: PositiveParameter = 1.0
    t_response: NonNegativeParameter = 1.0
    a_ego_min: PositiveParameter = 3.0
    a_obj_min: PositiveParameter = 1.0
    longitudinal_offset_margin: NonNegativeParameter = 1.0
    target_acceleration: PositiveParameter = 2.5
    target_jerk: PositiveParameter = 1.5
    command_delay: NonNegativeParameter = 0.2
    corridor: PositiveParameter = CORRIDOR

    def start(self, n: int, nominal: Nominal, step: float) -> _AutowareMemory:
        return _AutowareMemory(
            nominal, step, cruise=None, decision_time=np.full(n, -1.0)
        )

    def drive(
        self, observation: Observation, memory: _AutowareMemory
    ) -> tuple[Command, _AutowareMemory]:
        nominal, step, cruise, decision_time = memory
        cruise = cruise or cruise_at(nominal, observation, self.cruise_speed)
        cruise_speed, cruise_trim = cruise
        distance = self.distance(observation.speed, observation.obstacle_speed)
        is_blocked = is_in_the_way(observation, self.corridor)
        is_near = is_blocked & (observation.gap < distance)
        new_time = np.where(is_near, 0.0, -1.0)
        old_time = decision_time + step
        decision_time = np.where(decision_time >= 0, old_time, new_time)
        # The command holds for the whole step: it gets the mean over the step, at half of the step.
        ramp_time = decision_time + step / 2 - self.command_delay
        ramp = self.target_jerk * np.maximum(ramp_time, 0.0)
        is_due = decision_time + TIME_ROUNDING >= self.command_delay
        is_braking = (decision_time >= 0) & is_due
        braking = -np.minimum(ramp, self.target_acceleration)
        cruising = self.cruise_gain * (cruise_speed - observation.speed)
        acceleration = np.where(is_braking, braking, cruising)
        pedals = self.pedals(acceleration, observation.speed, nominal, cruise_trim)
        return pedals, _AutowareMemory(nominal, step, cruise, decision_time)

    def distance(self, speed: FloatArray, obstacle_speed: FloatArray) -> FloatArray:
        """The gap below which the system brakes [m], at speeds [m/s] of shape (N,)."""
        stop = speed * self.t_response + speed * speed / (2 * self.a_ego_min)
        obstacle_stop = obstacle_speed * obstacle_speed / (2 * self.a_obj_min)
        return stop - obstacle_stop + self.longitudinal_offset_margin
