"""The contract of worlds, in which vehicles under test move; bodies as rectangles, and the place
of the first contact of two bodies.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple, Protocol

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import (
    TOUCH_OVERLAP,
    ZERO,
    BoolArray,
    Contact,
    FloatArray,
    IntArray,
    Quantity,
    TextArray,
    clip_to_share,
    nans,
)
from safevar_sumo.scenarios import Scene, Track, WorldScenario
from safevar_sumo.scenarios.base import ScenarioMemory
from safevar_sumo.scenarios.roads import NETWORK_KEY, Frame, World
from safevar_sumo.scenarios.tracks import CORNERS, corners_of
from safevar_sumo.vehicles import SumoType


class VehicleStates(NamedTuple):
    """The motion of N vehicles under test at one sample: the positions of their front bumpers,
    shape (N, 2) [m], their speeds, shape (N,) [m/s], and the vehicles that hit somebody in this
    step. A vehicle whose run has ended keeps its last position and speed.
    """

    fronts: FloatArray
    speeds: FloatArray
    hits: dict[int, float]


class Body(NamedTuple):
    """M vehicles or persons as rectangles, in columns [m, m/s]: `middle` and `along` have the shape
    (M, 2). `along` is the direction that a body faces, a unit vector; `speed` is the speed in this
    direction, `drift` the speed to the left of this direction. A number holds for all M bodies.
    """

    middle: FloatArray
    along: FloatArray
    length: Quantity
    width: Quantity
    speed: Quantity
    drift: Quantity = ZERO

    @classmethod
    def behind(
        cls,
        front: FloatArray,
        along: FloatArray,
        length: Quantity,
        width: Quantity,
        speed: FloatArray,
    ) -> Body:
        """M bodies, the middles of whose fronts are at `front`, shape (M, 2)."""
        middle = front - along * (np.asarray(length)[..., np.newaxis] / 2)
        return cls(middle, along, length, width, speed)

    @property
    def velocity(self) -> FloatArray:
        """Velocities of M bodies in columns, shape (M, 2) [m/s]."""
        along, across = _axes_of(self)
        drift = self.drift[..., np.newaxis]
        return np.asarray(along * self.speed[:, np.newaxis] + across * drift)


class BodyPairs(NamedTuple):
    """M pairs of bodies, in columns: the numbers of the vehicles under test, shape (M,), the bodies
    of these vehicles, and the body of the other actor in each pair (`obstacle`).
    """

    vehicles: IntArray
    body: Body
    obstacle: Body


def distance_covered(
    old_speed: FloatArray, new_speed: FloatArray, step: float
) -> FloatArray:
    """Distance [m] covered in a time step at constant acceleration. The operations are those of
    SUMO's `MSVehicle::getDeltaPos`, so that the result has the same bits.
    """
    acceleration = (new_speed - old_speed) / step
    return (old_speed + 0.5 * (acceleration * step)) * step


class Film(NamedTuple):
    """The motion of an actor at T samples, shape (T, 5), or (T, N, 5) in N copies of the network.

    The five values are the position x, y of a vehicle's front bumper or of a person [m], the
    direction as a unit vector x, y, and the speed [m/s]. They are NaN while the actor is not on the
    road. `length` and `width` are in m.
    """

    motion: FloatArray
    is_person: bool
    length: float
    width: float

    @property
    def x(self) -> FloatArray:
        return self.motion[..., 0]

    @property
    def y(self) -> FloatArray:
        return self.motion[..., 1]

    @property
    def heading(self) -> FloatArray:
        """Direction, counter-clockwise from east [rad]."""
        return np.arctan2(self.motion[..., 3], self.motion[..., 2])


class VehicleWorld(Protocol):
    """The contract of a world of N vehicles under test: a lane, a recorded scene or SUMO."""

    step_length: float

    @property
    def frame(self) -> Frame:
        """The coordinates along and across the lane of the vehicles under test."""

    def enter(
        self, types: SumoType | None, *, keeps_drivers: bool = False
    ) -> VehicleStates:
        """Put the vehicles onto the road and return their first motion. This method is called once,
        before all others.

        If `types` is None, vehicles may have any speed. With `keeps_drivers`, SUMO's drivers keep
        the decelerations that the traffic file states for them.
        """

    def step(self, speeds: FloatArray, is_open: BoolArray) -> VehicleStates:
        """Simulate a step, in which vehicles with `is_open` (their runs have not ended) reach
        `speeds`, shape (N,) [m/s]; return the motion after the step.
        """

    def bodies(self, vehicles: Sequence[int]) -> BodyPairs:
        """Pairs of the given vehicles, which hit somebody in this step, and the bodies they hit."""

    def vehicle_length(self, actor: str) -> float:
        """Length of a vehicle [m]."""

    @property
    def vehicle_width(self) -> float:
        """Width of the vehicles under test [m]."""


class SceneWorld(VehicleWorld, World, Protocol):
    """The contract of a world whose scene SUMO simulates or has recorded. Scenarios read and move
    the actors of this scene.
    """

    def begin(self, scenario: WorldScenario) -> ScenarioMemory:
        """Start a scenario before the first step, and return its memory."""

    def bodies_around(self, vehicles: Sequence[int]) -> BodyPairs:
        """All pairs of one of these vehicles and another actor of the vehicle's scene."""


TOUCH = 1e-3
"""Overlap up to which bodies only touch, without an impact [m], as in SUMO. An impact that is due
exactly at a sample must not depend on the last bit of a position.
"""
# Sides of a vehicle.
FRONT = "front"
LEFT = "left"
RIGHT = "right"
REAR = "rear"
COSINE_DECIMALS = 9
"""Decimals of a cosine between two directions: SUMO states directions in degrees, and converting
them makes rounding errors.
"""
COLLISION_PLACES = (
    "vehicles in the lane of the vehicle under test or on a junction, persons on a crossing or in a"
    " network without junctions: elsewhere SUMO looks for no collisions"
)


class FirstContacts:
    """The first contact of each of N vehicles: `first` has the side, the place on that side [%],
    and the struck body's speed in the vehicle's direction [m/s].

    Where `is_tested`, shape (N,), is true, only a contact of the vehicle's front is a collision, as
    in tests by Euro NCAP.
    """

    def __init__(self, n: int, is_tested: BoolArray) -> None:
        self._is_tested = is_tested
        self._was_inside = np.zeros(n, bool)
        self.first = Contact(np.full(n, "", "U5"), nans(n), np.zeros(n))

    def count(
        self, world: VehicleWorld, hits: dict[int, float], scene: Scene
    ) -> dict[int, float]:
        """Note the first contacts among the hits of one sample, and return the hits that are
        collisions.
        """
        side = self.first.side
        new_copies = [copy for copy in hits if not side[copy]]
        if new_copies:
            self._locate(world.bodies(new_copies), scene)
        return {
            copy: speed
            for copy, speed in hits.items()
            if not self._is_tested[copy] or side[copy] == FRONT
        }

    def check(
        self, world: SceneWorld, scene: Scene, is_open: BoolArray, time: float
    ) -> None:
        """Refuse a scene in which the front of a vehicle drives into a body although SUMO reports
        no collision. Vehicles whose runs have ended (not `is_open`) are not checked.

        Call this method at every sample, after `count`. A body that runs into the side of the
        vehicle is no error: SUMO reports contacts of the front alone.

        Raises
        ------
        InputError
            The error states the time [s].
        """
        # These vehicles enter a body although SUMO has reported no contact.
        is_inside = scene.gap < -TOUCH_OVERLAP
        enters = is_inside & ~self._was_inside & is_open & (self.first.side == "")
        self._was_inside = is_inside
        if not np.count_nonzero(enters):
            return

        # Only the front counts, because SUMO reports no other contacts.
        around = world.bodies_around(np.flatnonzero(enters).tolist())
        depth = find_overlaps(around.body, around.obstacle)
        touches = find_touches(around.body, around.obstacle)
        is_missed = (depth > TOUCH_OVERLAP) & (touches.side == FRONT)
        if is_missed.any():
            inside = (
                f"the front of the vehicle under test is {depth[is_missed].max():.2f} m inside a"
                " body"
            )
            raise InputError(
                NETWORK_KEY,
                f"at {time:g} s {inside}, and SUMO reports no collision",
                COLLISION_PLACES,
            )

    def _locate(self, pairs: BodyPairs, scene: Scene) -> None:
        """Note side, place and speed of the first contact of each pair."""
        copies, body, obstacle = pairs
        touches = find_touches(body, obstacle)
        lateral_speeds = np.broadcast_to(scene.lateral_speed, scene.lateral.shape)
        lateral = scene.lateral[copies] - lateral_speeds[copies] * touches.age
        is_at_end = (touches.side == FRONT) | (touches.side == REAR)
        share_across = lateral / body.width + 0.5
        share_along = touches.behind_front / body.length
        share = np.where(is_at_end, share_across, share_along)
        cosine = (body.along * obstacle.along).sum(axis=1)
        self.first.side[copies] = touches.side
        self.first.speed[copies] = obstacle.speed * np.round(cosine, COSINE_DECIMALS)
        self.first.place[copies] = 100 * clip_to_share(share)


def distance_between(
    body: Track, middle: FloatArray, length: float, width: float
) -> FloatArray:
    """Distances [m] between a body and vehicles in the middle of the lane, whose size is `length`
    and `width`, and whose middles are at `middle` along the lane.

    The distance of two rectangles is the least distance of a corner of one rectangle to the other
    rectangle; 0 if they overlap.
    """
    squares = []
    for corner_x, corner_y in corners_of(body):
        squares.append(_square_outside(corner_x - middle, corner_y, length, width))
    # In the body's axes a corner is the vehicle's middle plus an offset that all vehicles share.
    x = middle - body.x
    lengthwise = x * body.along - body.y * body.left
    across = -x * body.left - body.y * body.along
    for end, side in CORNERS:
        dx = end * length / 2
        dy = side * width / 2
        x_in_body = lengthwise + (dx * body.along + dy * body.left)
        y_in_body = across + (dy * body.along - dx * body.left)
        squares.append(_square_outside(x_in_body, y_in_body, body.length, body.width))
    cosine = np.abs(body.along)
    sine = np.abs(body.left)
    # Two rectangles that cross like an X overlap, but neither has a corner in the other: the
    # extents along all four axes decide (separating axis test).
    extent_x = length + body.length * cosine + body.width * sine
    extent_y = width + body.length * sine + body.width * cosine
    extent_along = body.length + length * cosine + width * sine
    extent_across = body.width + length * sine + width * cosine
    overlaps = (
        (np.abs(x) < extent_x / 2)
        & (np.abs(body.y) < extent_y / 2)
        & (np.abs(lengthwise) < extent_along / 2)
        & (np.abs(across) < extent_across / 2)
    )
    return np.where(overlaps, 0.0, np.sqrt(reduce(np.minimum, squares)))


def _square_outside(
    x: Quantity, y: Quantity, length: Quantity, width: Quantity
) -> Quantity:
    """Squared distances [m^2] of points to a rectangle around the origin; 0 for a point inside."""
    dx = np.maximum(np.abs(x) - length / 2, 0.0)
    dy = np.maximum(np.abs(y) - width / 2, 0.0)
    return dx * dx + dy * dy


class Touches(NamedTuple):
    """First touches of M vehicles: the side of the vehicle that was touched, the time since the
    touch (`age`) [s], and the distance of the other body's middle behind the vehicle's front at the
    touch [m].
    """

    side: TextArray
    age: FloatArray
    behind_front: FloatArray


def find_touches(body: Body, obstacle: Body) -> Touches:
    """The first touches of M overlapping pairs of a vehicle's body and an obstacle, if their
    velocities were constant until now.

    A body of length l and width w and an obstacle of length l' and width w', at an angle a, have
    the joint half extent r = (l + l' |cos a| + w' |sin a|) / 2 along the body and
    (w + l' |sin a| + w' |cos a|) / 2 across the body. If their middles are x apart in one of these
    directions and approach each other at v, they overlap in this direction since (r - |x|) / v. The
    bodies touched in the direction in which the overlap began last. If they approach each other in
    neither direction, the direction with the smaller overlap counts.
    """
    axes = _axes_of(body)
    distance = _dot(obstacle.middle - body.middle, axes)
    speed = _dot(body.velocity - obstacle.velocity, axes)
    overlap = _joint_extent(body, obstacle, axes) - np.abs(distance)
    closing_speed = np.copysign(1.0, distance) * speed
    is_closing = closing_speed > 0

    # In a direction without approach the bodies were never apart: the overlap is infinitely old.
    ages = np.full_like(overlap, np.inf)
    np.divide(np.maximum(overlap, 0.0), closing_speed, out=ages, where=is_closing)
    approaches = is_closing.any(axis=0)
    is_lengthwise = np.where(approaches, ages[0] < ages[1], overlap[0] < overlap[1])
    age = np.where(approaches, np.min(ages, axis=0), 0.0)

    is_ahead, is_left = distance > 0
    end = np.where(is_ahead, FRONT, REAR)
    flank = np.where(is_left, LEFT, RIGHT)
    side = np.where(is_lengthwise, end, flank)
    return Touches(side, age, body.length / 2 - (distance[0] + age * speed[0]))


def find_overlaps(body: Body, obstacle: Body) -> FloatArray:
    """Depths by which M pairs of bodies overlap, shape (M,) [m]: of all directions along and across
    the two bodies, the least overlap. A negative depth means that the bodies do not touch.
    """
    return np.minimum(_overlaps_along(body, obstacle), _overlaps_along(obstacle, body))


def _overlaps_along(body: Body, obstacle: Body) -> FloatArray:
    """The smaller of the overlaps along and across `body`, for M pairs, shape (M,) [m]."""
    axes = _axes_of(body)
    distance = _dot(obstacle.middle - body.middle, axes)
    overlaps = _joint_extent(body, obstacle, axes) - np.abs(distance)
    return np.asarray(overlaps.min(axis=0))


def _axes_of(body: Body) -> FloatArray:
    """The directions along and across M bodies, unit vectors, shape (2, M, 2)."""
    across = np.stack([-body.along[:, 1], body.along[:, 0]], axis=1)
    return np.stack([body.along, across])


def _joint_extent(body: Body, obstacle: Body, axes: FloatArray) -> FloatArray:
    """Sums of the half extents of body and obstacle along the two axes of `body`, for M pairs,
    shape (2, M) [m].
    """
    cosine, sine = np.abs(_dot(obstacle.along, axes))
    along = (body.length + obstacle.length * cosine + obstacle.width * sine) / 2
    across = (body.width + obstacle.length * sine + obstacle.width * cosine) / 2
    return np.stack([along, across])


def _dot(vectors: FloatArray, axes: FloatArray) -> FloatArray:
    """Components of M vectors along two axes of each vector, shape (2, M)."""
    return vectors[:, 0] * axes[..., 0] + vectors[:, 1] * axes[..., 1]
