"""Entities of a scenario: their bodies, and how they move from sample to sample."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.openscenario.document import (
    FILE_KEY,
    Element,
    attribute,
    number,
    part,
    unsupported,
)
from safevar_sumo.openscenario.lines import Line, Pose
from safevar_sumo.openscenario.places import Place
from safevar_sumo.openscenario.ways import Way

STEP = 0.01
"""Time between two samples [s]."""
MIN_SPEED = 0.1
"""Speed from which on a body turns while it moves sideways [m/s]."""
Array = Any
"""An array over samples."""


class Shape(NamedTuple):
    """A body: its kind, length and width [m], and how far its middle is ahead and to the left of
    its origin [m].
    """

    kind: str
    length: float
    width: float
    ahead: float
    left: float

    @property
    def front(self) -> float:
        """From the origin to the front [m]."""
        return self.ahead + self.length / 2

    @property
    def rear(self) -> float:
        """From the origin to the rear [m]."""
        return self.ahead - self.length / 2


class Motion(NamedTuple):
    """How a quantity changes since a time [s]: its value at times since then.

    If it changes over a distance, `until` is where it ends, and both count in the distance that the
    actor has travelled [m].
    """

    since: float
    value: Callable[[Array], Array]
    until: float | None = None


class Unplaced(InputError):
    """An entity has no place yet."""


@dataclass
class Running:
    """An action that has begun, and the time at which it ends [s]."""

    end: float = math.inf
    is_replaced: bool = False

    def is_done(self, time: float) -> bool:
        """Whether it has ended."""
        return self.is_replaced or time >= self.end - 1e-9


class Following(NamedTuple):
    """A distance that an actor keeps along the way from another one [m]."""

    other: Actor
    distance: float


class FollowedLane(NamedTuple):
    """The lane that an actor follows since it is on a path and moved sideways as it does: at
    distances, how far the lane's middle has moved to the left; the actor's offset then [m].
    """

    path: Line
    sideways: Motion | None
    distances: Array
    shifts: Array
    left: float

    def shift(self, distance: Array) -> Array:
        """How far the lane has moved to the left at distances [m]."""
        return np.interp(distance, self.distances, self.shifts)


@dataclass
class Actor:
    """An entity that moves: where it is now, its motions, and arrays of all samples.

    `place`, `facing` and `speed` are those of its origin, in the plane; `travelled` is its way
    since the start [m], `standing` for how long it has stood [s].
    """

    name: str
    shape: Shape
    n_samples: int
    at: Place | None = None
    speed_now: float = 0.0
    along: Motion | None = None
    sideways: Motion | None = None
    stations: Motion | None = None
    follows: Following | None = None
    running: dict[str, Running] = field(default_factory=dict)
    deleted: float = math.inf
    lane: FollowedLane | None = None

    def __post_init__(self) -> None:
        self.place, self.facing = (np.zeros(self.n_samples, dtype=complex) for _ in range(2))
        self.speed, self.travelled, self.standing, self.distance, self.left = np.zeros(
            (5, self.n_samples)
        )

    @property
    def here(self) -> Place:
        """Where it is now."""
        if self.at is None:
            problem = f"{self.name} has no place in Init"
            raise Unplaced(FILE_KEY, problem, "a TeleportAction or a trajectory in Init")
        return self.at

    def begin(
        self,
        domain: str,
        duration: float,
        since: float,
        value: Callable[[Array], Array],
        *,
        over_distance: bool = False,
    ) -> Running:
        """Begin a motion `along` its way or `sideways`, in place of the one before.

        It begins at a time and has a duration [s], or both are distances that are travelled [m].
        """
        until = since + duration
        running = Running(math.inf if over_distance else until)
        if domain in self.running:
            self.running[domain].is_replaced = True
        self.running[domain] = running
        if domain == "along":
            self.along = Motion(since, value)
            self.follows = None
            self.stations = None
        else:
            if self.stations is not None:  # who leaves a trajectory with times keeps its speed
                self.hold()
            self.sideways = Motion(since, value, until if over_distance else None)
        return running

    def end(self, running: Running) -> None:
        """End an action before its time: the speed and the offset stay as they are."""
        for domain, own in self.running.items():
            if own is running and not running.is_replaced:
                running.is_replaced = True
                if domain == "along":
                    self.along = self.follows = self.stations = None
                else:
                    self.sideways = None

    def hold(self) -> None:
        """End what changes the speed."""
        if "along" in self.running:
            self.end(self.running["along"])

    def note(self, sample: int) -> None:
        """Write where it is now; who has not been put elsewhere faces as it moved."""
        pose = self.here.pose
        if not sample or abs(pose.place - self.place[sample]) > 1e-9:
            self.place[sample], self.facing[sample] = pose
        self.speed[sample] = self.speed_now
        self.distance[sample] = self.here.distance
        self.left[sample] = self.here.left

    def move(self, sample: int, last: int, times: Array) -> None:
        """Move from a sample to the `last`: the speed is that of the body, along its own
        direction.
        """
        now = self.here
        n = last - sample
        later = slice(sample + 1, last + 1)

        # How far it drives in each step, along its own direction.
        if self.follows is not None:
            speed: Array = self.follows.other.speed[later]
        elif self.along is None:
            speed = np.full(n, self.speed_now)
        else:
            speed = np.broadcast_to(self.along.value(times[later] - self.along.since), n)
        before = np.concatenate([[self.speed_now], speed[:-1]])
        ahead = (before + speed) / 2 * STEP
        if self.stations is not None:
            ahead = np.diff(
                self.stations.value(times[later] - self.stations.since), prepend=now.distance
            )
        self.travelled[later] = self.travelled[sample] + np.cumsum(ahead)

        # Where that is along its path and beside it.
        lane = self._follow_lane()
        offset = self._offsets(lane, sample, last, times)
        distance, left, turn = self._places_after(lane, ahead, offset, speed)
        if self.follows is not None:
            distance = self._behind(self.follows, later)
        pose = now.path.pose(distance, left)
        self.place[later] = pose.place
        self.facing[later] = pose.facing * turn * now.turn
        self.speed[later] = speed
        self.distance[later] = distance
        self.left[later] = left
        moves = speed > 1e-3
        since = np.maximum.accumulate(np.where(moves, np.arange(1, n + 1), 0))
        self.standing[later] = STEP * (np.arange(1, n + 1) - since) + self.standing[sample] * (
            since == 0
        )

    def _offsets(self, lane: FollowedLane | None, sample: int, last: int, times: Array) -> Array:
        """Offsets to the left by its motion sideways, from a sample to the `last` [m]; a lane that
        moves comes on top.
        """
        motion = self.sideways
        later = slice(sample + 1, last + 1)
        if motion is None:
            return np.full(last - sample, self.here.left if lane is None else lane.left)
        passed: Array = times[later] if motion.until is None else self.travelled[later]
        if motion.until is not None:
            # It ends at the first sample at which the actor has travelled so far.
            index = int(np.searchsorted(self.travelled[sample : last + 1], motion.until - 1e-9))
            self.running["sideways"].end = float(np.append(times[sample : last + 1], np.inf)[index])
        return np.broadcast_to(motion.value(passed - motion.since), last - sample)

    def _places_after(
        self, lane: FollowedLane | None, ahead: Array, offset: Array, speed: Array
    ) -> tuple[Array, Array, Array]:
        """Distances along the path and to its left after steps that lead so far `ahead` [m], and
        the body's turns.
        """
        now = self.here
        path = now.path
        left, turn, forward = offset, np.ones(len(ahead)), ahead
        distance = now.distance + np.cumsum(forward)
        # Where a lane is depends on the distance, and the distance on how far it leads aside: each
        # round begins where the one before has come to, and no test shows what a fourth changes.
        for _ in range(1 if lane is None else 3):
            if lane is not None:
                left = offset + lane.shift(distance)
            if lane is not None or self.sideways is not None:
                aside = np.diff(left, prepend=now.left)
                sine = np.clip(aside / np.maximum(ahead, 1e-12), -1.0, 1.0)
                cosine = np.sqrt(1 - np.square(sine))
                forward = ahead * cosine
                turn = np.where(speed > MIN_SPEED, cosine + 1j * sine, 1.0)
                distance = now.distance + np.cumsum(forward)
            if isinstance(path, Way) and not path.is_straight:
                # On a way that bends, the inner side is shorter; the second round takes the bend
                # where the first one has come to.
                for _ in range(2):
                    middle = distance - forward / 2
                    inside = 1 - path.curvature(middle) * left
                    distance = now.distance + np.cumsum(forward / inside)
        return distance, left, turn

    def _follow_lane(self) -> FollowedLane | None:
        """The lane that it follows; None if it is on no roads, or lanes keep their places."""
        path = self.here.path
        if not isinstance(path, Way) or path.has_even_lanes:
            return None
        if self.lane is None or not (
            self.lane.path is path and self.lane.sideways is self.sideways
        ):
            # Who changes lanes follows the new one.
            left = self.here.left
            goal = left if self.sideways is None else float(self.sideways.value(1e12))
            distances, lefts = path.lane_line(self.here.distance, goal)
            self.lane = FollowedLane(path, self.sideways, distances, lefts - lefts[0], left)
        return self.lane

    def _behind(self, following: Following, later: slice) -> Array:
        """Distances along the path of who keeps its distance to another actor."""
        other, by = following
        path = self.here.path
        its = other.here.path
        if isinstance(path, Way) and isinstance(its, Way) and path.chain == its.chain:
            return other.distance[later] + by
        if not (path.is_straight and its.is_straight):
            raise unsupported(
                f"LongitudinalDistanceAction: {self.name} and {other.name} are not on the same"
                " roads",
                "continuous = false, or entities on the same roads",
            )
        return path.along(other.place[later]) + by

    def arrive(self, sample: int) -> None:
        """Be where it has been at a sample."""
        here = self.here
        self.at = here._replace(
            distance=float(self.distance[sample]), left=float(self.left[sample])
        )
        self.speed_now = float(self.speed[sample])

    def pose(self, sample: int) -> Pose:
        """Its pose at a sample."""
        return Pose(complex(self.place[sample]), complex(self.facing[sample]))


def actors_of(root: Element, n_samples: int) -> Iterator[Actor]:
    """The entities of a file (class ScenarioObject)."""
    for entity in root.findall("Entities/ScenarioObject"):
        name = attribute(entity, "name")
        body = next(
            (each for each in entity if each.tag in ("Vehicle", "Pedestrian", "MiscObject")), None
        )
        if body is None:
            raise unsupported(
                f"{name} is no Vehicle, Pedestrian or MiscObject",
                "one of them, or a reference to a catalog",
            )
        if any(
            each.tag != "TrailerRef" or each.get("entityRef") for each in body.findall("Trailer/*")
        ):
            raise unsupported(
                f"the Trailer of {name} is not supported", "a vehicle without a trailer"
            )
        middle = part(body, "BoundingBox/Center")
        size = part(body, "BoundingBox/Dimensions")
        length = number(size, "length")
        width = number(size, "width")
        if not (0 < length <= 100 and 0 < width <= 100):
            raise unsupported(
                f"{name} is {length:g} m long and {width:g} m wide", "sizes above 0, up to 100 m"
            )
        shape = Shape(_kind(body), length, width, number(middle, "x"), number(middle, "y", 0.0))
        yield Actor(name, shape, n_samples)


def _kind(body: Element) -> str:
    """What sumo-gui draws, and whether it is a person there."""
    if body.tag == "Pedestrian":
        height = number(part(body, "BoundingBox/Dimensions"), "height", 2.0)
        return "child" if height < CHILD else "adult"
    return {"bicycle": "cyclist", "motorbike": "motorcyclist"}.get(
        body.get("vehicleCategory", ""), "car"
    )


CHILD = 1.4
"""Height below which a pedestrian is drawn as a child [m]."""
