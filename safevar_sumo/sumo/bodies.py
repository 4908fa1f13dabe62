"""How vehicles under test move, as a world answers it; bodies as rectangles, and where they touch first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from safevar_sumo.records import BoolArray, Contact, FloatArray
from safevar_sumo.scenarios import Scenario, Scene
from safevar_sumo.scenarios.base import ScenarioMemory, World as ScenariosWorld
from safevar_sumo.vehicles import SumoType


class Motion(NamedTuple):
    """Where N vehicles under test are: their front bumpers, shape (N, 2) [m], their speeds, shape (N,) [m/s], and the
    speeds of those that hit somebody in this step, by vehicle number. Vehicles whose runs have ended keep their last
    values.
    """

    fronts: FloatArray
    speeds: FloatArray
    hits: Mapping[int, float]


class Body(NamedTuple):
    """A vehicle or person as a rectangle, or M of them in columns [m, m/s]; `along` is its direction, a unit vector."""

    middle: FloatArray
    along: FloatArray
    length: Any
    width: Any
    speed: Any

    @classmethod
    def behind(cls, front: FloatArray, along: FloatArray, length: Any, width: Any, speed: FloatArray | float) -> Body:
        """The body whose front's middle is at `front`, or M such bodies."""
        return cls(front - along * (np.asarray(length)[..., np.newaxis] / 2), along, length, width, speed)

    @classmethod
    def columns(cls, bodies: Sequence[Body]) -> Body:
        """M bodies in columns: `middle` and `along` of shape (M, 2), the other columns of shape (M,)."""
        return cls._make(np.array(column) for column in zip(*bodies, strict=True))


class Track(NamedTuple):
    """How an actor moves: at every sample the position of its front bumper, or of a person [m], its direction, a unit
    vector, and its speed [m/s]; shape (T, 5), or (T, N, 5) in N copies.

    Values are NaN while the actor is not on the road; `length` and `width` are in m.
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


class World(ScenariosWorld, Protocol):
    """N vehicles under test in a scene that SUMO simulates or that was recorded; scenarios see it as theirs."""

    n: int
    step_length: float

    def begin(self, scenario: Scenario) -> ScenarioMemory:
        """Start a scenario before the first step, and return its memory."""

    def enter(self, types: SumoType | None, *, keeps_drivers: bool = False) -> Motion:
        """Put the vehicles onto the road and return their first motion; called once, first.

        Without `types` any speed is possible. With `keeps_drivers` SUMO's drivers keep the decelerations that the
        traffic file gives them.
        """

    def step(self, speeds: FloatArray, is_open: BoolArray) -> Motion:
        """Simulate a step in which the vehicles whose runs are open reach `speeds` [m/s], shape (N,)."""

    def bodies(self, vehicles: Sequence[int]) -> tuple[Body, Body]:
        """The bodies of vehicles that hit somebody in this step, and of those whom they hit, both in columns."""


FRONT, LEFT, RIGHT, REAR = "front", "left", "right", "rear"


class Contacts:
    """First contacts of N vehicles, `first`.

    In a Euro NCAP test, where `is_tested`, only contacts of the vehicle's front are collisions.
    """

    def __init__(self, n: int, is_tested: BoolArray) -> None:
        self._is_tested, self.first = is_tested, Contact(np.full(n, "", dtype="U5"), np.full(n, np.nan))

    def count(self, world: World, hits: Mapping[int, float], scene: Scene) -> dict[int, float]:
        """Process the hits of one sample; returns those that are collisions: speeds [m/s] by vehicle number."""
        new_copies = [copy for copy in hits if not self.first.side[copy]]
        if new_copies:
            own, other = world.bodies(new_copies)
            self._locate(new_copies, own, other, scene)
        side = self.first.side
        return {copy: speed for copy, speed in hits.items() if not self._is_tested[copy] or side[copy] == FRONT}

    def _locate(self, copies: Sequence[int], own: Body, other: Body, scene: Scene) -> None:
        side, age, distance_behind_front = find_touches(own, other)
        lateral = scene.lateral[copies] - np.broadcast_to(scene.lateral_speed, scene.lateral.shape)[copies] * age
        is_at_end = (side == FRONT) | (side == REAR)
        share = np.where(is_at_end, lateral / own.width + 0.5, distance_behind_front / own.length)
        self.first.side[copies] = side
        self.first.place[copies] = 100 * np.minimum(np.maximum(share, 0.0), 1.0)


def find_touches(own: Body, other: Body) -> tuple[npt.NDArray[np.str_], FloatArray, FloatArray]:
    """The first touches of M overlapping pairs, a vehicle's own body and another, if their velocities were constant.

    Returns the touched side of the own body, the time since the touch [s], and how far the other body's middle was then
    behind the own front [m].

    Two bodies of length l, l' and width w, w' at an angle a have the joint half extent r = (l + l' |cos a| + w' |sin
    a|) / 2 along the own body and (w + l' |sin a| + w' |cos a|) / 2 across it. If their middles are x apart in such a
    direction and approach each other at v, the overlap in it began (r - |x|) / v ago. The bodies touched in the
    direction in which the overlap began last, or, if they approach each other in neither direction, in the one with the
    smaller overlap.
    """
    axes = np.stack([own.along, np.stack([-own.along[:, 1], own.along[:, 0]], axis=1)])
    cosine, sine = np.abs(_dot(other.along, axes))
    extent = np.stack(
        [
            (own.length + other.length * cosine + other.width * sine) / 2,
            (own.width + other.length * sine + other.width * cosine) / 2,
        ]
    )
    distance = _dot(other.middle - own.middle, axes)
    speed = _dot(own.along * own.speed[:, np.newaxis] - other.along * other.speed[:, np.newaxis], axes)
    overlap, closing_speed = extent - np.abs(distance), np.copysign(1.0, distance) * speed
    is_closing = closing_speed > 0
    ages = np.where(is_closing, np.maximum(overlap, 0.0) / np.where(is_closing, closing_speed, 1.0), np.inf)
    approaches = is_closing.any(axis=0)
    is_lengthwise = np.where(approaches, ages[0] < ages[1], overlap[0] < overlap[1])
    age = np.where(approaches, np.min(ages, axis=0), 0.0)
    ahead, left = distance > 0
    side = np.where(is_lengthwise, np.where(ahead, FRONT, REAR), np.where(left, LEFT, RIGHT))
    return side, age, own.length / 2 - (distance[0] + age * speed[0])


def _dot(vectors: FloatArray, axes: FloatArray) -> FloatArray:
    """Components of M vectors along their two axes, shape (2, M)."""
    return vectors[:, 0] * axes[..., 0] + vectors[:, 1] * axes[..., 1]
