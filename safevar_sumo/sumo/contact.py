"""The side of the vehicle under test that touches another body, and the point on that side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from safevar_sumo.records import BoolArray, Contact, FloatArray
from safevar_sumo.scenarios import Scene
from safevar_sumo.sumo.world import Body

FRONT, LEFT, RIGHT, REAR = "front", "left", "right", "rear"


class Touch(NamedTuple):
    """First touches of M vehicles: side, time since then [s], and how far the other body's middle was behind the
    vehicle's front [m].
    """

    side: npt.NDArray[np.str_]
    age: FloatArray
    distance_behind_front: FloatArray


class Contacts:
    """First contacts of N vehicles; in a Euro NCAP test (`is_tested`) only contacts of the vehicle's front are
    collisions.
    """

    def __init__(self, n: int, is_tested: BoolArray) -> None:
        self._is_tested, self._side, self._position_on_side = is_tested, np.full(n, "", dtype="U5"), np.full(n, np.nan)

    def record_collisions(self, world: Any, is_open: BoolArray, scene: Scene) -> dict[int, float]:
        """Process one sample; returns the speeds [m/s] of the vehicles of open runs that collide, by vehicle number."""
        speeds = world.collisions(is_open)
        new_copies = [copy for copy in speeds if not self._side[copy]]
        if new_copies:
            own, other = world.bodies(new_copies)
            self._locate(new_copies, own, other, scene)
        return {copy: speed for copy, speed in speeds.items() if not self._is_tested[copy] or self._side[copy] == FRONT}

    def _locate(self, copies: Sequence[int], own: Body, other: Body, scene: Scene) -> None:
        touch = find_touches(own, other)
        self._side[copies] = touch.side
        lateral = scene.lateral[copies] - np.broadcast_to(scene.lateral_speed, scene.lateral.shape)[copies] * touch.age
        share = np.where(
            np.isin(touch.side, (FRONT, REAR)), lateral / own.width + 0.5, touch.distance_behind_front / own.length
        )
        self._position_on_side[copies] = 100 * np.minimum(np.maximum(share, 0.0), 1.0)

    def first_contacts(self) -> Contact:
        return Contact(self._side, self._position_on_side)


def find_touches(own: Body, other: Body) -> Touch:
    """The first touches of M pairs of overlapping bodies, if their velocities were constant.

    Two bodies of length l, l' and width w, w' at an angle a have the joint half extent r = (l + l' |cos a| + w' |sin
    a|) / 2 along the first one and (w + l' |sin a| + w' |cos a|) / 2 across it. If their middles are x apart in such a
    direction and approach each other at v, the overlap in it began (r - |x|) / v ago. The bodies touched in the
    direction in which the overlap began last, or, if they approach each other in neither direction, in the one with the
    smaller overlap.
    """
    across = np.stack([-own.along[:, 1], own.along[:, 0]], axis=1)
    to_other = other.middle - own.middle
    relative_velocity = own.along * own.speed[:, np.newaxis] - other.along * other.speed[:, np.newaxis]
    cosine, sine = np.abs(_dot(other.along, own.along)), np.abs(_dot(other.along, across))
    extent_along = (own.length + other.length * cosine + other.width * sine) / 2
    extent_across = (own.width + other.length * sine + other.width * cosine) / 2
    x_ahead, x_left = _dot(to_other, own.along), _dot(to_other, across)
    speed_ahead = _dot(relative_velocity, own.along)
    age_along = _overlap_age(extent_along - np.abs(x_ahead), np.copysign(1.0, x_ahead) * speed_ahead)
    age_across = _overlap_age(
        extent_across - np.abs(x_left), np.copysign(1.0, x_left) * _dot(relative_velocity, across)
    )
    is_approaching = np.isfinite(np.minimum(age_along, age_across))
    is_lengthwise = np.where(
        is_approaching, age_along < age_across, extent_along - np.abs(x_ahead) < extent_across - np.abs(x_left)
    )
    age = np.where(is_approaching, np.where(is_lengthwise, age_along, age_across), 0.0)
    side = np.where(is_lengthwise, np.where(x_ahead > 0, FRONT, REAR), np.where(x_left > 0, LEFT, RIGHT))
    return Touch(side, age, own.length / 2 - (x_ahead + age * speed_ahead))


def _dot(first: FloatArray, second: FloatArray) -> FloatArray:
    return first[:, 0] * second[:, 0] + first[:, 1] * second[:, 1]


def _overlap_age(overlap: FloatArray, closing_speed: FloatArray) -> FloatArray:
    """Time since bodies began to overlap in one direction, at a closing speed [s]; infinite if they do not approach
    each other.
    """
    return np.where(
        closing_speed > 0, np.maximum(overlap, 0.0) / np.where(closing_speed > 0, closing_speed, 1.0), np.inf
    )
