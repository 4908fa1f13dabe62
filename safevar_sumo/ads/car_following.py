"""SUMO's car-following models as ADSs: Krauss, the intelligent driver model, and adaptive cruise
control.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated

import numpy as np
from msgspec import Meta

from safevar_sumo.ads.base import (
    CORRIDOR,
    LARGEST_GAP,
    Ads,
    NonNegativeParameter,
    PositiveParameter,
    Trim,
    is_in_the_way,
    trim_at,
)
from safevar_sumo.records import (
    Command,
    FloatArray,
    Nominal,
    Observation,
    clip_to_share,
)
from safevar_sumo.study import PositiveProportion, Table

# Defaults of SUMO's class MSCFModel_ACC. The mode that holds a speed has one gain, of the speed
# error [1/s]. Each other mode has two gains: of the relative speed [1/s], and of the error of the
# gap [1/s^2].
SPEED_GAIN = -0.4
CLOSING_GAINS = 0.8, 0.04
KEEPING_GAINS = 0.07, 0.23
AVOIDING_GAINS = 0.23, 0.8
FOLLOWING_GAP = 100.0  # m, largest gap at which the vehicle follows a leader
# Below both errors the mode that keeps the gap applies.
GAP_TOLERANCE = 0.2  # m
SPEED_TOLERANCE = 0.1  # m/s
LEAST_GAP = 0.001  # m; NUMERICAL_EPS of SUMO
# m/s^2, an assumption: a vehicle that drives at v_safe approaches the standing gap ever more
# slowly, and never stops. With this deceleration the vehicle stops.
LAST_DECELERATION = 0.5


_Following = tuple[Nominal, Trim | None]
"""A driver's memory: the original vehicle, and the trim of the pedals that held the speed at the
start (None before the first call).
"""


class CarFollowing(Ads, Table, frozen=True, kw_only=True):
    """Base of the models that compute an acceleration from the gap, the vehicle's speed and the
    leader's speed. The models ignore obstacles beside the vehicle's way.
    """

    cruise_speed: PositiveParameter = 13.89
    headway: PositiveParameter = 1.0
    standing_gap: Annotated[float, Meta(ge=0, le=100)] = 2.5
    corridor: PositiveParameter = CORRIDOR

    def start(self, n: int, nominal: Nominal, step: float) -> _Following:
        return nominal, None

    def drive(
        self, observation: Observation, memory: _Following
    ) -> tuple[Command, _Following]:
        nominal, trim = memory
        trim = trim or trim_at(nominal, observation)
        gap = np.where(
            is_in_the_way(observation, self.corridor), observation.gap, LARGEST_GAP
        )
        acceleration = self.acceleration_at(
            gap, observation.speed, observation.obstacle_speed
        )
        command = self.pedals(acceleration, observation.speed, nominal, trim)
        return command, (nominal, trim)

    @abstractmethod
    def acceleration_at(
        self, gap: FloatArray, speed: FloatArray, leader_speed: FloatArray
    ) -> FloatArray:
        """The acceleration that the model commands [m/s^2], shape (N,). The gap is measured between
        bumpers [m]; both speeds are in m/s. `gap` is `LARGEST_GAP` if nobody is in the way.
        """


class Acc(CarFollowing, frozen=True, kw_only=True):
    """Holds a speed, or a time headway behind a leader (Milanes and Shladover 2014; Xiao, Wang, van
    Arem 2017; `MSCFModel_ACC`).

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s].
    headway, standing_gap
        Desired time headway [s], and additional gap [m].
    corridor
        Half the width of the corridor that the driving system watches [m].
    """

    def acceleration_at(
        self, gap: FloatArray, speed: FloatArray, leader_speed: FloatArray
    ) -> FloatArray:
        """The acceleration by the control law of the mode that applies [m/s^2], shape (N,), at most
        that of the mode that holds the speed. Near standstill the desired gap is 2 m larger than by
        the headway (Xiao et al. 2017).
        """
        excess_speed = speed - self.cruise_speed
        relative_speed = leader_speed - speed
        standing_distance = np.minimum(
            np.maximum(75 / np.maximum(speed, 1.0) - 5, 0.0), 2.0
        )
        gap_error = gap - self.standing_gap - standing_distance - self.headway * speed
        closing, keeping, avoiding = (
            speed_gain * relative_speed + gap_gain * gap_error
            for speed_gain, gap_gain in (CLOSING_GAINS, KEEPING_GAINS, AVOIDING_GAINS)
        )
        keeps_gap = (np.abs(gap_error) < GAP_TOLERANCE) & (
            np.abs(excess_speed) < SPEED_TOLERANCE
        )
        acceleration = np.where(
            keeps_gap, keeping, np.where(gap_error < 0, avoiding, closing)
        )
        # Behind a leader, too, the vehicle does not exceed its cruise speed.
        holding = SPEED_GAIN * excess_speed
        is_free = gap - self.standing_gap > FOLLOWING_GAP
        return np.where(is_free, holding, np.minimum(acceleration, holding))


class Idm(CarFollowing, frozen=True, kw_only=True):
    """The intelligent driver model (Treiber, Hennecke, Helbing 2000; `MSCFModel_IDM`).

    dv/dt = a (1 - (v / v0)^4 - (s* / s)^2), s* = s0 + max(0, v T + v (v - u) / (2 sqrt(a b))) at
    speed v, gap s, leader speed u.

    Parameters
    ----------
    cruise_speed
        v0 [m/s].
    headway, standing_gap
        T [s], s0 [m].
    acceleration, deceleration
        a, b [m/s^2].
    corridor
        Half the width of the corridor that the driving system watches [m].
    """

    tau_parameter = "headway"
    acceleration: PositiveParameter = 2.6
    deceleration: PositiveParameter = 4.5

    def acceleration_at(
        self, gap: FloatArray, speed: FloatArray, leader_speed: FloatArray
    ) -> FloatArray:
        """The acceleration dv/dt of the formula above [m/s^2], shape (N,)."""
        speed_ratio = speed / self.cruise_speed
        closing_term = (
            speed
            * (speed - leader_speed)
            / (2 * np.sqrt(self.acceleration * self.deceleration))
        )
        desired_gap = self.standing_gap + np.maximum(
            speed * self.headway + closing_term, 0.0
        )
        positive_gap = np.maximum(gap, LEAST_GAP)
        free_road = 1 - speed_ratio * speed_ratio * speed_ratio * speed_ratio
        return np.asarray(
            self.acceleration
            * (free_road - desired_gap * desired_gap / (positive_gap * positive_gap))
        )


class Krauss(Ads, Table, frozen=True, kw_only=True):
    """SUMO's default model (Krauss 1998; `MSCFModel_Krauss`).

    The model never drives so fast that the original vehicle could not stop before an obstacle ahead
    (after the reaction time, with the planned deceleration). The model takes each obstacle as a
    standing one, unlike SUMO's: a leader may stop at once, and a pedestrian has no speed along the
    lane. Behind a leader that drives, the vehicle therefore keeps a larger gap than SUMO's.

    Parameters
    ----------
    cruise_speed
        Desired speed [m/s].
    standing_gap
        Intended gap at standstill [m].
    braking_share
        Planned deceleration as a share of the original vehicle's greatest deceleration [-].
    reaction_time
        Planned time until braking begins [s].
    """

    tau_parameter = "reaction_time"
    cruise_speed: PositiveParameter = 13.89
    standing_gap: NonNegativeParameter = 2.5
    braking_share: PositiveProportion = 0.6
    reaction_time: NonNegativeParameter = 1.0

    def start(self, n: int, nominal: Nominal, step: float) -> tuple[Nominal, float]:
        return nominal, step

    def drive(
        self, observation: Observation, memory: tuple[Nominal, float]
    ) -> tuple[Command, tuple[Nominal, float]]:
        """Aim at the speed v_safe = -b t + sqrt((b t)^2 + 2 b gap), but at most at the cruise
        speed. b is the planned deceleration [m/s^2], and t is the reaction time [s].

        A vehicle at v_safe can still stop behind a standing obstacle. For the last metres the
        driver aims at a higher speed, from which the vehicle stops at `LAST_DECELERATION`.
        """
        nominal, step = memory
        deceleration = self.braking_share * nominal.decel
        reaction_speed = deceleration * self.reaction_time
        gap = np.minimum(
            np.maximum(observation.gap - self.standing_gap, 0.0), LARGEST_GAP
        )
        safe_speed = (
            np.sqrt(reaction_speed * reaction_speed + 2 * deceleration * gap)
            - reaction_speed
        )
        safe_speed = np.maximum(safe_speed, np.sqrt(2 * LAST_DECELERATION * gap))
        speed_change = np.minimum(safe_speed, self.cruise_speed) - observation.speed
        acceleration = speed_change / (step + nominal.actuator_lag)
        throttle = clip_to_share(acceleration / nominal.accel)
        brake = clip_to_share(-acceleration / nominal.decel)
        return Command(throttle, brake), memory
