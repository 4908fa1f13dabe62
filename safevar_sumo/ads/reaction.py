"""How a reference driver answers a danger. The driver releases the accelerator, brakes after the
reaction time, and does not accelerate again while the cause of the danger blocks the way.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.ads.base import (
    CORRIDOR,
    LARGEST_GAP,
    Ads,
    Memory,
    PositiveParameter,
    Trim,
    blocks_the_way,
    cruise_at,
    is_ahead,
)
from safevar_sumo.records import (
    GRAVITY,
    TIME_ROUNDING,
    BoolArray,
    Command,
    FloatArray,
    FloatOrArray,
    Nominal,
    Observation,
)
from safevar_sumo.study import Proportion, Table

HARDEST_BRAKING = 0.774 * GRAVITY
"""Deceleration of the competent and careful driver [m/s^2] (UN R157, annex 4, appendix 3)."""
JERK = 12.65
"""Jerk limit while a deceleration builds up [m/s^3] (UN R157, annex 4, appendix 3)."""
ANY_BRAKING = 0.5
"""Deceleration above which a leader counts as braking [m/s^2]."""
DECELERATION_ROUNDING = 1e-6
"""Difference below which two decelerations over a time step count as equal [m/s^2]."""
CRUISE_GAIN = 1.0
"""Acceleration per speed error [1/s]."""
LEAST_DIVISOR = 1e-9
"""Lower bound of an acceleration [m/s^2] or of a ramp's width [m] that is a divisor."""
StartThrottle = tuple[Proportion, ...]
"""Throttle in the run's first steps, one value per step [-], with which the run starts as it does
with another driver.
"""


class Reaction(NamedTuple):
    """The memory of a reference driver that drives N vehicles; arrays have shape (N,).

    Attributes
    ----------
    nominal
        The original vehicle.
    step
        Time between two calls of `drive` [s].
    cruise
        Speed to hold [m/s], trim [-], and position of the brake pedal [-], all taken at the first
        call; None before the first call.
    speed
        Speed at the last call [m/s].
    is_endangered
        Whether there was a danger at the last call.
    aware_time
        Time since the danger began that made the driver aware of its cause [s]. The time is
        negative if the driver is aware of no cause.
    felt_deceleration
        Deceleration that the vehicle has without the driver's braking [m/s^2].
    intended_deceleration
        Deceleration that the driver wants to reach at the end of the step [m/s^2].
    leader
        Number of the obstacle at the last call.
    leader_speed
        Speed of the leader (an obstacle in the way) at the last call [m/s]; 0 without a leader.
    leader_deceleration
        Mean deceleration of the leader between the last two calls [m/s^2]; 0 without a leader.
    leader_has_braked
        Whether the leader has braked while it was in the way; false without a leader.
    is_undercut
        Whether the gap was smaller than the driver's least gap before the leader braked. Only one
        of the drivers has a least gap; for the others the value is false.
    nearness
        `Danger.nearness` at the last call, but at least -`LARGEST_GAP`.
    """

    nominal: Nominal
    step: float
    cruise: tuple[FloatArray, Trim, FloatArray] | None
    speed: FloatArray
    is_endangered: BoolArray
    aware_time: FloatArray
    felt_deceleration: FloatArray
    intended_deceleration: FloatArray
    leader: FloatArray
    leader_speed: FloatArray
    leader_deceleration: FloatArray
    leader_has_braked: BoolArray
    is_undercut: BoolArray
    nearness: FloatArray

    def acceleration(self, observation: Observation) -> FloatArray:
        """Mean acceleration since the last call [m/s^2]; 0 at the first call."""
        change = observation.speed - self.speed
        if self.cruise:
            return change / self.step
        return np.zeros_like(change)

    @property
    def leader_brakes(self) -> BoolArray:
        """Whether the leader braked between the last two calls."""
        return self.leader_deceleration > ANY_BRAKING + DECELERATION_ROUNDING


class Danger(NamedTuple):
    """The danger that a reference driver sees now, and how the driver brakes; arrays have shape
    (N,).

    Attributes
    ----------
    is_present
        Whether there is a danger now.
    deceleration
        Deceleration that the driver reaches after the reaction time [m/s^2].
    reaction_time
        Time from the beginning of the danger to braking [s].
    jerk
        Rise of the deceleration per second, once the driver brakes [m/s^3].
    released
        Deceleration while the accelerator is released, until the reaction time is over [m/s^2]. If
        the vehicle decelerates less by itself, the driver brakes a little.
    nearness
        A measure of the danger, in any unit: above 0 in a danger, and below 0 before it. Calls are
        a step apart, but the danger begins between two calls: at the moment at which `nearness`,
        interpolated linearly between the two calls, crosses 0. By default the nearness is infinite,
        and a new danger has lasted a whole step.
    longest
        Upper limit of the time for which a new danger has already lasted [s].
    """

    is_present: BoolArray
    deceleration: FloatOrArray
    reaction_time: float
    jerk: float = JERK
    released: float = 0.0
    nearness: FloatOrArray = np.inf
    longest: FloatOrArray = np.inf


class ReferenceDriver(Ads, Table, frozen=True, kw_only=True):
    """Base of the reference drivers. The driver feels the deceleration that the vehicle has by
    itself, and brakes for the difference to the deceleration that the driver wants.

    The driver does not take the coasting deceleration from the original vehicle's table
    (`Nominal`), because the calibration drive that made this table was in other gears.
    """

    cruise_speed: PositiveParameter | None = None
    corridor: PositiveParameter = CORRIDOR

    def start(self, n: int, nominal: Nominal, step: float) -> Memory:
        zeros = np.zeros(n)
        never = np.zeros(n, bool)
        return Reaction(
            nominal=nominal,
            step=step,
            cruise=None,
            speed=zeros,
            is_endangered=never,
            aware_time=np.full(n, -1.0),
            felt_deceleration=zeros,
            intended_deceleration=zeros,
            leader=zeros,
            leader_speed=zeros,
            leader_deceleration=zeros,
            leader_has_braked=never,
            is_undercut=never,
            nearness=np.full(n, -LARGEST_GAP),
        )

    def watch_leader(
        self, observation: Observation, memory: Reaction, is_in_way: BoolArray
    ) -> Reaction:
        """The memory with the leader's present speed and deceleration. The obstacle of a vehicle is
        its leader where `is_in_way`, shape (N,), is true.
        """
        speed = np.where(is_in_way, observation.obstacle_speed, 0.0)
        is_same = observation.obstacle == memory.leader
        is_led = is_in_way & is_same & (memory.leader_speed > 0)
        deceleration = np.where(
            is_led, (memory.leader_speed - speed) / memory.step, 0.0
        )
        memory = memory._replace(leader_speed=speed, leader_deceleration=deceleration)
        has_braked = memory.leader_has_braked & is_same | memory.leader_brakes
        return memory._replace(leader_has_braked=is_in_way & has_braked)

    def react(
        self,
        observation: Observation,
        memory: Reaction,
        danger: Danger,
        start: StartThrottle = (),
    ) -> tuple[Command, Reaction]:
        """Hold the cruise speed, or answer a danger.

        The driver releases the accelerator when it sees a danger, and brakes when the reaction time
        is over. A danger lasts as long as its cause blocks the way and approaches or brakes. After
        the danger the driver stays aware of the cause, as long as the cause blocks the way. An
        aware driver does not press the accelerator. The same cause may become a danger again: then
        the driver brakes at once if the reaction time has passed since the first danger began.

        Parameters
        ----------
        danger
            What the driver sees as a danger now.
        start
            Throttle in the first steps without a danger.
        """
        cruise = memory.cruise or (
            *cruise_at(memory.nominal, observation, self.cruise_speed),
            observation.brake,
        )
        speed_to_hold, trim, brake_at_start = cruise

        # Is there a danger? A danger that the driver knows lasts while its cause blocks the way
        # and approaches or brakes.
        is_same = observation.obstacle == memory.leader
        is_known = (memory.aware_time >= 0) & (is_same | memory.is_endangered)
        blocks = is_ahead(observation) & blocks_the_way(observation, self.corridor)
        approaches = (observation.closing_speed >= 0) | memory.leader_brakes
        is_endangered = danger.is_present | (is_known & blocks & approaches)

        # For how long is the driver aware of the cause of a danger? The driver forgets a cause that
        # no longer blocks the way.
        is_aware = is_endangered | (is_known & is_same & blocks)
        # The time for which a new danger has lasted [s]. Let a < 0 be the nearness at the last call
        # and b > 0 the nearness now. A straight line from a to b crosses 0 after the share
        # -a / (b - a) of the step, so the danger has lasted for the share b / (b - a) =
        # 1 / (1 - a / b). For a new obstacle, whose nearness was not seen before, a = 0: the danger
        # has lasted the whole step.
        old_nearness = np.where(is_same, memory.nearness, 0.0)
        lower_limit = np.full_like(observation.gap, -LARGEST_GAP)
        nearness = np.maximum(danger.nearness, lower_limit)
        rise = np.maximum(nearness, LEAST_DIVISOR)
        part_of_step = 1 / (1 - np.minimum(old_nearness, 0.0) / rise)
        new_time = np.maximum(
            np.minimum(danger.longest, memory.step * part_of_step), 0.0
        )
        known_time = np.where(is_known, memory.aware_time + memory.step, new_time)
        aware_time = np.where(is_aware, known_time, -1.0)

        # Without a danger the driver holds the cruise speed. A driver that is aware of a cause does
        # not accelerate.
        step_index = round(observation.time / memory.step)
        if step_index < len(start):
            calm = Command(
                np.full_like(observation.speed, start[step_index]),
                np.zeros_like(observation.speed),
            )
        else:
            acceleration = CRUISE_GAIN * (speed_to_hold - observation.speed)
            acceleration = np.where(
                is_aware, np.minimum(acceleration, 0.0), acceleration
            )
            calm = self.pedals(acceleration, observation.speed, memory.nominal, trim)

        # In a danger the driver brakes for the difference between the wanted deceleration (`mean`)
        # and the deceleration that the vehicle has by itself (`felt`).
        mean, felt, intended = _decelerations(
            observation, memory, danger, is_endangered, aware_time
        )
        lacking = np.maximum(mean - felt, 0.0) / memory.nominal.braking
        brake = np.minimum(brake_at_start + lacking, 1.0)
        throttle = np.where(is_aware, 0.0, calm.throttle)
        command = Command(throttle, np.where(is_endangered, brake, calm.brake))
        return command, memory._replace(
            cruise=cruise,
            speed=observation.speed,
            is_endangered=is_endangered,
            aware_time=aware_time,
            felt_deceleration=felt,
            intended_deceleration=intended,
            leader=observation.obstacle,
            nearness=nearness,
        )


def _decelerations(
    observation: Observation,
    memory: Reaction,
    danger: Danger,
    is_endangered: BoolArray,
    aware_time: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Three decelerations of vehicles in a danger [m/s^2], each of shape (N,): the mean
    deceleration that the driver wants in the coming step; the deceleration that the vehicle has
    without the driver's braking; and the deceleration that the driver wants at the end of the step.
    """
    step = memory.step

    # The deceleration that the vehicle has by itself. While the driver brakes, this deceleration
    # cannot be felt: the driver takes the value from before braking.
    was_braking = memory.aware_time + step - danger.reaction_time > TIME_ROUNDING
    braked = np.maximum(memory.intended_deceleration - memory.felt_deceleration, 0.0)
    felt_now = np.maximum(-memory.acceleration(observation) - braked, 0.0)
    felt = np.where(was_braking, memory.felt_deceleration, felt_now)

    # In the step in which the driver sees the danger, the driver does not brake, in order to feel
    # how the vehicle coasts.
    released = np.where(is_endangered & (memory.aware_time >= 0), danger.released, 0.0)

    # The driver brakes only in the part of the coming step that is after the reaction time.
    braking_time = np.minimum(aware_time + step - danger.reaction_time, step)
    is_braking = is_endangered & (braking_time > TIME_ROUNDING)
    share = np.where(is_braking, braking_time / step, 0.0)

    # In that part the deceleration rises linearly, so its mean is begin + rise / 2. In the rest of
    # the step the vehicle decelerates with the accelerator released.
    begin = np.maximum(memory.intended_deceleration, felt)
    rise = danger.jerk * np.where(is_braking, braking_time, step)
    risen = share * np.minimum(begin + rise / 2, danger.deceleration)
    mean = risen + (1 - share) * np.maximum(released, felt)
    intended = np.where(
        is_braking, np.minimum(begin + rise, danger.deceleration), released
    )
    return mean, felt, intended
