"""SynchronizeAction: an actor and its master reach their positions at the same time."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from safevar_sumo.openscenario.actors import STEP, Actor, Array, Running
from safevar_sumo.openscenario.document import Element, attribute, number, part, unsupported
from safevar_sumo.openscenario.player import Player


def relative_speed(target: Element, speed: float) -> float:
    """A speed relative to another one [m/s] (enumeration SpeedTargetValueType)."""
    value = number(target, "value")
    is_factor = target.get("speedTargetValueType") == "factor"
    return speed * value if is_factor else speed + value


def synchronize_action(player: Player, action: Element, actor: Actor) -> list[Running]:
    """SynchronizeAction: the actor and its master, whose speed is known until then, reach their
    positions at the same time.

    Up to its steady state the actor changes its speed evenly twice, each time for half of the time;
    one that stands waits, and then accelerates evenly. Then its speed is the final one.
    """
    master = player.actor(attribute(action, "masterEntityRef"))
    goal = player.place(part(action, "TargetPositionMaster/*"))
    time, speed_there = _arrival(player, master, master.here.way_to(goal))
    if not 0 < time < math.inf:
        raise unsupported(
            f"SynchronizeAction: {master.name} does not move towards its position",
            "a position ahead of it, and a speed above 0",
        )
    way = actor.here.way_to(player.place(part(action, "TargetPosition/*")))
    final = way / time
    steady_time = 0.0
    steady_way = 0.0
    if (target := action.find("FinalSpeed/*")) is not None:
        final = number(target, "value")
        if target.tag == "RelativeSpeedToMaster":
            if master is not player.ego:
                raise unsupported(
                    f"RelativeSpeedToMaster: {master.name} may change its speed",
                    "a master that is the vehicle under test",
                )
            final = relative_speed(target, speed_there)
        for steady in target:
            is_way = steady.tag == "TargetDistanceSteadyState"
            steady_way = number(steady, "distance") if is_way else number(steady, "time") * final
            steady_time = steady_way / final if final else 0.0
    if final < 0:
        raise unsupported(
            f"{actor.name} drives backwards ({final:.2f} m/s)", "a final speed of at least 0"
        )
    until = time - steady_time
    rest = way - steady_way
    if rest < -1e-6 or until < -1e-6:
        where = f"{way:.1f} m and {time:.1f} s before its position"
        raise unsupported(
            f"SynchronizeAction: {actor.name} is {where}, within its steady state",
            "a position farther away, or a shorter steady state",
        )
    player.masters[master.name] = player.now + time, actor.name
    player.depends(
        master, player.now + until, f"{actor.name}'s SynchronizeAction with {master.name}"
    )
    return [actor.begin("along", time, player.now, _approach(player, actor, until, rest, final))]


def _arrival(player: Player, master: Actor, way: float) -> tuple[float, float]:
    """The time in which an actor drives a way [s], and its speed there [m/s]."""
    speed = master.speed_now
    since = player.times - player.now
    later = since[player.sample :]
    if master.along is not None:
        begun = player.now - master.along.since
        speeds = np.broadcast_to(master.along.value(later + begun), later.shape)
        if np.ptp(speeds):  # it changes its speed meanwhile
            ways = np.concatenate([[0.0], np.cumsum(speeds[1:] + speeds[:-1]) * STEP / 2])
            index = int(np.searchsorted(ways, way))
            if index == len(ways):
                return math.inf, 0.0
            time = np.interp(way, ways[: index + 1], later[: index + 1])
            return float(time), float(speeds[index])
    return way / speed if speed else math.inf, speed


def _approach(
    player: Player, actor: Actor, until: float, way: float, final: float
) -> Callable[[Array], Array]:
    """Speeds of a way [m] in a time [s] that end at a final speed [m/s]."""
    start = actor.speed_now
    if way <= 1e-6:
        return lambda time: np.full_like(time, final)
    if not start and final and until >= 2 * way / final:
        ramp = 2 * way / final
        return lambda time: final * np.clip((time - until + ramp) / ramp, 0.0, 1.0)
    middle = 2 * way / until - (start + final) / 2
    if middle < 0:
        raise unsupported(
            f"SynchronizeAction: {actor.name} would have to drive backwards",
            "a final speed with which the way takes as long",
        )
    if not start:
        player.remark(
            f"{actor.name} begins to move at once: it has only {until:.2f} s for {way:.2f} m"
        )
    return lambda time: np.interp(time, [0.0, until / 2, until], [start, middle, final])
