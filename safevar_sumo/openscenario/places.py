"""Positions, routes and trajectories: each is a distance along a line in the plane, and an offset
to its left.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

from safevar_sumo.errors import one_of
from safevar_sumo.openscenario.document import (
    Element,
    attribute,
    number,
    part,
    truth,
    unsupported,
    whole,
)
from safevar_sumo.openscenario.lines import Line, Piece, Pose, unit
from safevar_sumo.openscenario.road import Network, Road
from safevar_sumo.openscenario.ways import AHEAD, MAX_DETOUR, Crossing, Way

LEAST_WAY = 1e-9
"""Distance between two vertices from which on they are two [m]."""


class Place(NamedTuple):
    """A distance along a line and an offset to its left [m]; `turn` is the direction of a body
    relative to it.
    """

    path: Line
    distance: float
    left: float
    turn: complex = 1.0

    @property
    def pose(self) -> Pose:
        """The place in the plane."""
        return self.path.pose(self.distance, self.left).turned(self.turn)

    @classmethod
    def free(cls, pose: Pose) -> Place:
        """A place that is on no road."""
        return cls(Line([Piece(pose, 1.0)]), 0.0, 0.0)

    def way_to(self, goal: Place) -> float:
        """The distance that an actor drives along its path to a position [m]."""
        path = self.path
        if isinstance(path, Way) and isinstance(goal.path, Way):
            there = goal.path.road_at(goal.distance)
            distance = path.distance_to(there.road.id, there.s)
            if distance is not None:
                return distance - self.distance
        elif path == goal.path:
            return goal.distance - self.distance
        if not path.is_straight:
            raise unsupported(
                "a position that is not on its actor's path, which bends",
                "a position on the road of its actor",
            )
        here = path.pose(self.distance)
        return float(((goal.pose.place - here.place) * here.facing.conjugate()).real)


def located(place: Place, network: Network) -> Place:
    """A place in the plane on the straight road on which it lies; as it is if there is none."""
    if isinstance(place.path, Way):
        return place
    pose = place.pose
    for road in network.roads.values():
        if road.flaw or not road.line.is_straight:
            continue
        first = road.line.pose(0.0)
        at = (pose.place - first.place) / first.facing
        s = float(at.real)
        if 0 <= s <= road.length and road.has_lane(s, float(at.imag)):
            turn = pose.facing / first.facing
            is_forward = turn.real >= AHEAD
            way = Way.onward(network, road.id, is_forward)
            sign = 1 if is_forward else -1
            return Place(
                way, s if is_forward else road.length - s, sign * float(at.imag), sign * turn
            )
    return place


Entity = Callable[[str], Place]
"""The place of an entity by its name."""


def oriented(orientation: Element | None, base: complex) -> complex:
    """The direction of an Orientation: absolute, or relative to `base`; without one it is
    `base`.
    """
    if orientation is None:
        return base
    turn = unit(number(orientation, "h", 0.0))
    return base * turn if orientation.get("type") == "relative" else turn


def on_road(
    road: Road, network: Network, s: float, t: float, facing: Element | None, *, against: bool
) -> Place:
    """A place on a road, which faces along the reference line, `against` it, or as an orientation
    says.

    A relative orientation counts from the direction without one: in a lane from its driving
    direction.
    """
    if not -1e-9 <= s <= road.length + 1e-9:
        raise unsupported(
            f"s = {s:.1f} m is not on road {road.id}, which is {road.length:.0f} m long",
            f"s from 0 to {road.length:.0f} m",
        )
    along = road.line.pose(s).facing
    turn = oriented(facing, -along if against else along) / along
    is_forward = turn.real >= AHEAD
    way = Way.onward(network, road.id, is_forward)
    return Place(way, s, t, turn) if is_forward else Place(way, road.length - s, -t, -turn)


def place_of(position: Element, network: Network, entity: Entity) -> Place:
    """The place that the child of a Position names (class Position); `entity` returns that of an
    entity.
    """
    if position.tag not in POSITIONS:
        raise unsupported(f"{position.tag} is not supported", one_of(POSITIONS))
    return POSITIONS[position.tag](position, network, entity)


def world_position(position: Element, network: Network, entity: Entity) -> Place:
    """Class WorldPosition."""
    return Place.free(
        Pose.at(number(position, "x"), number(position, "y"), number(position, "h", 0.0))
    )


def lane_position(position: Element, network: Network, entity: Entity) -> Place:
    """Class LanePosition: the offset counts along t, of lanes to the left of the reference line,
    too.
    """
    road = network.road(attribute(position, "roadId"))
    return _in_lane(position, road, network, whole(position, "laneId"), number(position, "s"))


def _in_lane(position: Element, road: Road, network: Network, lane: int, s: float) -> Place:
    t = road.lane_t(lane, s) + number(position, "offset", 0.0)
    against = (lane > 0) != road.is_left_hand
    return on_road(road, network, s, t, position.find("Orientation"), against=against)


def road_position(position: Element, network: Network, entity: Entity) -> Place:
    """Class RoadPosition."""
    road = network.road(attribute(position, "roadId"))
    s = number(position, "s")
    t = number(position, "t")
    return on_road(road, network, s, t, position.find("Orientation"), against=False)


def of_reference(target: Element, entity: Entity) -> Crossing:
    """Where the entity that a position or a target refers to is on its road."""
    place = entity(attribute(target, "entityRef"))
    if not isinstance(place.path, Way):
        raise unsupported(
            f"{target.tag} refers to an entity that is not on a road",
            "an entity whose position is on a road",
        )
    return place.path.road_at(place.distance, place.left)


def relative_road_position(position: Element, network: Network, entity: Entity) -> Place:
    """Class RelativeRoadPosition."""
    here = of_reference(position, entity)
    s = here.s + number(position, "ds")
    t = here.t + number(position, "dt")
    return on_road(here.road, network, s, t, position.find("Orientation"), against=False)


def relative_lane_position(position: Element, network: Network, entity: Entity) -> Place:
    """Class RelativeLanePosition: dLane grows with t, and no lane has the number 0."""
    here = of_reference(position, entity)
    s = here.s + number(position, "ds", 0.0) + number(position, "dsLane", 0.0)
    lane = neighbour(here.road.lane_at(here.s, here.t), whole(position, "dLane"))
    return _in_lane(position, here.road, network, lane, s)


def relative_world_position(position: Element, network: Network, entity: Entity) -> Place:
    """Class RelativeWorldPosition: along the axes of the world."""
    return _beside(position, entity, 1)


def relative_object_position(position: Element, network: Network, entity: Entity) -> Place:
    """Class RelativeObjectPosition: along the axes of the entity."""
    return _beside(position, entity, entity(attribute(position, "entityRef")).pose.facing)


def _beside(position: Element, entity: Entity, axis: complex) -> Place:
    """A place relative to an entity, with the direction of the first axis."""
    pose = entity(attribute(position, "entityRef")).pose
    place = pose.place + complex(number(position, "dx"), number(position, "dy")) * axis
    return Place.free(Pose(place, oriented(position.find("Orientation"), pose.facing)))


def trajectory_position(position: Element, network: Network, entity: Entity) -> Place:
    """Class TrajectoryPosition."""
    line = line_of(part(position, "TrajectoryRef/Trajectory"), network, entity)
    return _turned(
        Place(line, number(position, "s"), number(position, "t", 0.0)), position.find("Orientation")
    )


def route_position(position: Element, network: Network, entity: Entity) -> Place:
    """Class RoutePosition: s along the route, and t or the lane of the road there."""
    way = way_of(part(position, "RouteRef/Route"), network)
    where = part(position, "InRoutePosition/*")
    distance = number(where, "pathS")
    sign = 1 if way.road_at(distance).is_forward else -1
    match where.tag:
        case "FromRoadCoordinates":
            left = sign * number(where, "t")
        case "FromLaneCoordinates":
            left = way.lane_left(whole(where, "laneId"), distance) + sign * number(
                where, "laneOffset", 0.0
            )
        case _:
            raise unsupported(
                f"{where.tag} is not supported", "FromRoadCoordinates or FromLaneCoordinates"
            )
    return _turned(Place(way, distance, left), position.find("Orientation"))


def _turned(place: Place, orientation: Element | None) -> Place:
    """A place on a line with an orientation, to which a relative one counts from the line."""
    if orientation is None:
        return place
    along = place.pose.facing
    return place._replace(turn=oriented(orientation, along) / along)


POSITIONS: dict[str, Callable[[Element, Network, Entity], Place]] = {
    "WorldPosition": world_position,
    "LanePosition": lane_position,
    "RoadPosition": road_position,
    "RelativeRoadPosition": relative_road_position,
    "RelativeLanePosition": relative_lane_position,
    "RelativeWorldPosition": relative_world_position,
    "RelativeObjectPosition": relative_object_position,
    "TrajectoryPosition": trajectory_position,
    "RoutePosition": route_position,
}
"""Positions that are supported, by the standard's names."""


def neighbour(lane: int, by: int) -> int:
    """The lane that is `by` lanes to the left, where t grows; there is no lane 0."""
    found = lane + by
    return found + (1 if by > 0 else -1) if lane * found <= 0 else found


def _nobody(name: str) -> Place:
    raise unsupported(f"a route refers to the entity {name}", "waypoints on roads")


def way_of(route: Element, network: Network) -> Way:
    """The roads of a route (class Route): the shortest chain from waypoint to waypoint."""
    return way_through(
        [
            located(place_of(part(point, "Position/*"), network, _nobody), network)
            for point in route.findall("Waypoint")
        ],
        network,
    )


def way_through(places: Sequence[Place], network: Network) -> Way:
    """The roads of the shortest chain from place to place."""
    ways = tuple(place.path.chain[0] for place in places if isinstance(place.path, Way))
    if len(ways) < len(places) or not ways:
        raise unsupported(
            "a route has a waypoint that is not on a road", "LanePosition or RoadPosition"
        )
    options = [ways[:1]]
    if len(ways) > 1:  # in which direction the first road is driven
        name = ways[0][0]
        options = [((name, True),), ((name, False),)]
        if ways[1][0] == name:
            first, second = (_s_of(place) for place in places[:2])
            options = [((name, second >= first),)]
    for end, _ in ways[1:]:
        options = [_extended(network, options, end)]
    return Way.of(network, tuple(options[0]))


def _s_of(place: Place) -> float:
    assert isinstance(place.path, Way)
    return place.path.road_at(place.distance).s


Chain = tuple[tuple[str, bool], ...]


def _extended(network: Network, options: Sequence[Chain], end: str) -> Chain:
    """The first of some chains of roads that leads to the road with the id `end`, extended by the
    fewest roads.
    """
    queue = [*options]
    most = len(options[0]) + MAX_DETOUR
    while queue:
        option = queue.pop(0)
        if option[-1][0] == end:
            return option
        if len(option) <= most:
            queue += [(*option, way) for way in network.ways(*option[-1])]
    raise unsupported(
        f"no route leads from road {options[0][-1][0]} to road {end}",
        f"at most {MAX_DETOUR} roads between two waypoints",
    )


def line_of(
    trajectory: Element, network: Network, entity: Entity, start: Pose | None = None
) -> Line:
    """The line of a Trajectory (class Shape); `start` is where its actor is."""
    if truth(trajectory, "closed"):
        raise unsupported("a closed Trajectory is not supported", "closed = false")
    shape = part(trajectory, "Shape/*")
    match shape.tag:
        case "Polyline":
            return _polyline(shape, network, entity)
        case "ClothoidSpline":
            return Line(_clothoids(shape, network, entity, start))
        case "Clothoid":
            pose = place_of(part(shape, "Position/*"), network, entity).pose
            length = number(shape, "length")
            first = number(shape, "curvature")
            slope = number(shape, "curvaturePrime", number(shape, "curvatureDot", 0.0))
            piece = Piece(pose, length, first, first + slope * length)
            times = [number(shape, key) for key in ("startTime", "stopTime") if key in shape.attrib]
            return Line([piece], (0.0, length), times if len(times) == 2 else ())
    raise unsupported(
        f"the trajectory's {shape.tag} is not supported; supported: Polyline, Clothoid,"
        " ClothoidSpline",
        "Polyline, Clothoid or ClothoidSpline",
    )


def _polyline(shape: Element, network: Network, entity: Entity) -> Line:
    """Class Polyline: straight from vertex to vertex; who stands at one place has several there."""
    part(shape, "Vertex")  # one at least
    positions = [(vertex, part(vertex, "Position/*")) for vertex in shape.findall("Vertex")]
    poses = [place_of(position, network, entity).pose for _, position in positions]
    pieces = []
    stations = [0.0]
    for (a, _), (b, _) in pairwise(poses):
        length = abs(b - a)
        stations.append(stations[-1] + (length if length > LEAST_WAY else 0.0))
        if length > LEAST_WAY:
            pieces.append(Piece(Pose(a, (b - a) / length), length))
    times = [number(vertex, "time") for vertex, _ in positions if "time" in vertex.attrib]
    has_facings = all("h" in position.attrib for _, position in positions)
    return Line(
        pieces or [Piece(poses[0], 1.0)],
        stations,
        times if len(times) == len(poses) else (),
        [pose.facing for pose in poses] if has_facings else (),
    )


def _clothoids(shape: Element, network: Network, entity: Entity, start: Pose | None) -> list[Piece]:
    """Class ClothoidSpline: one segment after another, from where its actor is unless a start is
    given.
    """
    part(shape, "ClothoidSplineSegment")  # one at least
    pieces = []
    pose = start
    for segment in shape.findall("ClothoidSplineSegment"):
        begin = segment.find("PositionStart")
        if begin is not None:
            pose = place_of(part(begin, "*"), network, entity).pose
        if pose is None:
            raise unsupported(
                "a ClothoidSpline without a start in the plane, which no actor follows",
                "PositionStart in its first segment",
            )
        curvatures = (number(segment, name) for name in ("curvatureStart", "curvatureEnd"))
        piece = Piece(pose, number(segment, "length"), *curvatures)
        pieces.append(piece)
        pose = piece.pose(piece.length)
    return pieces


def turn_of(facing: complex, other: complex) -> float:
    """The angle between two directions [degrees]."""
    return abs(math.degrees(cmath.phase(facing / other)))
