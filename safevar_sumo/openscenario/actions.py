"""Actions: each is a function with the standard's name that begins a motion of an actor.

The names are those of the classes in the class reference of ASAM OpenSCENARIO XML 1.3.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from safevar_sumo.errors import one_of
from safevar_sumo.openscenario.actors import Actor, Following, Running
from safevar_sumo.openscenario.document import (
    IS_READ,
    Element,
    attribute,
    is_number,
    number,
    part,
    truth,
    unsupported,
    whole,
)
from safevar_sumo.openscenario.places import Place, line_of, neighbour, of_reference
from safevar_sumo.openscenario.player import Player
from safevar_sumo.openscenario.routing import (
    acquire_position_action,
    assign_route_action,
    follow_trajectory_action,
    teleport_action,
    trajectory_of,
)
from safevar_sumo.openscenario.synchronize import relative_speed, synchronize_action
from safevar_sumo.openscenario.transitions import SHAPES, Transition, transition_of
from safevar_sumo.openscenario.ways import AHEAD, Way

IGNORED = (
    "ActivateControllerAction",
    "AssignControllerAction",
    "ControllerAction",
    "AppearanceAction",
    "LightStateAction",
    "AnimationAction",
    "VisibilityAction",
    "EnvironmentAction",
    "VariableAction",
    "VariableSetAction",
    "ParameterAction",
    "InfrastructureAction",
    "SetMonitorAction",
    "TrafficSignalAction",
    "UserDefinedAction",
)
"""Actions that move nobody."""


# Longitudinal


def speed_action(player: Player, action: Element, actor: Actor) -> list[Running]:
    """SpeedAction. Over a distance the acceleration of a linear change is constant."""
    target = part(action, "SpeedActionTarget/*")
    start = actor.speed_now
    value = number(target, "value")
    if target.tag == "RelativeTargetSpeed":
        other = player.other(target)
        if truth(target, "continuous"):
            raise unsupported(
                "SpeedAction: RelativeTargetSpeed with continuous = true is not supported",
                "continuous = false",
            )
        value = relative_speed(target, other.speed_now)
        player.depends(other, player.now, f"{actor.name}'s speed relative to {other.name}'s")
    if value < 0:
        raise unsupported(
            f"{actor.name} drives backwards ({value:.2f} m/s)", "a speed of at least 0"
        )
    dynamics = part(action, "SpeedActionDynamics")
    transition = transition_of(dynamics, value - start, (start + value) / 2)
    if actor is player.ego:
        player.profile.begin(player.now, transition.duration, actor.name)
    until, follower = player.masters.get(actor.name, (0.0, ""))
    if player.now < until:
        raise unsupported(
            f"SpeedAction of {actor.name} while {follower} synchronises with it",
            "a SpeedAction before or after that",
        )
    if math.isinf(transition.duration):
        player.remark(f"{actor.name}: SpeedAction with rate 0 has no effect")
    if not transition.duration:
        actor.speed_now = value
    share = transition.share
    running = actor.begin(
        "along", transition.duration, player.now, lambda time: start + (value - start) * share(time)
    )
    return [running]


def longitudinal_distance_action(player: Player, action: Element, actor: Actor) -> list[Running]:
    """LongitudinalDistanceAction: at once at a distance, which is kept if it is continuous."""
    other = player.other(action)
    if action.find("DynamicConstraints") is not None:
        raise unsupported(
            "LongitudinalDistanceAction with DynamicConstraints is not supported",
            "one without them, which acts at once",
        )
    leads = action.get("displacement", "leadingReferencedEntity") != "trailingReferencedEntity"
    follower = other if leads else actor
    gap = number(action, "distance", math.nan)
    if math.isnan(gap):
        gap = number(action, "timeGap") * follower.speed_now
    if truth(action, "freespace"):
        gap += (
            other.shape.front - actor.shape.rear if leads else actor.shape.front - other.shape.rear
        )
    signed = gap if leads else -gap
    player.depends(other, player.now, f"{actor.name}'s distance to {other.name}")
    mine = actor.here
    its = other.here
    if (
        isinstance(mine.path, Way)
        and isinstance(its.path, Way)
        and mine.path.chain == its.path.chain
    ):
        actor.at = mine._replace(distance=its.distance + signed)
    elif isinstance(mine.path, Way) and mine.path.is_straight:
        actor.at = mine._replace(distance=mine.path.along(its.pose.place) + signed)
    else:
        actor.at = Place.free(its.pose.moved(signed))
    if not truth(action, "continuous"):
        return []
    speed = actor.speed_now
    running = actor.begin("along", math.inf, player.now, lambda time: np.full_like(time, speed))
    actor.follows = Following(other, signed)
    player.depends(other, math.inf, f"{actor.name}'s distance to {other.name}")
    return [running]


# Lateral

MAX_SKEW = 0.1
"""Sine of the angle to a road up to which a body that was placed in the plane drives along it."""


def lane_change_action(player: Player, action: Element, actor: Actor) -> list[Running]:
    """LaneChangeAction: a relative lane counts to the left of its entity, as the entity faces."""
    way = _way_of(player, action, actor)
    target = part(action, "LaneChangeTarget/*")
    lane = whole(target, "value")
    if target.tag == "RelativeTargetLane":
        here = of_reference(target, player.place_of)
        faces_along = here.is_forward == (player.other(target).here.turn.real >= AHEAD)
        lane = neighbour(here.road.lane_at(here.s, here.t), lane if faces_along else -lane)
    offset = number(action, "targetLaneOffset", 0.0)
    goal = way.lane_left(lane, actor.here.distance) + _sign(way, actor) * offset
    dynamics = part(action, "LaneChangeActionDynamics")
    transition = transition_of(dynamics, goal - actor.here.left)
    return [_sideways(player, actor, goal, transition)]


def lane_offset_action(player: Player, action: Element, actor: Actor) -> list[Running]:
    """LaneOffsetAction: as fast as maxLateralAcc allows; without one at once."""
    way = _way_of(player, action, actor)
    target = part(action, "LaneOffsetTarget/*")
    left = actor.here.left
    by = _sign(way, actor) * number(target, "value")
    goal = way.lane_left(way.lane_at(actor.here.distance, left), actor.here.distance) + by
    if target.tag == "RelativeTargetLaneOffset":
        goal = _sign(way, actor) * of_reference(target, player.place_of).t + by
    dynamics = part(action, "LaneOffsetActionDynamics")
    shape = attribute(dynamics, "dynamicsShape")
    most = number(dynamics, "maxLateralAcc", 0.0)
    if shape == "step" or not most or goal == left:
        return [_sideways(player, actor, goal, Transition(0.0, np.ones_like))]
    peaks = {"sinusoidal": math.pi**2 / 2, "cubic": 6.0, "linear": 4.0}
    duration = math.sqrt(peaks[shape] * abs(goal - left) / most)
    share = SHAPES[shape][1]
    transition = Transition(duration, lambda time: share(np.minimum(time / duration, 1.0)))
    return [_sideways(player, actor, goal, transition)]


def _way_of(player: Player, action: Element, actor: Actor) -> Way:
    place = player.place_of(actor.name)
    if not isinstance(place.path, Way) or abs(place.turn.imag) > MAX_SKEW:
        raise unsupported(
            f"{action.tag} of {actor.name}, which is not on a road",
            "an actor whose position is on a road",
        )
    actor.at = place
    return place.path


def _sign(way: Way, actor: Actor) -> int:
    """1 if the actor drives along the road's reference line, otherwise -1: offsets count along
    t.
    """
    return 1 if way.road_at(actor.here.distance).is_forward else -1


def _sideways(player: Player, actor: Actor, goal: float, transition: Transition) -> Running:
    start = actor.here.left
    duration, share, over_distance = transition
    if not duration:
        actor.at = actor.here._replace(left=goal)
    since = float(actor.travelled[player.sample]) if over_distance else player.now
    return actor.begin(
        "sideways",
        duration,
        since,
        lambda by: start + (goal - start) * share(by),
        over_distance=over_distance,
    )


PRIVATE: dict[str, Callable[[Player, Element, Actor], list[Running]]] = {
    "TeleportAction": teleport_action,
    "SpeedAction": speed_action,
    "LongitudinalDistanceAction": longitudinal_distance_action,
    "SynchronizeAction": synchronize_action,
    "LaneChangeAction": lane_change_action,
    "LaneOffsetAction": lane_offset_action,
    "AssignRouteAction": assign_route_action,
    "AcquirePositionAction": acquire_position_action,
    "FollowTrajectoryAction": follow_trajectory_action,
}
"""Actions of an actor that are supported, by the standard's names."""
GROUPS = ("LongitudinalAction", "LateralAction", "RoutingAction")
"""Classes of which one action is a child."""
PLACING = "TeleportAction", "FollowTrajectoryAction"
"""Actions of Init that say where somebody is."""
INIT_ORDER = (
    *((name,) for name in PLACING),
    ("SpeedAction",),
    ("AssignRouteAction", "AcquirePositionAction"),
)
"""The order of actions in Init, whose list has none: places, speeds, routes, then all others."""
LATER = "SpeedAction", "AssignRouteAction", "AcquirePositionAction"
"""Actions that Ego may have after the start."""


def leaf_of(action: Element) -> Element:
    """The element of a private or global action that says what is done."""
    leaf = part(action, "*")
    return part(leaf, "*") if leaf.tag in GROUPS else leaf


def is_ignored(action: Element) -> bool:
    """Whether an action has no effect."""
    return not moves_somebody(action) and action.find(f"*[@{IS_READ}]") is None


def moves_somebody(action: Element) -> bool:
    """Whether an action does more than to set values and what has no effect."""
    leaf = leaf_of(action) if action.tag in ("PrivateAction", "GlobalAction") else action
    return leaf.tag not in IGNORED


def _set_value(player: Player, action: Element) -> None:
    """ParameterAction, VariableAction: other values in conditions from now on."""
    is_variable = action.tag == "VariableAction"
    values = player.variables if is_variable else player.document.values
    name = attribute(action, "variableRef" if is_variable else "parameterRef").lstrip("$")
    change = part(action, "*")
    if change.tag == "SetAction":
        values[name] = attribute(change, "value")
        return
    rule = part(change, "Rule/*")
    if name not in values or not is_number(values[name]):
        problem = f"{action.tag}: {name} is no number that is declared"
        raise unsupported(problem, one_of(filter(lambda one: is_number(values[one]), values)))
    by, old = number(rule, "value"), float(values[name])
    values[name] = repr(old + by if rule.tag == "AddValue" else old * by)


def act(player: Player, action: Element, actors: list[Actor]) -> list[Running]:
    """Begin a PrivateAction or GlobalAction; returns what goes on in time."""
    for one in action.iter("ActivateControllerAction"):
        if player.ego in actors and one.get("longitudinal") not in ("false", "0"):
            player.profile.end(player.now)
            player.ego.hold()
    if is_ignored(action):
        player.ignored.add(leaf_of(action).tag if len(action) else action.tag)
        return []
    leaf = leaf_of(action)
    if action.tag == "GlobalAction":
        if leaf.tag == "EntityAction" and leaf.find("DeleteEntityAction") is not None:
            player.other(leaf).deleted = player.now  # class DeleteEntityAction
            return []
        if leaf.tag in ("ParameterAction", "VariableAction"):
            _set_value(player, leaf)
            return []
        raise unsupported(
            f"{part(leaf, '*').tag if len(leaf) else leaf.tag} is not supported",
            one_of(["DeleteEntityAction", *IGNORED]),
        )
    if leaf.tag not in PRIVATE:
        raise unsupported(f"{leaf.tag} is not supported", one_of([*PRIVATE, *IGNORED]))
    if player.ego in actors and player.has_begun and leaf.tag == "FollowTrajectoryAction":
        player.ignored.add(f"{leaf.tag} of {player.ego.name}")
        # It is a record of a run; the driving system drives anew.
        line = line_of(trajectory_of(leaf), player.network, player.place_of)
        player.refuse_turn(line.samples)
        return []
    if player.sample and player.ego in actors and leaf.tag not in LATER:
        raise unsupported(
            f"{leaf.tag} of {player.ego.name} after the start: its driving system drives",
            f"other actions of it in Init, and later {', '.join(LATER)} alone",
        )
    return [running for actor in actors for running in PRIVATE[leaf.tag](player, leaf, actor)]
