"""The competent and careful human driver of UN Regulation No. 157, annex 4, appendix 3."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.ads.base import (
    NonNegativeParameter,
    PositiveParameter,
    is_ahead,
    is_in_the_way,
    moves_inwards,
    time_to_reach,
)
from safevar_sumo.ads.reaction import (
    DECELERATION_ROUNDING,
    HARDEST_BRAKING,
    LEAST_DIVISOR,
    Danger,
    Reaction,
    ReferenceDriver,
    StartThrottle,
)
from safevar_sumo.records import (
    TIME_ROUNDING,
    BoolArray,
    Command,
    FloatArray,
    Nominal,
    Observation,
)


class _Perceiving(NamedTuple):
    """What the competent driver remembers of N vehicles; arrays have shape (N,).

    Attributes
    ----------
    reaction
        The memory of every reference driver.
    first_lateral
        Lateral position at which the driver first saw the obstacle [m]; infinite before.
    appeared_in_way
        Whether this position was in the way, and no obstacle had strayed before.
    stray_time
        Time since an obstacle first strayed from its first position [s]; negative before.
    braking_time
        Time since a leader began to brake harder than `leader_braking` [s]; negative before.
    was_in_way
        Whether the obstacle was in the way at the last call.
    """

    reaction: Reaction
    first_lateral: FloatArray
    appeared_in_way: BoolArray
    stray_time: FloatArray
    braking_time: FloatArray
    was_in_way: BoolArray


class CompetentDriver(ReferenceDriver, frozen=True, kw_only=True):
    """The competent and careful human driver of UN R157, annex 4, appendix 3 (longitudinal part).

    The driver holds the initial speed, and so keeps the gap to a leader of the same speed. When the
    driver perceives a danger, the driver reacts, and brakes with up to 0.774 g. A danger is

    - somebody who enters the way, or stands or drives steadily in the way, at a time to collision
      (TTC) below 2 s; towards a standing car this TTC is a time headway of 2 s; a car that cuts in
      is a danger wherever the vehicle will meet this car, also beside the vehicle;
    - a leader that brakes harder than `leader_braking`, whatever the TTC. UN R157 names no danger
      if the leader brakes with less than 5 m/s^2, so by default the driver does not react to such
      braking.

    While the driver reacts, the driver releases the accelerator. The driver does not press the
    accelerator again while the cause of the danger blocks the way. After a stop, the driver waits
    until the way is clear, and does not follow a leader that drives on after braking.

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    critical_ttc, reaction_time
        Time to collision that counts as a danger, and reaction time before braking [s].
    stray, perception_time
        The driver perceives an obstacle that enters the way `perception_time` after this obstacle
        has moved `stray` from its first lateral position [m, s]. If a leader leaves the way and
        reveals an obstacle, the driver perceives this obstacle `perception_time` after the leader
        has moved `stray`.
    leader_braking
        Deceleration of a leader above which the braking is a danger [m/s^2], which the driver
        perceives `perception_time` after the braking begins; 5 by the letter of the regulation, 0.5
        for any braking.
    lets_go
        Deceleration with the accelerator released, while the driver reacts [m/s^2]; the driver
        brakes a vehicle that coasts with less.
    corridor
        Half the width of the corridor that the driving system watches [m].
    start_throttle
        Throttle in the run's first steps, one value per step, until the driver sees a danger [-].
    """

    critical_ttc: PositiveParameter = 2.0
    reaction_time: NonNegativeParameter = 0.75
    stray: NonNegativeParameter = 0.375
    perception_time: NonNegativeParameter = 0.4
    leader_braking: NonNegativeParameter = 5.0
    lets_go: NonNegativeParameter = 0.4
    start_throttle: StartThrottle = ()

    def start(self, n: int, nominal: Nominal, step: float) -> _Perceiving:
        reaction = ReferenceDriver.start(self, n, nominal, step)
        never = np.full(n, -1.0)
        nobody = np.zeros(n, bool)
        return _Perceiving(reaction, np.full(n, np.inf), nobody, never, never, nobody)

    def drive(
        self, observation: Observation, memory: _Perceiving
    ) -> tuple[Command, _Perceiving]:
        step = memory.reaction.step
        is_same = observation.obstacle == memory.reaction.leader
        is_perceived, memory = self._perceive(observation, memory, is_same)
        # Somebody cuts in who moves towards the middle of the lane, and faster along the lane than
        # across it.
        moves_along = observation.obstacle_speed >= np.abs(observation.lateral_speed)
        cuts_in = is_ahead(observation) & moves_inwards(observation) & moves_along
        is_in_way = is_perceived & (is_in_the_way(observation, self.corridor) | cuts_in)
        reaction = self.watch_leader(observation, memory.reaction, is_in_way)

        # The time since a leader began to brake so hard that the braking is a danger. The driver
        # sees the braking one step later: the time begins with one step.
        brakes_now = (
            reaction.leader_deceleration > self.leader_braking + DECELERATION_ROUNDING
        )
        new_braking_time = np.where(brakes_now, step, -1.0)
        has_begun = is_same & (memory.braking_time >= 0)
        braking_time = np.where(has_begun, memory.braking_time + step, new_braking_time)
        is_noticed = braking_time >= self.perception_time - TIME_ROUNDING
        brakes = is_noticed & ((observation.closing_speed > 0) | reaction.leader_brakes)

        # If the obstacle does not brake, the time to collision decides.
        nearness = self.critical_ttc - time_to_reach(observation)
        is_danger = is_in_way & (brakes | ((nearness > 0) & ~reaction.leader_brakes))

        # A danger may have begun before this step. Its age is at most the time since the driver
        # could perceive it.
        perceived_time = np.where(
            is_same & memory.was_in_way, step, memory.stray_time - self.perception_time
        )
        danger = Danger(
            is_danger,
            HARDEST_BRAKING,
            self.reaction_time,
            released=self.lets_go,
            nearness=np.where(brakes, np.inf, nearness),
            longest=np.where(
                brakes, braking_time - self.perception_time, perceived_time
            ),
        )
        command, reaction = self.react(
            observation, reaction, danger, self.start_throttle
        )
        braking_time = np.where(is_in_way, braking_time, -1.0)
        return command, memory._replace(
            reaction=reaction, braking_time=braking_time, was_in_way=is_in_way
        )

    def _perceive(
        self, observation: Observation, memory: _Perceiving, is_same: BoolArray
    ) -> tuple[BoolArray, _Perceiving]:
        """Decide for which vehicles the driver perceives the obstacle: the obstacle first appeared
        in the way, or strayed from its first position at least `perception_time` ago.
        """
        # The place of the obstacle at first sight, and whether this place is in the way.
        is_sighted = np.isfinite(observation.gap) & np.isfinite(observation.lateral)
        lateral = np.where(is_sighted, observation.lateral, 0.0)
        is_first_sight = is_sighted & ~(is_same & np.isfinite(memory.first_lateral))
        first_lateral = np.where(is_first_sight, lateral, memory.first_lateral)
        is_in_corridor = (
            np.abs(lateral) <= self.corridor + observation.obstacle_width / 2
        )
        appears_in_way = is_in_corridor & (memory.stray_time < 0)
        appeared_in_way = np.where(
            is_first_sight, appears_in_way, memory.appeared_in_way
        )

        # The time since the obstacle has strayed from its first place.
        deviation = np.abs(
            lateral - np.where(np.isfinite(first_lateral), first_lateral, 0.0)
        )
        strays_now = is_sighted & (deviation >= self.stray)
        drift = np.maximum(np.abs(observation.lateral_speed), LEAST_DIVISOR)
        new_stray_time = np.where(
            strays_now,
            np.minimum((deviation - self.stray) / drift, memory.reaction.step),
            -1.0,
        )
        old_time = memory.stray_time
        stray_time = np.where(
            old_time >= 0, old_time + memory.reaction.step, new_stray_time
        )
        is_perceived = appeared_in_way | (
            stray_time >= self.perception_time - TIME_ROUNDING
        )
        return is_perceived, memory._replace(
            first_lateral=first_lateral,
            appeared_in_way=appeared_in_way,
            stray_time=stray_time,
        )
