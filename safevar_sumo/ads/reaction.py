"""How a reference driver answers a danger: it releases the accelerator, reacts, brakes, and does
not accelerate again while the cause of the danger blocks its way.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta

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
    Nominal,
    Observation,
)
from safevar_sumo.study import Table

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
StartThrottle = tuple[Annotated[float, Meta(ge=0, le=1)], ...]
"""Throttle in the run's first steps, one value per step [-]: the start of another driver."""


class Reaction(NamedTuple):
    """What a reference driver remembers of N vehicles; arrays have shape (N,).

    Attributes
    ----------
    nominal, step
        The original vehicle, and the time between two calls of `drive` [s].
    cruise
        Speed to hold [m/s], and the trim and the brake pedal at the first call [-]; None before
        that call.
    speed
        Speed at the last call [m/s].
    is_endangered
        Whether there was a danger at the last call.
    aware_time
        Time since the driver first saw a danger whose cause is still ahead [s]; negative without
        such a cause.
    felt_deceleration, intended_deceleration
        The vehicle's deceleration without the driver's braking, and the one that the driver aims
        at [m/s^2].
    leader
        Number of the obstacle at the last call.
    leader_speed, leader_deceleration, leader_has_braked
        Of an obstacle in the way: its speed at the last call [m/s], its mean deceleration since
        the call before [m/s^2], and whether it has braked there; 0 and false for nobody.
    is_undercut
        Whether a leader was too near before it braked, by a driver that has such a distance.
    nearness
        What is above 0 in a danger, at the last call, in a unit of the driver's own.
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
        """Whether a leader has braked since the last call."""
        return self.leader_deceleration > ANY_BRAKING + DECELERATION_ROUNDING


Reacted = tuple[Command, Reaction]
"""What a driver does at a step, and what it remembers for the next one."""


class Danger(NamedTuple):
    """What a reference driver sees as a danger, and how it brakes for it; arrays have shape (N,).

    Attributes
    ----------
    is_present
        Whether there is a danger now.
    deceleration, jerk
        Deceleration after the reaction time [m/s^2], and how fast it rises [m/s^3].
    reaction_time
        Time from the first sight of the danger to braking [s].
    released
        Deceleration with the accelerator released, until the reaction time is over [m/s^2]; a
        vehicle that coasts with less is braked.
    nearness
        What rises above 0 when a danger begins, in any unit: a driver looks all the time, so that
        the danger began within the last step, where this was 0.
    longest
        Upper limit of the time for which a danger that is new has lasted [s].
    """

    is_present: BoolArray
    deceleration: FloatArray | float
    reaction_time: float
    jerk: float = JERK
    released: float = 0.0
    nearness: FloatArray | float = np.inf
    longest: FloatArray | float = np.inf


class ReferenceDriver(Ads, Table, frozen=True, kw_only=True):
    """Base of the drivers: a driver feels how the vehicle coasts, and brakes by what its
    deceleration lacks.

    The original vehicle's table of coasting would mislead the driver: the calibration drive that
    made it was in other gears.
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
        """The memory with the leader as it is now; `is_in_way` says where the obstacle is one."""
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
    ) -> Reacted:
        """Hold the cruise speed, or answer a danger.

        The driver releases the accelerator when it sees a danger, and brakes when the reaction time
        is over. A danger lasts as long as its cause blocks the way and approaches or brakes. After
        it the driver is aware of the cause as long as that blocks the way: it does not press the
        accelerator, and to a further danger from the same cause it reacts without a reaction time.

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

        # Is there a danger? A known one is there while its cause approaches or brakes.
        is_same = observation.obstacle == memory.leader
        is_known = (memory.aware_time >= 0) & (is_same | memory.is_endangered)
        blocks = is_ahead(observation) & blocks_the_way(observation, self.corridor)
        approaches = (observation.closing_speed >= 0) | memory.leader_brakes
        is_endangered = danger.is_present | (is_known & blocks & approaches)

        # Since when is the driver aware of it? It forgets a cause that no longer blocks the way.
        is_aware = is_endangered | (is_known & is_same & blocks)
        # The time for which a new danger has lasted [s]: that since `nearness` was 0 in this step.
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

        # Without a danger it holds its speed; aware of a cause it only ever becomes slower.
        if (step_index := round(observation.time / memory.step)) < len(start):
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

        # In a danger it brakes by what the vehicle's own deceleration lacks.
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
    """Decelerations of vehicles in a danger, shape (N,) [m/s^2]: the mean one to reach in the next
    step, the one that is felt without braking, and the one at the step's end.
    """
    step = memory.step

    # How the vehicle decelerates by itself: as before it braked, or as it does now.
    was_braking = memory.aware_time + step - danger.reaction_time > TIME_ROUNDING
    braked = np.maximum(memory.intended_deceleration - memory.felt_deceleration, 0.0)
    felt_now = np.maximum(-memory.acceleration(observation) - braked, 0.0)
    felt = np.where(was_braking, memory.felt_deceleration, felt_now)

    # In the step in which it sees the danger it feels how the vehicle coasts, and does not brake.
    released = np.where(is_endangered & (memory.aware_time >= 0), danger.released, 0.0)

    # It brakes for the part of the step that is after the reaction time.
    braking_time = np.minimum(aware_time + step - danger.reaction_time, step)
    is_braking = is_endangered & (braking_time > TIME_ROUNDING)
    share = np.where(is_braking, braking_time / step, 0.0)

    # The deceleration rises within that part, which has its mean.
    begin = np.maximum(memory.intended_deceleration, felt)
    rise = danger.jerk * np.where(is_braking, braking_time, step)
    risen = share * np.minimum(begin + rise / 2, danger.deceleration)
    mean = risen + (1 - share) * np.maximum(released, felt)
    intended = np.where(
        is_braking, np.minimum(begin + rise, danger.deceleration), released
    )
    return mean, felt, intended
