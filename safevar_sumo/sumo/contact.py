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
    """The first touch of M pairs of bodies: the side, the time since it [s], the other's middle behind the own front [m]."""

    side: npt.NDArray[np.str_]
    ago: FloatArray
    behind_front: FloatArray


class Contacts:
    """First contacts of N vehicles; `tested` vehicles collide with the front only, as in a Euro NCAP test."""

    def __init__(self, n: int, tested: BoolArray) -> None:
        self._tested, self._side, self._place = tested, np.full(n, "", dtype="U5"), np.full(n, np.nan)

    def collisions(self, world: Any, open_: BoolArray, scene: Scene) -> dict[int, float]:
        """Process one sample; returns the vehicles of open runs that collide, and their speeds [m/s]."""
        speeds = world.collisions(open_)
        first = [copy for copy in speeds if not self._side[copy]]
        if first:
            own, other = world.bodies(first)
            self._note(first, own, other, scene)
        return {copy: speed for copy, speed in speeds.items() if not self._tested[copy] or self._side[copy] == FRONT}

    def _note(self, copies: Sequence[int], own: Body, other: Body, scene: Scene) -> None:
        touch = touches(own, other)
        self._side[copies] = touch.side
        lateral = scene.lateral[copies] - np.broadcast_to(scene.lateral_speed, scene.lateral.shape)[copies] * touch.ago
        share = np.where(np.isin(touch.side, (FRONT, REAR)), lateral / own.width + 0.5, touch.behind_front / own.length)
        self._place[copies] = 100 * np.minimum(np.maximum(share, 0.0), 1.0)

    def contact(self) -> Contact:
        """The first contact of every vehicle."""
        return Contact(self._side, self._place)


def touches(own: Body, other: Body) -> Touch:
    """The first touch of M pairs of overlapping bodies that move straight on.

    Along the vehicle and across it, bodies with a joint half extent r_x = (l + l' |cos| + w' |sin|) / 2 whose middles are x apart began
    to overlap (r_x - |x|) / |v_x| ago. They touched in the direction in which the overlap began last. If they approach each other in
    neither direction, they touched in the direction of the smaller overlap.
    """
    across = np.stack([-own.along[:, 1], own.along[:, 0]], axis=1)
    to_other = other.middle - own.middle
    relative_velocity = own.along * own.speed[:, np.newaxis] - other.along * other.speed[:, np.newaxis]
    cosine, sine = np.abs(_dot(other.along, own.along)), np.abs(_dot(other.along, across))
    extent_along = (own.length + other.length * cosine + other.width * sine) / 2
    extent_across = (own.width + other.length * sine + other.width * cosine) / 2
    ahead, left = _dot(to_other, own.along), _dot(to_other, across)
    closing = _dot(relative_velocity, own.along)
    since_along = _overlap_lasts(extent_along - np.abs(ahead), np.copysign(1.0, ahead) * closing)
    since_across = _overlap_lasts(extent_across - np.abs(left), np.copysign(1.0, left) * _dot(relative_velocity, across))
    approaches = np.isfinite(np.minimum(since_along, since_across))
    lengthwise = np.where(approaches, since_along < since_across, extent_along - np.abs(ahead) < extent_across - np.abs(left))
    ago = np.where(approaches, np.where(lengthwise, since_along, since_across), 0.0)
    side = np.where(lengthwise, np.where(ahead > 0, FRONT, REAR), np.where(left > 0, LEFT, RIGHT))
    return Touch(side, ago, own.length / 2 - (ahead + ago * closing))


def _dot(first: FloatArray, second: FloatArray) -> FloatArray:
    return first[:, 0] * second[:, 0] + first[:, 1] * second[:, 1]


def _overlap_lasts(overlap: FloatArray, closing: FloatArray) -> FloatArray:
    """Time since bodies began to overlap in a direction with a closing speed [s]; infinite if they do not approach each other."""
    return np.where(closing > 0, np.maximum(overlap, 0.0) / np.where(closing > 0, closing, 1.0), np.inf)
