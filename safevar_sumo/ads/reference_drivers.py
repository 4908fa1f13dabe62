"""Reference drivers, with which an ADS is compared: they hold their speed until they see a danger, react, and brake.

UN Regulation No. 157 means its drivers for cars that cut in, cut out or brake on motorways; their use for pedestrians
is ours.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.ads.base import (
    CORRIDOR,
    LARGEST_GAP,
    Ads,
    Memory,
    NonNegativeParameter,
    PositiveParameter,
    Trim,
    blocks_the_way,
    cruise_at,
    depth_in_the_way,
    is_in_the_way,
    pedals_for,
    time_to_reach,
)
from safevar_sumo.records import (
    GRAVITY,
    KMH_PER_MS,
    TIME_ROUNDING,
    BoolArray,
    Command,
    FloatArray,
    Nominal,
    Observation,
)

HARDEST_BRAKING = 0.774 * GRAVITY
"""Deceleration of the competent and careful driver [m/s^2] (UN R157, annex 4, appendix 3)."""
JERK = 12.65
"""Jerk limit while that deceleration builds up [m/s^3] (UN R157, annex 4, appendix 3)."""
ANY_BRAKING = 0.5
"""Deceleration above which a leader counts as braking [m/s^2]."""
DECELERATION_ROUNDING = 1e-6
"""Difference below which two decelerations over a time step count as equal [m/s^2]."""
UNLIMITED_BRAKING = 1e6
"""Deceleration beyond every brake [m/s^2]; it presses the pedal fully."""
CRUISE_GAIN = 1.0
"""Acceleration per speed error [1/s]."""
LEAST_DIVISOR = 1e-9
"""Lower bound of an acceleration [m/s^2] or of a ramp's width [m] that is a divisor."""
StartThrottle = tuple[Annotated[float, Meta(ge=0, le=1)], ...]
"""Throttle in the run's first steps, one value per step [-]: the replayed start of another driver."""


class Reaction(NamedTuple):
    """What a reference driver remembers of N vehicles; arrays have shape (N,).

    Attributes
    ----------
    nominal, step
        The original vehicle, and the time between two calls of `drive` [s].
    cruise
        Speed to hold [m/s], and the trim and the brake pedal at the first call [-]; None before that call.
    speed
        Speed at the last call [m/s].
    danger_time
        Time since the driver first saw the danger [s]; negative without a danger.
    felt_deceleration, intended_deceleration
        The vehicle's deceleration without the driver's braking, and the one that the driver aims at [m/s^2].
    leader, leader_speed, leader_has_braked
        Number of the obstacle at the last call; its speed if it was in the way [m/s], 0 for nobody; whether it has
        braked there.
    nearness
        What is above 0 in a danger, at the last call, in a unit of the driver's own.
    """

    nominal: Nominal
    step: float
    cruise: tuple[FloatArray, Trim, FloatArray] | None
    speed: FloatArray
    danger_time: FloatArray
    felt_deceleration: FloatArray
    intended_deceleration: FloatArray
    leader: FloatArray
    leader_speed: FloatArray
    leader_has_braked: BoolArray
    nearness: FloatArray

    def acceleration(self, seen: Observation) -> FloatArray:
        """Mean acceleration since the last call [m/s^2]; 0 at the first call."""
        return np.zeros_like(seen.speed) if self.cruise is None else (seen.speed - self.speed) / self.step


class ReferenceDriver(Ads, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of the drivers: a driver feels how the vehicle coasts, and brakes by what its deceleration lacks.

    The original vehicle's table of coasting would mislead the driver: the calibration drive that made it was in other
    gears.
    """

    cruise_speed: PositiveParameter | None = None
    corridor: PositiveParameter = CORRIDOR

    def start(self, n: int, nominal: Nominal, step: float) -> Memory:
        zeros = np.zeros(n)
        never = np.zeros(n, dtype=bool)
        far = np.full(n, -LARGEST_GAP)
        return Reaction(nominal, step, None, zeros, np.full(n, -1.0), zeros, zeros, zeros, zeros, never, far)

    def watch_leader(self, seen: Observation, memory: Reaction, is_in_way: BoolArray) -> tuple[FloatArray, Reaction]:
        """The mean deceleration of a leader since the last call [m/s^2], 0 without one; and the memory with the
        leader as it is now.
        """
        speed = np.where(is_in_way, seen.obstacle_speed, 0.0)
        is_same = seen.obstacle == memory.leader
        is_led = is_in_way & is_same & (memory.leader_speed > 0)
        deceleration = np.where(is_led, (memory.leader_speed - speed) / memory.step, 0.0)
        brakes = deceleration > ANY_BRAKING + DECELERATION_ROUNDING
        has_braked = is_in_way & (memory.leader_has_braked & is_same | brakes)
        return deceleration, memory._replace(leader_speed=speed, leader_has_braked=has_braked)

    def react(
        self,
        seen: Observation,
        memory: Reaction,
        danger: BoolArray,
        deceleration: FloatArray | float,
        reaction_time: float,
        jerk: float = JERK,
        start: StartThrottle = (),
        lets_go: float = 0.0,
        still_brakes: BoolArray | bool = False,
        following: FloatArray | float = np.inf,
        nearness: FloatArray | float = np.inf,
        longest: FloatArray | float = np.inf,
    ) -> tuple[Command, Reaction]:
        """Drive on, or react to a danger: release the accelerator, and brake when the reaction time is over.

        A danger lasts while an obstacle ahead approaches or still brakes, or keeps its distance and blocks the way. A
        driver looks all the time: the danger began within the last step, where `nearness` was 0.

        Parameters
        ----------
        danger
            Whether the driver sees a danger now; shape (N,).
        deceleration
            Deceleration after the reaction time [m/s^2]; it rises at `jerk` [m/s^3].
        reaction_time
            Time from the first sight of the danger to braking [s].
        start
            Throttle in the first steps without a danger.
        lets_go
            Deceleration with the accelerator released, until the reaction time is over [m/s^2]; a vehicle that coasts
            with less is braked.
        still_brakes
            Whether a leader still brakes, shape (N,).
        following
            Upper limit of the acceleration when following a leader [m/s^2].
        nearness
            What rises above 0 when a danger begins, shape (N,), in any unit.
        longest
            Upper limit of the time for which a danger that is new has lasted [s], shape (N,).
        """
        nominal = memory.nominal
        step = memory.step
        cruise = memory.cruise
        if cruise is None:
            cruise = *cruise_at(nominal, seen, self.cruise_speed), seen.brake
        speed_to_hold, initial_trim, initial_brake = cruise
        is_ahead = np.isfinite(seen.gap) & (seen.gap > 0)
        still_blocks = (seen.closing_speed == 0) & blocks_the_way(seen, self.corridor)
        danger_lasts = is_ahead & ((seen.closing_speed > 0) | still_brakes | still_blocks)
        is_aware = memory.danger_time >= 0
        is_reacting = np.where(is_aware, danger_lasts, danger)
        nearness = np.maximum(nearness, np.full_like(seen.gap, -LARGEST_GAP))
        before = np.where(seen.obstacle == memory.leader, memory.nearness, 0.0)
        part_of_step = 1 / (1 - np.minimum(before, 0.0) / np.maximum(nearness, LEAST_DIVISOR))
        since = np.maximum(np.minimum(longest, step * part_of_step), 0.0)
        danger_time = np.where(is_reacting, np.where(is_aware, memory.danger_time + step, since), -1.0)
        # How long of the last step, and of the next one, it brakes.
        braked_time, braking_time = (
            np.minimum(time + step - reaction_time, step) for time in (memory.danger_time, danger_time)
        )
        was_braking = braked_time > TIME_ROUNDING
        is_braking = braking_time > TIME_ROUNDING
        intended_before = memory.intended_deceleration
        felt_before = memory.felt_deceleration
        braked = np.maximum(intended_before - felt_before, 0.0)
        felt = np.where(was_braking, felt_before, np.maximum(-memory.acceleration(seen) - braked, 0.0))
        # In its first step it feels how the vehicle coasts.
        released = np.where(is_reacting & is_aware, lets_go, 0.0)
        # A step has the mean of the deceleration that rises within it.
        begin = np.maximum(intended_before, felt)
        rise = jerk * np.where(is_braking, braking_time, step)
        share = np.where(is_braking, braking_time / step, 0.0)
        mean = share * np.minimum(begin + rise / 2, deceleration) + (1 - share) * np.maximum(released, felt)
        intended = np.where(is_braking, np.minimum(begin + rise, deceleration), released)
        brake = np.minimum(initial_brake + np.maximum(mean - felt, 0.0) / nominal.braking, 1.0)
        if (step_index := round(seen.time / step)) < len(start):
            calm = Command(np.full_like(brake, start[step_index]), np.zeros_like(brake))
        else:
            acceleration = np.minimum(CRUISE_GAIN * (speed_to_hold - seen.speed), following)
            calm = pedals_for(nominal, seen.speed, acceleration, initial_trim)
        command = Command(np.where(is_reacting, 0.0, calm.throttle), np.where(is_reacting, brake, calm.brake))
        return command, memory._replace(
            cruise=cruise,
            speed=seen.speed,
            leader=seen.obstacle,
            nearness=nearness,
            danger_time=danger_time,
            felt_deceleration=felt,
            intended_deceleration=intended,
        )


class FullBraking(ReferenceDriver, frozen=True, kw_only=True):
    """Brakes fully as soon as it approaches an obstacle that is in its way or will be there when the vehicle arrives:
    the best that a driver can do.

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    corridor
        Half the width of the corridor that it watches [m].
    start_throttle
        Throttle in the run's first steps, one value per step, until it brakes [-].
    """

    start_throttle: StartThrottle = ()

    def drive(self, seen: Observation, memory: Reaction) -> tuple[Command, Reaction]:
        danger = is_in_the_way(seen, self.corridor) & (seen.closing_speed > 0)
        return self.react(
            seen, memory, danger, UNLIMITED_BRAKING, reaction_time=0.0, jerk=np.inf, start=self.start_throttle
        )


class R157(ReferenceDriver, frozen=True, kw_only=True):
    """An automated lane keeping system that does what UN R157, 5.2.5, demands, and no more.

    To who enters its way, and to who stands or drives steadily in it, it reacts at a TTC below
    (v - u) / (2 * 6 m/s^2) + 0.35 s + 0.1 s, with the speeds v and u of the vehicle and the obstacle, and brakes with
    6 m/s^2 at once (5.2.5.2, which means it for cars that cut in). Behind a leader that brakes, 5.2.5.1 counts: no
    collision if the time gap was at least 1 s + v / (100 km/h) s. Then it brakes in the same way as soon as the leader
    does, which is enough; nearer the regulation demands nothing, and it does not react to the leader's braking.

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    deceleration, reaction_time, margin
        6 m/s^2, 0.35 s and 0.1 s in the regulation.
    corridor
        Half the width of the corridor that it watches [m].
    """

    deceleration: PositiveParameter = 6.0
    reaction_time: NonNegativeParameter = 0.35
    margin: NonNegativeParameter = 0.1

    def drive(self, seen: Observation, memory: Reaction) -> tuple[Command, Reaction]:
        depth = depth_in_the_way(seen, self.corridor)
        _, memory = self.watch_leader(seen, memory, depth >= 0)
        critical_ttc = seen.closing_speed / (2 * self.deceleration) + self.reaction_time + self.margin
        # The gap was seen after a step, in which a leader who brakes has shortened it.
        least_gap = seen.speed * (1 + seen.speed * KMH_PER_MS / 100 - memory.step)
        when_braking = np.where(seen.gap >= least_gap, np.inf, -np.inf)
        when_steady = np.minimum(depth, critical_ttc - time_to_reach(seen))
        nearness = np.where(memory.leader_has_braked, when_braking, when_steady)
        return self.react(
            seen, memory, nearness > 0, self.deceleration, self.reaction_time, jerk=np.inf, nearness=nearness
        )


class Rss(ReferenceDriver, frozen=True, kw_only=True):
    """Responsibility-sensitive safety (Shalev-Shwartz, Shammah, Shashua 2017), longitudinal part.

    A gap below the safe distance is a danger, to which it reacts and brakes.
    safe distance = v rt + a rt^2 / 2 + (v + rt a)^2 / (2 b) - u^2 / (2 b_u), with the speeds v and u of vehicle and
    leader.

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    reaction_time
        rt [s].
    acceleration, deceleration, leader_deceleration
        Acceleration a while it reacts, decelerations b and b_u of its own and of the leader's braking, with which it
        plans [m/s^2].
    braking
        Deceleration with which it brakes, by default 0.774 g [m/s^2].
    corridor
        Half the width of the corridor that it watches [m].
    """

    reaction_time: NonNegativeParameter = 0.75
    acceleration: NonNegativeParameter = 0.0
    deceleration: PositiveParameter = HARDEST_BRAKING
    braking: PositiveParameter = HARDEST_BRAKING
    leader_deceleration: PositiveParameter = HARDEST_BRAKING

    def drive(self, seen: Observation, memory: Reaction) -> tuple[Command, Reaction]:
        lacking = self.safe_distance(seen.speed, seen.obstacle_speed) - seen.gap
        nearness = np.minimum(depth_in_the_way(seen, self.corridor), lacking)
        return self.react(seen, memory, nearness > 0, self.braking, self.reaction_time, nearness=nearness)

    def safe_distance(self, speed: FloatArray, leader_speed: FloatArray) -> FloatArray:
        """Smallest safe gap [m], at speeds [m/s] of shape (N,)."""
        rt = self.reaction_time
        reaction_speed = speed + self.reaction_time * self.acceleration
        stop = speed * rt + self.acceleration * rt * rt / 2 + reaction_speed * reaction_speed / (2 * self.deceleration)
        leader_stop = leader_speed * leader_speed / (2 * self.leader_deceleration)
        return np.maximum(stop - leader_stop, 0.0)


class FuzzySafety(ReferenceDriver, frozen=True, kw_only=True):
    """The fuzzy safety model (Mattas et al. 2020, "Fuzzy Surrogate Safety Metrics"), in UN R157 as amended.

    It brakes according to two metrics: PFS rises as the gap falls below the safe distance, CFS as a collision nears.

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    reaction_time
        Reaction time rt [s].
    comfortable, hardest, leader_deceleration
        Decelerations b_min and b_max of its own braking, b_u of the leader's braking [m/s^2].
    margin
        Added to the safe distance and subtracted from the gap [m].
    corridor
        Half the width of the corridor that it watches [m].
    """

    reaction_time: NonNegativeParameter = 0.75
    comfortable: PositiveParameter = 4.0
    hardest: PositiveParameter = 6.0
    leader_deceleration: PositiveParameter = 7.0
    margin: NonNegativeParameter = 2.0

    def drive(self, seen: Observation, memory: Reaction) -> tuple[Command, Reaction]:
        depth = depth_in_the_way(seen, self.corridor)
        gap = np.where(depth >= 0, seen.gap, np.inf)
        pfs = self.proactive_metric(gap, seen.speed, seen.obstacle_speed)
        cfs = self.critical_metric(gap, seen.speed, seen.obstacle_speed, memory.acceleration(seen))
        critical_deceleration = cfs * (self.hardest - self.comfortable) + self.comfortable
        deceleration = np.minimum(np.where(cfs > 0, critical_deceleration, pfs * self.comfortable), HARDEST_BRAKING)
        _, safe_distance = self.proactive_distances(seen.speed, seen.obstacle_speed)
        nearness = np.minimum(depth, safe_distance + self.margin - seen.gap)
        danger = (pfs > 0) | (cfs > 0)
        return self.react(seen, memory, danger, deceleration, self.reaction_time, nearness=nearness)

    def proactive_metric(self, gap: FloatArray, v: FloatArray, u: FloatArray) -> FloatArray:
        """PFS at a gap [m] and speeds v and u (leader) [m/s], shape (N,): 0 above the safe distance, 1 below the unsafe
        distance.
        """
        unsafe_distance, safe_distance = self.proactive_distances(v, u)
        return _falling_ramp(gap - self.margin, unsafe_distance, safe_distance)

    def proactive_distances(self, v: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The unsafe and the safe distance [m] of PFS."""
        leader_stop = u * u / (2 * self.leader_deceleration)
        safe_distance = v * self.reaction_time + v * v / (2 * self.comfortable) - leader_stop + self.margin
        unsafe_distance = v * self.reaction_time + v * v / (2 * self.hardest) - leader_stop
        return unsafe_distance, safe_distance

    def critical_metric(self, gap: FloatArray, v: FloatArray, u: FloatArray, a: FloatArray) -> FloatArray:
        """CFS in [0, 1] at a gap [m], speeds v and u [m/s] and the acceleration a of the vehicle [m/s^2], shape
        (N,).
        """
        acceleration = np.maximum(a, -self.comfortable)
        speed_after_reaction = v + self.reaction_time * acceleration
        # How much the gap shrinks within the reaction time and, if the vehicle is slower then, until speeds are equal:
        loss_in_reaction = (v + acceleration * self.reaction_time / 2 - u) * self.reaction_time
        loss_to_leader_speed = (v - u) * (v - u) / (2 * np.maximum(np.abs(acceleration), LEAST_DIVISOR))
        square = (speed_after_reaction - u) * (speed_after_reaction - u)
        unsafe_distance, safe_distance = (loss_in_reaction + square / (2 * b) for b in (self.hardest, self.comfortable))
        cfs_still_faster = _falling_ramp(gap, unsafe_distance, safe_distance)
        cfs = np.where(speed_after_reaction < u, gap < loss_to_leader_speed, cfs_still_faster)
        return np.where(v <= u, 0.0, cfs)


def _falling_ramp(gap: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """1 below `low`, 0 above `high`, linear between them; the gap [m] may be infinite."""
    width = np.maximum(high - low, LEAST_DIVISOR)
    finite_gap = np.minimum(gap, high + width)
    return np.minimum(np.maximum((high - finite_gap) / width, 0.0), 1.0)
