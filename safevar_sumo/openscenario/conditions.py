"""Conditions of triggers: each is a function with the standard's name that tells at which samples
of a window it holds. A window is the samples from one action to the next. Places and directions are
complex numbers: x + i y on the map, and ahead + i left from an actor.

The names are those of the classes in the class reference of ASAM OpenSCENARIO XML 1.3.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from safevar_sumo.errors import one_of
from safevar_sumo.openscenario.actors import STEP, Actor, Array
from safevar_sumo.openscenario.document import Element, attribute, number, part, truth, unsupported
from safevar_sumo.openscenario.expressions import RULES, compare
from safevar_sumo.openscenario.player import Key, Player
from safevar_sumo.openscenario.ways import Way

REACTIONS = (
    "CollisionCondition",
    "StandStillCondition",
    "AccelerationCondition",
    "SpeedCondition",
    "RelativeSpeedCondition",
)
"""Conditions whose value, if they watch Ego, only a run can tell."""
LEFT_TO_RUNS = frozenset((*REACTIONS, "EndOfRoadCondition", "OffroadCondition"))
"""The same, and conditions that never hold for an Ego that drives straight on."""


def satisfies_rule(condition: Element, values: Array) -> Array:
    """Where values satisfy the condition's rule."""
    return RULES[attribute(condition, "rule")](values, number(condition, "value"))


def holds(player: Player, trigger: Element | None, window: slice) -> Array:
    """At which samples of a window a trigger (class Trigger) holds: always without conditions."""
    groups = [] if trigger is None else trigger.findall("ConditionGroup")
    found = np.full(window.stop - window.start, not groups)
    for group in groups:
        conditions = [_condition(player, each, window) for each in group.findall("Condition")]
        found = found | np.logical_and.reduce(conditions)
    return found


def _condition(player: Player, condition: Element, window: slice) -> Array:
    """Class Condition: with its edge, after its delay; it is unknown before it is asked for the
    first time.
    """
    # The player's document keeps its elements, so that no two have the same id.
    if id(condition) not in player.seen:
        player.seen[id(condition)] = window.start, np.zeros(len(player.times) + 1, bool)
    first, seen = player.seen[id(condition)]
    seen[window] = _value(player, condition, window)
    # Samples before the first one wrap around to other values, which the masks leave out.
    delay = round(min(number(condition, "delay", 0.0) / STEP, len(player.times)))
    samples = np.arange(window.start, window.stop) - delay
    now = (samples >= first) & seen[samples]
    has_before = samples > first
    before = seen[samples - 1]
    rises = now & has_before & ~before
    falls = ~now & has_before & before
    edges = {"none": now, "rising": rises, "falling": falls, "risingOrFalling": rises | falls}
    return edges[condition.get("conditionEdge", "none")]


def _value(player: Player, condition: Element, window: slice) -> Array:
    kind = part(condition, "*")
    inner = part(kind, "EntityCondition/*" if kind.tag == "ByEntityCondition" else "*")
    if kind.tag == "ByValueCondition" and inner.tag in BY_VALUE:
        return BY_VALUE[inner.tag](player, inner, window)
    if kind.tag != "ByEntityCondition" or inner.tag not in BY_ENTITY:
        raise unsupported(f"{inner.tag} is not supported", one_of([*BY_VALUE, *BY_ENTITY]))
    if inner.get("direction", "longitudinal") != "longitudinal":
        raise unsupported(
            f"{inner.tag} with direction = {inner.get('direction')} is not supported",
            "direction = longitudinal",
        )
    triggering = part(kind, "TriggeringEntities")
    actors = [player.other(each) for each in triggering.findall("EntityRef")]
    values = [
        BY_ENTITY[inner.tag](player, inner, actor, window) & (actor.deleted > player.now)
        for actor in actors
    ]
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
    return satisfies_rule(condition, player.times[window])


def storyboard_element_state_condition(player: Player, condition: Element, window: slice) -> Array:
    """StoryboardElementStateCondition: transitions hold at the moment at which they happen."""
    kind = attribute(condition, "storyboardElementType").lower()
    name = attribute(condition, "storyboardElementRef")
    times = player.times[window]
    began = _first_time(player.begun, kind, name)
    ended = _first_time(player.ended, kind, name)
    has_begun = times >= began - 1e-9
    has_ended = times >= ended - 1e-9
    ends = np.abs(times - ended) < 1e-9
    return {
        "standbyState": ~has_begun,
        "startTransition": np.abs(times - began) < 1e-9,
        "runningState": has_begun & ~has_ended,
        "endTransition": ends,
        "stopTransition": ends,
        "completeState": has_ended,
        "skipTransition": np.zeros_like(ends),
    }[attribute(condition, "state")]


def _first_time(times: Mapping[Key, float], kind: str, name: str) -> float:
    """When the first element of a kind had a name, or a path that ends with it [s]."""
    return min(
        (
            time
            for (of_kind, path), time in times.items()
            if of_kind == kind and f"::{path}".endswith(f"::{name}")
        ),
        default=np.inf,
    )


def parameter_condition(player: Player, condition: Element, window: slice) -> Array:
    """ParameterCondition, VariableCondition: both change by actions alone, so not in a window."""
    is_variable = condition.tag == "VariableCondition"
    values = player.variables if is_variable else player.document.values
    name = attribute(condition, "variableRef" if is_variable else "parameterRef").lstrip("$")
    if name not in values:
        raise unsupported(f"the file declares no parameter {name}", one_of(values))
    is_satisfied = compare(
        attribute(condition, "rule"), values[name], attribute(condition, "value")
    )
    return np.full(window.stop - window.start, is_satisfied)


# By entity


def relative_distance_condition(
    player: Player, condition: Element, actor: Actor, window: slice
) -> Array:
    """RelativeDistanceCondition [m]."""
    return satisfies_rule(condition, distance(condition, actor, player.other(condition), window))


def time_headway_condition(
    player: Player, condition: Element, actor: Actor, window: slice
) -> Array:
    """TimeHeadwayCondition: the distance over the triggering entity's speed [s]."""
    gap = distance(condition, actor, player.other(condition), window)
    return satisfies_rule(condition, _time(gap, actor.speed[window]))


def time_to_collision_condition(
    player: Player, condition: Element, actor: Actor, window: slice
) -> Array:
    """TimeToCollisionCondition: the distance over the speed at which it shrinks [s]."""
    target = condition.find("TimeToCollisionConditionTarget/EntityRef")
    if target is None:
        raise unsupported(
            "TimeToCollisionCondition with a position is not supported",
            "an EntityRef as its target",
        )
    other = player.other(target)
    closing = actor.speed[window] - _along(actor, other, window)
    return satisfies_rule(condition, _time(distance(condition, actor, other, window), closing))


def _time(gap: Array, speed: Array) -> Array:
    """The time for a distance at a speed, infinite if the speed is not above 0 [s]."""
    return np.where(speed > 0, gap / np.maximum(speed, 1e-9), np.inf)


def traveled_distance_condition(
    player: Player, condition: Element, actor: Actor, window: slice
) -> Array:
    """TraveledDistanceCondition [m]."""
    return actor.travelled[window] >= number(condition, "value") - 1e-9


def reach_position_condition(
    player: Player, condition: Element, actor: Actor, window: slice
) -> Array:
    """ReachPositionCondition: within the tolerance of a position [m]."""
    goal = player.place(part(condition, "Position/*")).pose.place
    return np.abs(actor.place[window] - goal) <= number(condition, "tolerance")


def distance_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """DistanceCondition: from a position [m]; the bodies' ends do not count."""
    if truth(condition, "freespace"):
        raise unsupported(
            "DistanceCondition with freespace = true is not supported", "freespace = false"
        )
    gap = (
        player.place(part(condition, "Position/*")).pose.place - actor.place[window]
    ) / actor.facing[window]
    return satisfies_rule(condition, _component(condition.get("relativeDistanceType", ""), gap))


def speed_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """SpeedCondition [m/s]."""
    return satisfies_rule(condition, actor.speed[window])


def relative_speed_condition(
    player: Player, condition: Element, actor: Actor, window: slice
) -> Array:
    """RelativeSpeedCondition [m/s]."""
    return satisfies_rule(
        condition, actor.speed[window] - _along(actor, player.other(condition), window)
    )


def stand_still_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """StandStillCondition [s]."""
    return actor.standing[window] >= number(condition, "duration") - 1e-9


def acceleration_condition(
    player: Player, condition: Element, actor: Actor, window: slice
) -> Array:
    """AccelerationCondition [m/s^2]: in the last step."""
    before = np.arange(window.start, window.stop) - 1
    change = actor.speed[window] - actor.speed[np.maximum(before, 0)]
    return satisfies_rule(condition, change / STEP)


def never(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """CollisionCondition: no collision of others counts, and an Ego that holds its speed has none.
    EndOfRoadCondition: a scene ends where somebody is at the end of its road.
    """
    return np.zeros(window.stop - window.start, bool)


def offroad_condition(player: Player, condition: Element, actor: Actor, window: slice) -> Array:
    """OffroadCondition: Ego drives straight on in its lane."""
    if actor is not player.ego:
        raise unsupported(
            f"OffroadCondition of {actor.name} is not supported", "one of the vehicle under test"
        )
    return never(player, condition, actor, window)


def _along(actor: Actor, other: Actor, window: slice) -> Array:
    """Speed of another actor in an actor's direction [m/s]."""
    return other.speed[window] * (other.facing[window] / actor.facing[window]).real


def distance(condition: Element, actor: Actor, other: Actor, window: slice) -> Array:
    """The distance that a condition measures [m]: of origins, or with `freespace` of bodies."""
    is_free = truth(condition, "freespace")
    kind = condition.get("relativeDistanceType", "longitudinal")
    if is_free and kind not in ("longitudinal", "lateral"):
        raise unsupported(
            f"{condition.tag} with {kind} and freespace = true is not supported",
            "longitudinal or lateral, or freespace = false",
        )
    if _is_along_road(condition, kind, actor):
        return _along_road(condition, actor, other, window, is_free)
    apart, reach = bodies_apart(actor, other, window)
    if is_free:
        return np.maximum(_component(kind, apart) - _component(kind, reach), 0.0)
    return _component(kind, (other.place[window] - actor.place[window]) / actor.facing[window])


def _component(kind: str, apart: Array) -> Array:
    """The size of what is ahead or aside of a distance, ahead + i left, or of all of it [m]."""
    if kind == "longitudinal":
        return np.abs(apart.real)
    return np.abs(apart.imag if kind == "lateral" else apart)


def bodies_apart(actor: Actor, other: Actor, window: slice) -> tuple[Array, Array]:
    """The place of another actor's middle relative to an actor's own, ahead + i left; and the sizes
    of both parts up to which the bodies overlap in them [m].
    """
    facing = actor.facing[window]
    turn = other.facing[window] / facing
    apart: Array = (other.place[window] - actor.place[window]) / facing
    apart = (
        apart
        + turn * complex(other.shape.ahead, other.shape.left)
        - complex(actor.shape.ahead, actor.shape.left)
    )
    size, own = (complex(one.shape.length, one.shape.width) for one in (other, actor))
    # A body that is turned reaches as far ahead as the box around it.
    across = complex(size.imag, size.real)
    return apart, (np.abs(turn.real) * size + np.abs(turn.imag) * across + own) / 2


def _is_along_road(condition: Element, kind: str, actor: Actor) -> bool:
    """Whether a distance is one along a road that bends."""
    system = condition.get("coordinateSystem", "entity")
    path = actor.here.path
    return (
        kind == "longitudinal"
        and system in ("road", "lane")
        and isinstance(path, Way)
        and not path.is_straight
    )


def _along_road(
    condition: Element, actor: Actor, other: Actor, window: slice, is_free: bool
) -> Array:
    own = actor.here.path
    its = other.here.path
    if not (isinstance(own, Way) and isinstance(its, Way) and own.chain == its.chain):
        raise unsupported(
            f"{condition.tag} along a road, of entities on different roads",
            "entities on the same roads, or coordinateSystem = entity",
        )
    gap = other.distance[window] - actor.distance[window]
    if not is_free:
        return np.abs(gap)
    middles = np.abs(gap + other.shape.ahead - actor.shape.ahead)
    return np.maximum(middles - (other.shape.length + actor.shape.length) / 2, 0.0)


BY_VALUE: dict[str, Callable[[Player, Element, slice], Array]] = {
    "SimulationTimeCondition": simulation_time_condition,
    "StoryboardElementStateCondition": storyboard_element_state_condition,
    "ParameterCondition": parameter_condition,
    "VariableCondition": parameter_condition,
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
    "CollisionCondition": never,
    "EndOfRoadCondition": never,
    "OffroadCondition": offroad_condition,
}
"""Conditions that are supported, by the standard's names."""
