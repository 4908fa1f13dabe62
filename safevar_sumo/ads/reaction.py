"""Whether somebody is, or will be, in the way of a vehicle that keeps its lane."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta

from safevar_sumo.ads.pedals import Trim, pedals, trim
from safevar_sumo.records import BoolArray, Command, FloatArray, Nominal, Observation

SLOWEST_CLOSING = 0.1
"""A gap that shrinks more slowly counts as if it shrank so fast [m/s]: everything stays finite."""
FARTHEST = 1e6
"""Nobody is farther away [m]: everything stays finite."""


def time_to_reach(seen: Observation) -> FloatArray:
    """Time to collision, gap over closing speed [s]; very long while the gap does not shrink."""
    gap = np.minimum(np.maximum(seen.gap, 0.0), FARTHEST)
    return np.where(seen.closing_speed > 0, gap / np.maximum(seen.closing_speed, SLOWEST_CLOSING), FARTHEST)


def in_the_way(seen: Observation, corridor: float, reach: float = np.inf) -> BoolArray:
    """Whether somebody detected, not past yet, is within `corridor` of the lane's middle [m], or will be when he is reached.

    Nobody is detected beyond a gap of `reach` times the visibility [m].
    """
    detected = np.isfinite(seen.gap) & (seen.gap <= reach * seen.visibility) & (seen.gap > 0)
    lateral = np.where(detected, seen.lateral, FARTHEST)
    then = lateral + seen.lateral_speed * time_to_reach(seen)
    return np.asarray(detected & ((np.abs(lateral) <= corridor) | (np.abs(then) <= corridor)))


def blocks_the_way(seen: Observation, corridor: float) -> BoolArray:
    """Whether somebody detected, not past yet, is within `corridor` of the lane's middle [m] or on the way into it, and not driving off."""
    ahead = np.isfinite(seen.gap) & (seen.gap > 0) & (seen.closing_speed >= 0)
    return np.asarray(ahead & ((np.abs(seen.lateral) <= corridor) | (np.sign(seen.lateral) * seen.lateral_speed < 0)))


GRAVITY = 9.81  # m/s^2
HARDEST = 0.774 * GRAVITY
"""Deceleration of the competent and careful driver [m/s^2] (UN R157, annex 4, appendix 3)."""
JERK = 12.65
"""By how much it rises a second [m/s^3] (ibid.)."""
CRUISE_GAIN = 1.0
"""Acceleration per error of the speed that is held [1/s]."""
TIME_ROUNDING = 1e-9
"""Times that differ by less are the same [s]."""
Start = tuple[Annotated[float, Meta(ge=0, le=1)], ...]
"""Throttle from the run's start on, one value a simulation step [-]: another driver's start, replayed."""


class Reaction(NamedTuple):
    """The original vehicle; time between calls [s]; speed to hold [m/s] and the pedals' trim, of the first look.

    `waited` is the time since the danger was first seen, negative before [s]; `asked` the deceleration [m/s^2], both (N,).
    """

    nominal: Nominal
    step: float
    held: tuple[FloatArray, Trim] | None
    waited: FloatArray
    asked: FloatArray


def unaware(n: int, nominal: Nominal, step: float) -> Reaction:
    """Nobody has seen a danger yet."""
    return Reaction(nominal, step, None, np.full(n, -1.0), np.zeros(n))


def react(seen: Observation, reaction: Reaction, danger: BoolArray, deceleration: FloatArray, *, reaction_time: float, corridor: float,
          jerk: float = JERK, lets_go: float = 0.0, cruise_speed: float | None = None, start: Start = (),
          following: FloatArray | float = np.inf) -> tuple[Command, Reaction]:
    """Pedals of drivers in a danger, which passes when nobody is ahead and nearing, or stands in the way.

    Parameters
    ----------
    danger
        Whether it is seen now; shape (N,).
    deceleration
        What is braked with once they react, shape (N,) [m/s^2]; it rises at `jerk` [m/s^3].
    reaction_time
        From the first sight of the danger to the brake [s].
    corridor
        Half the width of their way [m].
    lets_go
        Deceleration while they react [m/s^2].
    cruise_speed
        Speed that they hold [m/s], by default the one that they started with.
    start
        Throttle that they start with as long as they see no danger.
    following
        Acceleration that they do not exceed, shape (N,) [m/s^2]: of those who follow somebody.
    """
    held = reaction.held
    if held is None:
        speed = seen.speed if cruise_speed is None else np.full_like(seen.speed, cruise_speed)
        held = speed, trim(reaction.nominal, seen)
    nears = np.isfinite(seen.gap) & (seen.gap > 0) & (seen.closing_speed > 0)
    lasts = nears | blocks_the_way(seen, corridor)
    aware = reaction.waited >= 0
    waited = np.where(aware, np.where(lasts, reaction.waited + reaction.step, -1.0), np.where(danger, 0.0, -1.0))
    brakes = waited >= reaction_time - TIME_ROUNDING
    asked = np.where(brakes, np.minimum(reaction.asked + jerk * reaction.step, deceleration), 0.0)
    holding = np.minimum(CRUISE_GAIN * (held[0] - seen.speed), following)
    acceleration = np.where(brakes, -asked, np.where((waited >= 0) & (lets_go > 0), -lets_go, holding))
    command = pedals(reaction.nominal, seen.speed, acceleration, held[1])
    sample = round(seen.time / reaction.step)
    if sample < len(start):
        starts = waited < 0
        command = Command(np.where(starts, start[sample], command.throttle), np.where(starts, 0.0, command.brake))
    return command, reaction._replace(held=held, waited=waited, asked=asked)
