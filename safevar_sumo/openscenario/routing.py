"""Actions that place an actor, or say along which way it moves: positions, routes, trajectories."""

from __future__ import annotations

import numpy as np

from safevar_sumo.openscenario.actors import Actor, Array, Motion, Running
from safevar_sumo.openscenario.document import Element, number, part, unsupported
from safevar_sumo.openscenario.places import Place, line_of, located, way_of, way_through
from safevar_sumo.openscenario.player import Player
from safevar_sumo.openscenario.ways import Way


def teleport_action(player: Player, action: Element, actor: Actor) -> list[Running]:
    """TeleportAction."""
    if player.sample:
        raise unsupported(
            f"TeleportAction of {actor.name} after the start: no body jumps",
            "a TeleportAction in Init",
        )
    actor.at = player.place(part(action, "Position/*"))
    return []


def assign_route_action(player: Player, action: Element, actor: Actor) -> list[Running]:
    """AssignRouteAction: the actor goes on along the roads of a route, beginning with its own."""
    return _go_on(player, actor, way_of(part(action, "Route"), player.network))


def acquire_position_action(player: Player, action: Element, actor: Actor) -> list[Running]:
    """AcquirePositionAction: the actor goes on along the shortest way to a position on a road."""
    goal = located(player.place(part(action, "Position/*")), player.network)
    places = [player.place_of(actor.name), goal]
    return _go_on(player, actor, way_through(places, player.network))


def _go_on(player: Player, actor: Actor, way: Way) -> list[Running]:
    """Go on along a way."""
    here = player.place_of(actor.name)
    if not isinstance(here.path, Way):
        player.ignored.add(f"a route of {actor.name}, which is not on a straight road")
    elif here.path.chain != way.chain:
        there = here.path.road_at(here.distance, here.left)
        distance = way.distance_to(there.road.id, there.s)
        if distance is None:
            raise unsupported(
                f"{actor.name} is not on its route", "a route that begins with its road"
            )
        actor.at = here._replace(path=way, distance=distance)
    return []


def follow_trajectory_action(player: Player, action: Element, actor: Actor) -> list[Running]:
    """FollowTrajectoryAction: at the actor's speed, or at the times of the vertices, even speeds in
    between. It ends at the end of the trajectory.
    """
    start = None if actor.at is None else actor.at.pose
    line = line_of(trajectory_of(action), player.network, player.place_of, start)
    offset = number(action, "initialDistanceOffset", 0.0)
    actor.at = Place(line, offset, 0.0)
    travelled = float(actor.travelled[player.sample])
    sideways = actor.begin(
        "sideways", line.length - offset, travelled, np.zeros_like, over_distance=True
    )
    timing = action.find("TimeReference/Timing")
    if timing is None:
        return [sideways]
    if not line.times:
        raise unsupported(
            "FollowTrajectoryAction with Timing: the trajectory has no times",
            "time at each Vertex, startTime and stopTime of a Clothoid",
        )
    is_relative = timing.get("domainAbsoluteRelative") == "relative"
    begin = (player.now if is_relative else 0.0) + number(timing, "offset", 0.0)
    times = np.asarray(line.times) * number(timing, "scale", 1.0) + begin
    if (np.diff(times) <= 0).any():
        raise unsupported(
            "FollowTrajectoryAction with Timing: the times of the vertices do not grow",
            "a larger time at each vertex",
        )
    now = player.now
    stations = np.asarray(line.stations)
    speeds = np.diff(stations) / np.diff(times)
    # Who changes its speed evenly has the mean of two neighbours at the vertex in between.
    at_vertices = np.array(
        [speeds[0] if times[0] <= now else 0.0, *(speeds[1:] + speeds[:-1]) / 2, speeds[-1]]
    )
    actor.speed_now = float(np.interp(now, times, at_vertices))
    running = actor.begin(
        "along", float(times[-1]) - now, now, lambda time: np.interp(time + now, times, at_vertices)
    )

    def station(time: Array) -> Array:
        beyond = np.maximum(time + now - times[-1], 0.0)
        return np.interp(time + now, times, stations) + beyond * speeds[-1]

    actor.stations = Motion(now, station)
    return [running]


def trajectory_of(action: Element) -> Element:
    """The trajectory of a FollowTrajectoryAction; in version 1.0 it had no TrajectoryRef around
    it.
    """
    found = action.find("TrajectoryRef/Trajectory")
    return part(action, "Trajectory") if found is None else found
