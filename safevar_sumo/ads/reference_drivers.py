"""Reference drivers, with which a driving system is compared. A reference driver holds its speed
until it sees a danger, reacts, and brakes.

UN Regulation No. 157 intends its drivers for cars that cut in, cut out or brake on motorways. This
package also uses them for pedestrians.
"""

from __future__ import annotations

import numpy as np

from safevar_sumo.ads.base import (
    NonNegativeParameter,
    PositiveParameter,
    depth_in_the_way,
    is_in_the_way,
    time_to_reach,
)
from safevar_sumo.ads.reaction import (
    HARDEST_BRAKING,
    LEAST_DIVISOR,
    Danger,
    Reaction,
    ReferenceDriver,
    StartThrottle,
)
from safevar_sumo.records import (
    KMH_PER_MS,
    Command,
    FloatArray,
    Observation,
    clip_to_share,
)

UNLIMITED_BRAKING = 1e6
"""A deceleration that no brake reaches [m/s^2]: a driver who wants it presses the pedal fully."""
GAP_ROUNDING = 1e-6
"""Difference below which two gaps count as equal [m]."""


class FullBraking(ReferenceDriver, frozen=True, kw_only=True):
    """Brakes fully as soon as the vehicle approaches an obstacle that is in its way, or will be
    when the vehicle arrives: the best that a driver can do.

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    corridor
        Half the width of the corridor that the driving system watches [m].
    start_throttle
        Throttle in the run's first steps, one value per step, until the driver brakes [-].
    """

    start_throttle: StartThrottle = ()

    def drive(
        self, observation: Observation, memory: Reaction
    ) -> tuple[Command, Reaction]:
        is_in_way = is_in_the_way(observation, self.corridor)
        memory = self.watch_leader(observation, memory, is_in_way)
        is_present = is_in_way & (observation.closing_speed > 0)
        danger = Danger(is_present, UNLIMITED_BRAKING, reaction_time=0.0, jerk=np.inf)
        return self.react(observation, memory, danger, self.start_throttle)


class R157(ReferenceDriver, frozen=True, kw_only=True):
    """An automated lane keeping system that does what UN R157, 5.2.5, demands, and no more.

    The system reacts to an obstacle that enters its way, or stands or drives steadily in its way,
    if the time to collision is below (v - u) / (2 * 6 m/s^2) + 0.35 s + 0.1 s (v, u: speeds of the
    vehicle and the obstacle). Below this time to collision, the system brakes with 6 m/s^2. UN R157
    states this time to collision for cars that cut in (5.2.5.2). If a leader brakes, the system
    must avoid a collision only if the time gap to the leader before the braking was at least 1 s +
    v / (100 km/h) s (5.2.5.1). With a time gap below 1 s + v / (100 km/h) s, UN R157 demands
    nothing, and the system does not react to the leader's braking.

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    deceleration, reaction_time, margin
        6 m/s^2, 0.35 s and 0.1 s in the regulation.
    corridor
        Half the width of the corridor that the driving system watches [m].
    """

    deceleration: PositiveParameter = 6.0
    reaction_time: NonNegativeParameter = 0.35
    margin: NonNegativeParameter = 0.1

    def drive(
        self, observation: Observation, memory: Reaction
    ) -> tuple[Command, Reaction]:
        depth = depth_in_the_way(observation, self.corridor)

        # If the obstacle does not brake, the time to collision decides.
        critical_ttc = (
            observation.closing_speed / (2 * self.deceleration)
            + self.reaction_time
            + self.margin
        )
        when_steady = np.minimum(depth, critical_ttc - time_to_reach(observation))

        # Find out whether the gap was too short before the leader began to brake. Only gaps to a
        # leader whom the driver has seen before count.
        is_same = observation.obstacle == memory.leader
        was_seen = is_same & (memory.leader_speed > 0) | (memory.cruise is None)
        memory = self.watch_leader(observation, memory, depth >= 0)
        least_gap = observation.speed * (1 + observation.speed * KMH_PER_MS / 100)
        is_near = observation.gap < least_gap - GAP_ROUNDING
        is_steady = was_seen & ~memory.leader_has_braked
        is_undercut = np.where(is_steady, is_near, memory.is_undercut & is_same)

        # If the leader brakes, only the gap before this braking decides.
        when_braking = np.where(memory.leader_brakes & ~is_undercut, np.inf, -np.inf)
        nearness = np.where(memory.leader_has_braked, when_braking, when_steady)
        danger = Danger(
            nearness > 0,
            self.deceleration,
            self.reaction_time,
            np.inf,
            nearness=nearness,
        )
        return self.react(observation, memory._replace(is_undercut=is_undercut), danger)


class Rss(ReferenceDriver, frozen=True, kw_only=True):
    """Responsibility-sensitive safety (Shalev-Shwartz, Shammah, Shashua 2017), longitudinal part.

    The driver reacts to a gap below the safe distance, and brakes. The safe distance is v rt + a
    rt^2 / 2 + (v + rt a)^2 / (2 b) - u^2 / (2 b_u), with the speeds v and u of vehicle and leader,
    and the parameters rt, a, b and b_u.

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    reaction_time
        rt [s].
    acceleration, deceleration, leader_deceleration
        Acceleration a of the vehicle while the driver reacts, decelerations b and b_u of the
        vehicle's and of the leader's braking, with which the driver plans [m/s^2].
    braking
        Deceleration with which the driver brakes, by default 0.774 g [m/s^2].
    corridor
        Half the width of the corridor that the driving system watches [m].
    """

    reaction_time: NonNegativeParameter = 0.75
    acceleration: NonNegativeParameter = 0.0
    deceleration: PositiveParameter = HARDEST_BRAKING
    braking: PositiveParameter = HARDEST_BRAKING
    leader_deceleration: PositiveParameter = HARDEST_BRAKING

    def drive(
        self, observation: Observation, memory: Reaction
    ) -> tuple[Command, Reaction]:
        depth = depth_in_the_way(observation, self.corridor)
        memory = self.watch_leader(observation, memory, depth >= 0)
        lacking = (
            self.safe_distance(observation.speed, observation.obstacle_speed)
            - observation.gap
        )
        nearness = np.minimum(depth, lacking)
        danger = Danger(
            nearness > 0, self.braking, self.reaction_time, nearness=nearness
        )
        return self.react(observation, memory, danger)

    def safe_distance(self, speed: FloatArray, leader_speed: FloatArray) -> FloatArray:
        """The smallest safe gap [m], at speeds [m/s] of shape (N,)."""
        rt = self.reaction_time
        reaction_speed = speed + self.reaction_time * self.acceleration
        stop = (
            speed * rt
            + self.acceleration * rt * rt / 2
            + reaction_speed * reaction_speed / (2 * self.deceleration)
        )
        leader_stop = leader_speed * leader_speed / (2 * self.leader_deceleration)
        return np.maximum(stop - leader_stop, 0.0)


class FuzzySafety(ReferenceDriver, frozen=True, kw_only=True):
    """The fuzzy safety model (Mattas et al. 2020, "Fuzzy Surrogate Safety Metrics"), in UN R157 as
    amended.

    The driver brakes according to two metrics: PFS rises as the gap falls below the safe distance,
    CFS as a collision nears.

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
        Half the width of the corridor that the driving system watches [m].
    """

    reaction_time: NonNegativeParameter = 0.75
    comfortable: PositiveParameter = 4.0
    hardest: PositiveParameter = 6.0
    leader_deceleration: PositiveParameter = 7.0
    margin: NonNegativeParameter = 2.0

    def drive(
        self, observation: Observation, memory: Reaction
    ) -> tuple[Command, Reaction]:
        depth = depth_in_the_way(observation, self.corridor)
        memory = self.watch_leader(observation, memory, depth >= 0)
        gap = np.where(depth >= 0, observation.gap, np.inf)
        unsafe_distance, safe_distance = self.proactive_distances(
            observation.speed, observation.obstacle_speed
        )
        pfs = falling_ramp(gap - self.margin, unsafe_distance, safe_distance)
        cfs = self.critical_metric(
            gap,
            observation.speed,
            observation.obstacle_speed,
            memory.acceleration(observation),
        )
        critical_deceleration = (
            cfs * (self.hardest - self.comfortable) + self.comfortable
        )
        deceleration = np.minimum(
            np.where(cfs > 0, critical_deceleration, pfs * self.comfortable),
            HARDEST_BRAKING,
        )
        nearness = np.minimum(depth, safe_distance + self.margin - observation.gap)
        danger = Danger(
            (pfs > 0) | (cfs > 0), deceleration, self.reaction_time, nearness=nearness
        )
        return self.react(observation, memory, danger)

    def proactive_distances(
        self, v: FloatArray, u: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The unsafe and the safe distance of PFS [m], at the vehicle's speed v and the leader's
        speed u. PFS is 0 if the gap minus the margin is above the safe distance, and 1 if it is
        below the unsafe distance.
        """
        leader_stop = u * u / (2 * self.leader_deceleration)
        safe_distance = (
            v * self.reaction_time
            + v * v / (2 * self.comfortable)
            - leader_stop
            + self.margin
        )
        unsafe_distance = (
            v * self.reaction_time + v * v / (2 * self.hardest) - leader_stop
        )
        return unsafe_distance, safe_distance

    def critical_metric(
        self, gap: FloatArray, v: FloatArray, u: FloatArray, a: FloatArray
    ) -> FloatArray:
        """CFS in [0, 1], shape (N,), at a gap [m], the vehicle's speed v and the leader's speed u
        [m/s], and the vehicle's acceleration a [m/s^2].
        """
        acceleration = np.maximum(a, -self.comfortable)
        speed_after_reaction = v + self.reaction_time * acceleration
        # The gap that is lost in the reaction time. If the vehicle is slower than the leader then,
        # the gap that is lost until the speeds are equal.
        mean_speed = v + acceleration * self.reaction_time / 2
        loss_in_reaction = (mean_speed - u) * self.reaction_time
        divisor = 2 * np.maximum(np.abs(acceleration), LEAST_DIVISOR)
        loss_to_leader_speed = (v - u) * (v - u) / divisor
        excess = speed_after_reaction - u
        square = excess * excess
        unsafe_distance = loss_in_reaction + square / (2 * self.hardest)
        safe_distance = loss_in_reaction + square / (2 * self.comfortable)
        cfs_still_faster = falling_ramp(gap, unsafe_distance, safe_distance)
        is_too_near = gap < loss_to_leader_speed
        cfs = np.where(speed_after_reaction < u, is_too_near, cfs_still_faster)
        return np.where(v <= u, 0.0, cfs)


def falling_ramp(gap: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """A ramp over the gap [m]: 1 below `low`, 0 above `high`, linear between them. The gap may be
    infinite.
    """
    width = np.maximum(high - low, LEAST_DIVISOR)
    finite_gap = np.minimum(gap, high + width)
    return clip_to_share((high - finite_gap) / width)
