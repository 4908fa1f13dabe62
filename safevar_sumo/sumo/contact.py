"""Which side of the vehicle under test touches somebody, and where on it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.records import BoolArray, Contact
from safevar_sumo.scenarios import Scene
from safevar_sumo.sumo.world import Body

FRONT, LEFT, RIGHT, REAR = "front", "left", "right", "rear"


class Touch(NamedTuple):
    """How two bodies that overlap came to: the vehicle's side, how long ago they touched [s], the other's middle from its front [m]."""

    side: str
    ago: float
    behind_front: float


class Contacts:
    """First contacts of N vehicles; `tested` are those of whom only the front collides, as a Euro NCAP test counts it."""

    def __init__(self, n: int, tested: BoolArray) -> None:
        self._tested, self._side, self._place = tested, np.full(n, "", dtype="U5"), np.full(n, np.nan)

    def collisions(self, world: Any, open_: BoolArray, scene: Scene) -> dict[int, float]:
        """Take in one sample; returns the vehicles of open runs that collide, and their speeds [m/s]."""
        found = world.collisions(open_)
        for copy in found:
            if not self._side[copy]:
                own, other = world.bodies(copy)
                self._take(copy, own, other, scene)
        return {copy: speed for copy, speed in found.items() if not self._tested[copy] or self._side[copy] == FRONT}

    def _take(self, copy: int, own: Body, other: Body, scene: Scene) -> None:
        touch = touch_of(own, other)
        self._side[copy] = touch.side
        lateral = scene.lateral[copy] - np.broadcast_to(scene.lateral_speed, scene.lateral.shape)[copy] * touch.ago
        share = lateral / own.width + 0.5 if touch.side in (FRONT, REAR) else touch.behind_front / own.length
        self._place[copy] = 100 * min(max(share, 0.0), 1.0)

    def contact(self) -> Contact:
        """The first contact of every vehicle."""
        return Contact(self._side, self._place)


def touch_of(own: Body, other: Body) -> Touch:
    """How two bodies came to overlap that move straight on.

    Along the vehicle and across it, bodies with a reach r_x = (l + l' |cos| + w' |sin|) / 2 whose middles lie x apart began to
    overlap (r_x - |x|) / |v_x| ago. The direction in which they began to last is the one in which they touched. Where they do not
    near each other in either, it is the one in which they overlap less.
    """
    across = np.array([-own.along[1], own.along[0]])
    to_other = other.middle - own.middle
    nearing = own.along * own.speed - other.along * other.speed
    cosine, sine = abs(float(other.along @ own.along)), abs(float(other.along @ across))
    reach_along = (own.length + other.length * cosine + other.width * sine) / 2
    reach_across = (own.width + other.length * sine + other.width * cosine) / 2
    ahead, left = float(to_other @ own.along), float(to_other @ across)
    since_along = _overlap_lasts(reach_along - abs(ahead), np.copysign(1.0, ahead) * float(nearing @ own.along))
    since_across = _overlap_lasts(reach_across - abs(left), np.copysign(1.0, left) * float(nearing @ across))
    lengthwise = since_along < since_across
    if not np.isfinite(min(since_along, since_across)):
        lengthwise, since_along, since_across = reach_along - abs(ahead) < reach_across - abs(left), 0.0, 0.0
    ago = since_along if lengthwise else since_across
    side = (FRONT if ahead > 0 else REAR) if lengthwise else (LEFT if left > 0 else RIGHT)
    return Touch(side, ago, own.length / 2 - (ahead + ago * float(nearing @ own.along)))


def _overlap_lasts(overlap: float, nearing: float) -> float:
    """For how long bodies have overlapped in a direction in which they near each other at a speed [s]; for ever if they do not."""
    return max(overlap, 0.0) / nearing if nearing > 0 else np.inf
