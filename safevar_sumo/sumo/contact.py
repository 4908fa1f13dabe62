"""Which side of the vehicle under test touches somebody, and where on it."""

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
    """How M bodies came to overlap another: the side, how long ago they touched [s], the other's middle from the own front [m]."""

    side: npt.NDArray[np.str_]
    ago: FloatArray
    behind_front: FloatArray


class Contacts:
    """First contacts of N vehicles; `tested` are those of whom only the front collides, as a Euro NCAP test counts it."""

    def __init__(self, n: int, tested: BoolArray) -> None:
        self._tested, self._side, self._place = tested, np.full(n, "", dtype="U5"), np.full(n, np.nan)

    def collisions(self, world: Any, open_: BoolArray, scene: Scene) -> dict[int, float]:
        """Take in one sample; returns the vehicles of open runs that collide, and their speeds [m/s]."""
        speeds = world.collisions(open_)
        first = [copy for copy in speeds if not self._side[copy]]
        if first:
            own, other = world.bodies(first)
            self._take(first, own, other, scene)
        return {copy: speed for copy, speed in speeds.items() if not self._tested[copy] or self._side[copy] == FRONT}

    def _take(self, copies: Sequence[int], own: Body, other: Body, scene: Scene) -> None:
        touch = touches(own, other)
        self._side[copies] = touch.side
        lateral = scene.lateral[copies] - np.broadcast_to(scene.lateral_speed, scene.lateral.shape)[copies] * touch.ago
        share = np.where(np.isin(touch.side, (FRONT, REAR)), lateral / own.width + 0.5, touch.behind_front / own.length)
        self._place[copies] = 100 * np.minimum(np.maximum(share, 0.0), 1.0)

    def contact(self) -> Contact:
        """The first contact of every vehicle."""
        return Contact(self._side, self._place)


def touches(own: Body, other: Body) -> Touch:
    """How M pairs of bodies came to overlap that move straight on.

    Along the vehicle and across it, bodies with a reach r_x = (l + l' |cos| + w' |sin|) / 2 whose middles lie x apart began to
    overlap (r_x - |x|) / |v_x| ago. The direction in which they began to last is the one in which they touched. Where they do not
    near each other in either, it is the one in which they overlap less.
    """
    across = np.stack([-own.along[:, 1], own.along[:, 0]], axis=1)
    to_other = other.middle - own.middle
    nearing = own.along * own.speed[:, np.newaxis] - other.along * other.speed[:, np.newaxis]
    cosine, sine = np.abs(_dot(other.along, own.along)), np.abs(_dot(other.along, across))
    reach_along = (own.length + other.length * cosine + other.width * sine) / 2
    reach_across = (own.width + other.length * sine + other.width * cosine) / 2
    ahead, left = _dot(to_other, own.along), _dot(to_other, across)
    closing = _dot(nearing, own.along)
    since_along = _overlap_lasts(reach_along - np.abs(ahead), np.copysign(1.0, ahead) * closing)
    since_across = _overlap_lasts(reach_across - np.abs(left), np.copysign(1.0, left) * _dot(nearing, across))
    near = np.isfinite(np.minimum(since_along, since_across))
    lengthwise = np.where(near, since_along < since_across, reach_along - np.abs(ahead) < reach_across - np.abs(left))
    ago = np.where(near, np.where(lengthwise, since_along, since_across), 0.0)
    side = np.where(lengthwise, np.where(ahead > 0, FRONT, REAR), np.where(left > 0, LEFT, RIGHT))
    return Touch(side, ago, own.length / 2 - (ahead + ago * closing))


def _dot(first: FloatArray, second: FloatArray) -> FloatArray:
    return first[:, 0] * second[:, 0] + first[:, 1] * second[:, 1]


def _overlap_lasts(overlap: FloatArray, nearing: FloatArray) -> FloatArray:
    """For how long bodies have overlapped in a direction in which they near each other at a speed [s]; for ever if they do not."""
    return np.where(nearing > 0, np.maximum(overlap, 0.0) / np.where(nearing > 0, nearing, 1.0), np.inf)
