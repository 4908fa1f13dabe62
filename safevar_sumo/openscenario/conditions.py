"""Conditions of triggers: each is a function with the standard's name that tells at which samples of a window it holds.

The names are those of the classes in the class reference of ASAM OpenSCENARIO XML 1.3.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from safevar_sumo.openscenario.actors import STEP, Actor, Array
from safevar_sumo.openscenario.document import Element, attribute, number, part, unsupported
from safevar_sumo.openscenario.expressions import RULES, compare
from safevar_sumo.openscenario.places import Way

if TYPE_CHECKING:
    from safevar_sumo.openscenario.storyboard import Player

REACTIONS = (
    "CollisionCondition",
    "StandStillCondition",
    "AccelerationCondition",
    "SpeedCondition",
    "RelativeSpeedCondition",
)
"""Conditions whose value, if they watch Ego, only a run can tell."""


def compared(condition: Element, values: Array, limit: str = "value", otherwise: str = "equalTo") -> Array:
    """Where values satisfy the condition's rule."""
    rule = condition.get("rule", otherwise)
    if rule not in RULES:
        raise unsupported(f"{condition.tag}: the rule {rule} is not supported")
    return RULES[rule](values, number(condition, limit))


def holds(player: Player, trigger: Element | None, window: slice) -> Array:
    """At which samples of a window a trigger (class Trigger) holds; without one at all."""
    found = np.full(window.stop - window.start, trigger is None)
    for group in () if trigger is None else trigger.findall("ConditionGroup"):
        conditions = [_condition(player, each, window) for each in group.findall("Condition")]
        found = found | np.logical_and.reduce(conditions)
    return found


def _condition(player: Player, condition: Element, window: slice) -> Array:
    """Class Condition: with its edge, after its delay; it is unknown before it is asked for the first time."""
    first, seen = player.seen.setdefault(id(condition), (window.start, np.zeros(len(player.times) + 1, bool)))
    seen[window] = _value(player, condition, window)
    samples = np.arange(window.start, window.stop) - round(number(condition, "delay", 0.0) / STEP)
    now = (samples >= first) & seen[samples]
    has_before = samples > first
    before = seen[samples - 1]
    match condition.get("conditionEdge", "none"):
        case "none":
            return now
        case "rising":
            return now & has_before & ~before
        case "falling":
            return ~now & has_before & before
        case "risingOrFalling":
            return has_before & (now != before)
    raise unsupported(f"conditionEdge {condition.get('conditionEdge')} is not supported")


def _value(player: Player, condition: Element, window: slice) -> Array:
    kind = part(condition, "*")
    inner = part(kind, "EntityCondition/*" if kind.tag == "ByEntityCondition" else "*")
    if kind.tag == "ByValueCondition" and inner.tag in BY_VALUE:
        return BY_VALUE[inner.tag](player, inner, window)
    if kind.tag != "ByEntityCondition" or inner.tag not in BY_ENTITY:
        raise unsupported(f"{inner.tag} is not supported")
    if inner.get("direction", "longitudinal") != "longitudinal":
        raise unsupported(f"{inner.tag} with direction = {inner.get('direction')} is not supported")
    triggering = part(kind, "TriggeringEntities")
    actors = [player.other(each) for each in triggering.findall("EntityRef")]
    values = [BY_ENTITY[inner.tag](player, inner, actor, window) & (actor.deleted > player.now) for actor in actors]
    rule = triggering.get("triggeringEntitiesRule")
    if rule == "all":
        return np.logical_and.reduce(values)
    return np.logical_or.reduce(values) ^ (rule == "none")


def watched(player: Player, trigger: Element | None) -> list[str]:
    """Conditions of a trigger that watch Ego."""
    found = []
    for kind in () if trigger is None else trigger.iter("ByEntityCondition"):
        if any(each.get("entityRef") == player.ego.name for each in kind.iter()):
            found.append(part(kind, "EntityCondition/*").tag)
    return found


# By value


def simulation_time_condition(player: Player, condition: Element, window: slice) -> Array:
    """SimulationTimeCondition [s]."""
    return compared(condition, player.times[window])


def storyboard_element_state_condition(player: Player, condition: Element, window: slice) -> Array:
    """StoryboardElementStateCondition: transitions hold at the moment at which they happen."""
    kind = attribute(condition, "storyboardElementType").lower()
    name = attribute(condition, "storyboardElementRef")
    times = player.times[window]
    state = attribute(condition, "state")
    began, ended = (
        min(
            (time for (of, path), time in states.items() if of == kind and f"::{path}".endswith(f"::{name}")),
            default=np.inf,
        )
        for states in (player.begun, player.ended)
    )
    match state:
        case "completeState":
            return times >= ended - 1e-9
        case "endTransition" | "stopTransition":
            return np.abs(times - ended) < 1e-9
        case "runningState":
            return (times >= began - 1e-9) & ~(times >= ended - 1e-9)
        case "startTransition":
            return np.abs(times - began) < 1e-9
        case "standbyState":
            return ~(times >= began - 1e-9)
        case "skipTransition":
            return np.zeros(len(times), bool)
    raise unsupported(f"the state {state} is not supported")


def parameter_condition(player: Player, condition: Element, window: slice) -> Array:
    """ParameterCondition: parameters do not change in a run."""
    return _of_name(player, condition, attribute(condition, "parameterRef").lstrip("$"), player.document.values, window)


def variable_condition(player: Player, condition: Element, window: slice) -> Array:
    """VariableCondition: variables keep their first value."""
    return _of_name(player, condition, attribute(condition, "variableRef").lstrip("$"), player.variables, window)


def _of_name(player: Player, condition: Element, name: str, values: dict[str, str], window: slice) -> Array:
    if name not in values:
        raise unsupported(f"the file declares no parameter {name}")
    holds = compare(attribute(condition, "rule"), values[name], attribute(condition, "value"))
    return np.full(len(player.times[window]), holds)


# By entity


def relative_distance_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """RelativeDistanceCondition [m]."""
    return compared(condition, distance(condition, actor, player.other(condition), window))


def time_headway_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """TimeHeadwayCondition: the distance over the triggering entity's speed [s]."""
    gap = distance(condition, actor, player.other(condition), window)
    speed = actor.speed[window]
    return compared(condition, np.where(speed > 0, gap / np.maximum(speed, 1e-9), np.inf))


def time_to_collision_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """TimeToCollisionCondition: the distance over the speed at which it shrinks [s]."""
    target = condition.find("TimeToCollisionConditionTarget/EntityRef")
    if target is None:
        raise unsupported("TimeToCollisionCondition with a position is not supported")
    other = player.other(target)
    gap = distance(condition, actor, other, window)
    closing = actor.speed[window] - _along(actor, other, window)
    return compared(condition, np.where(closing > 0, gap / np.maximum(closing, 1e-9), np.inf))


def traveled_distance_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """TraveledDistanceCondition [m]."""
    return actor.travelled[window] >= number(condition, "value") - 1e-9


def reach_position_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """ReachPositionCondition: within the tolerance of a position [m]."""
    goal = player.place(part(condition, "Position/*")).pose.place
    return np.abs(actor.place[window] - goal) <= number(condition, "tolerance")


def distance_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """DistanceCondition: from a position [m]; the bodies' ends do not count."""
    if condition.get("freespace") == "true":
        raise unsupported("DistanceCondition with freespace = true is not supported")
    gap = (player.place(part(condition, "Position/*")).pose.place - actor.place[window]) / actor.facing[window]
    match condition.get("relativeDistanceType", "euclidianDistance"):
        case "longitudinal":
            return compared(condition, np.abs(gap.real))
        case "lateral":
            return compared(condition, np.abs(gap.imag))
    return compared(condition, np.abs(gap))


def speed_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """SpeedCondition [m/s]."""
    return compared(condition, actor.speed[window])


def relative_speed_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """RelativeSpeedCondition [m/s]."""
    return compared(condition, actor.speed[window] - _along(actor, player.other(condition), window))


def stand_still_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """StandStillCondition [s]."""
    return actor.standing[window] >= number(condition, "duration") - 1e-9


def acceleration_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """AccelerationCondition [m/s^2]: in the last step."""
    before = np.arange(window.start, window.stop) - 1
    change = actor.speed[window] - actor.speed[np.maximum(before, 0)]
    return compared(condition, change / STEP)


def collision_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """CollisionCondition: the actors of a file are not asked, and an Ego that holds its speed has no collision."""
    return np.zeros(len(player.times[window]), bool)


def end_of_road_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """EndOfRoadCondition: a scene ends where somebody is at the end of its road."""
    return np.zeros(len(player.times[window]), bool)


def offroad_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """OffroadCondition: Ego drives straight on in its lane."""
    if actor is not player.ego:
        raise unsupported(f"OffroadCondition of {actor.name} is not supported")
    return np.zeros(len(player.times[window]), bool)


def _along(actor: Actor, other: Actor, window: slice) -> Array:
    """Speed of another actor in an actor's direction [m/s]."""
    return other.speed[window] * (other.facing[window] / actor.facing[window]).real


def distance(condition: Element, actor: Actor, other: Actor, window: slice) -> Array:
    """The distance that a condition measures [m]: of origins, or with `freespace` of bodies."""
    is_free = condition.get("freespace") == "true"
    kind = condition.get("relativeDistanceType", "longitudinal")
    if _is_along_road(condition, kind, actor):
        return _along_road(condition, actor, other, window, is_free)
    facing = actor.facing[window]
    apart = (other.place[window] - actor.place[window]) / facing
    if kind in ("cartesianDistance", "euclidianDistance"):
        if is_free:
            raise unsupported(f"{condition.tag} with {kind} and freespace = true is not supported")
        return np.abs(apart)
    if not is_free:
        return np.abs(apart.real if kind == "longitudinal" else apart.imag)
    turn = other.facing[window] / facing
    middle = apart + turn * complex(other.shape.ahead, other.shape.left) - complex(actor.shape.ahead, actor.shape.left)
    cosine = np.abs(turn.real)
    sine = np.abs(turn.imag)
    if kind == "longitudinal":
        reach = (cosine * other.shape.length + sine * other.shape.width + actor.shape.length) / 2
        return np.maximum(np.abs(middle.real) - reach, 0.0)
    reach = (sine * other.shape.length + cosine * other.shape.width + actor.shape.width) / 2
    return np.maximum(np.abs(middle.imag) - reach, 0.0)


def _is_along_road(condition: Element, kind: str, actor: Actor) -> bool:
    """Whether a distance is one along a road that bends."""
    system = condition.get("coordinateSystem", "entity")
    path = actor.here.path
    return kind == "longitudinal" and system in ("road", "lane") and isinstance(path, Way) and not path.is_straight


def _along_road(condition: Element, actor: Actor, other: Actor, window: slice, is_free: bool) -> Array:
    own = actor.here.path
    its = other.here.path
    if not (isinstance(own, Way) and isinstance(its, Way) and own.chain == its.chain):
        raise unsupported(f"{condition.tag} along a road, of entities on different roads")
    gap = other.distance[window] - actor.distance[window]
    if not is_free:
        return np.abs(gap)
    ahead = gap + other.shape.rear - actor.shape.front
    behind = actor.shape.rear - gap - other.shape.front
    return np.maximum(np.maximum(ahead, behind), 0.0)


BY_VALUE: dict[str, Callable[[Player, Element, slice], Array]] = {
    "SimulationTimeCondition": simulation_time_condition,
    "StoryboardElementStateCondition": storyboard_element_state_condition,
    "ParameterCondition": parameter_condition,
    "VariableCondition": variable_condition,
}
BY_ENTITY: dict[str, Callable[[Player, Element, Actor, slice], Array]] = {
    "RelativeDistanceCondition": relative_distance_condition,
    "TimeHeadwayCondition": time_headway_condition,
    "TimeToCollisionCondition": time_to_collision_condition,
    "TraveledDistanceCondition": traveled_distance_condition,
    "ReachPositionCondition": reach_position_condition,
    "DistanceCondition": distance_condition,
    "SpeedCondition": speed_condition,
    "RelativeSpeedCondition": relative_speed_condition,
    "StandStillCondition": stand_still_condition,
    "AccelerationCondition": acceleration_condition,
    "CollisionCondition": collision_condition,
    "EndOfRoadCondition": end_of_road_condition,
    "OffroadCondition": offroad_condition,
}
"""Conditions that are supported, by the standard's names."""
