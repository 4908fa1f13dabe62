"""Scenarios that consist of tracks: each track says how a body moves in coordinates of the
vehicle's lane.

`x` is the coordinate along the lane, and `y` the coordinate to its left. The front of the vehicle
under test is at (0, 0) at the start. `sumo/traffic.py` computes from the tracks what the vehicle
sees and hits. Therefore no scenario needs to know a road.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple

import numpy as np
from msgspec import Meta

from safevar_sumo.errors import InputError, one_of
from safevar_sumo.plugins import Contract, Legal, Returned, UserCode, quoted
from safevar_sumo.records import KMH_PER_MS, FloatArray, Quantity
from safevar_sumo.scenarios.base import (
    MAX_TEST_SPEED,
    Grade,
    Scenario,
    XmlChanges,
    as_text,
)
from safevar_sumo.scenarios.roads import Roads
from safevar_sumo.study import PHASE, Table, free_parameters

KMH = 1 / KMH_PER_MS
"""m/s per km/h."""
VUT_LENGTH = 4.9016
"""Length of CARLA's vehicle.lincoln.mkz2017 [m]."""
VUT_WIDTH = 2.1284
"""Width of CARLA's vehicle.lincoln.mkz2017 [m]."""
Speed = Annotated[float, Meta(gt=0, le=250)]
"""Speed of the vehicle under test [km/h]."""


class BodySize(NamedTuple):
    """The size of a body [m]: length in the direction in which the body faces, and width across."""

    length: float
    width: float


BODIES = {
    "adult": BodySize(0.6, 0.5),
    "child": BodySize(0.711, 0.298),
    "cyclist": BodySize(1.9, 0.5),
    "motorcyclist": BodySize(2.1, 0.8),
    "car": BodySize(4.023, 1.712),
}
"""Bounding boxes of Euro NCAP's targets, including riders, by kind [m]."""
MAX_VEHICLE_LENGTH = 100.0
"""Largest length or width of a vehicle [m]."""
PERSONS = ("adult", "child")
"""Kinds of bodies that are persons in SUMO; all others are vehicles."""
DEPARTURE = "vehicle[@id='vut']"
"""The XPath of the element in a network's traffic that says how the vehicle under test departs."""
SCREEN = "screen"
"""The kind of a body that only hides other bodies. A screen cannot be hit, and is not in SUMO."""


class Track(NamedTuple):
    """The movement of a body. A quantity is a number, or an array that broadcasts to (T, N): T
    samples of N encounters. An array of shape (T, 1) holds for all N encounters.

    Attributes
    ----------
    name
        The body's name, which no other body of the scenario has.
    kind
        A kind of `BODIES`, `screen`, or any other word, such as `van`.
    length, width
        Size in the direction in which the body faces, and across [m]. A body without size does not
        exist: it is neither seen nor hit, and does not count.
    x, y
        The body's middle [m].
    along, left
        The direction in which the body faces, a unit vector. (Tracks contain no sines, because the
        last bits of a sine differ between machines.)
    speed
        The body's speed in this direction [m/s].
    """

    name: str
    kind: str
    length: Quantity
    width: Quantity
    x: Quantity
    y: Quantity
    along: Quantity
    left: Quantity
    speed: Quantity

    @property
    def quantities(self) -> dict[str, Quantity]:
        """The fields with quantities, from `length` to `speed`, by name."""
        quantities = self._asdict()
        del quantities["name"], quantities["kind"]
        return quantities

    @classmethod
    def of(
        cls,
        name: str,
        kind: str,
        x: Quantity,
        y: Quantity,
        vx: Quantity = 0.0,
        vy: Quantity = 0.0,
        size: tuple[float, float] | None = None,
    ) -> Track:
        """Make the track of a body from its velocities along the lane (`vx`) and to the left (`vy`)
        [m/s].

        The body faces where it moves, and along the lane while it stands. Without a `size`, the
        body has the size of its kind.
        """
        if size is None and kind not in BODIES:
            raise InputError(
                "Track.of",
                f"a body of the kind {kind!r} has no size",
                f"a size, or {one_of(BODIES)}",
            )

        # A standing body has no direction of movement: it faces along the lane.
        length, width = size or BODIES[kind]
        speed = np.sqrt(np.square(vx) + np.square(vy))
        moves = speed > 0
        divisor = np.where(moves, speed, 1.0)
        along = np.where(moves, vx / divisor, 1.0)
        lateral = np.where(moves, vy / divisor, 0.0)
        return cls(name, kind, length, width, x, y, along, lateral, speed)


def travelled(speeds: Quantity, times: FloatArray) -> FloatArray:
    """The distances [m] covered since the first of T `times`, shape (T, 1) [s]. Between two times,
    the speed changes linearly.
    """
    speeds_at_times = speeds + np.zeros_like(times)
    mean_speeds = (speeds_at_times[1:] + speeds_at_times[:-1]) / 2
    ways = mean_speeds * (times[1:] - times[:-1])
    start = np.zeros_like(speeds_at_times[:1])
    return np.concatenate([start, np.add.accumulate(ways, axis=0)])


def first_in_strip(body: Track, half_width: float) -> Quantity:
    """The position along the lane [m] of a body's first point in the strip around the lane's
    middle. `half_width` is half the strip's width [m]. If the body is beside the strip, the
    position of its first corner.
    """
    corners = corners_of(body)
    first_x = np.full(np.broadcast(*chain(*corners)).shape, np.inf)
    for (x, y), (next_x, next_y) in pairwise([*corners, corners[0]]):
        first_x = np.where(np.abs(y) <= half_width, np.minimum(first_x, x), first_x)
        for side in (-half_width, half_width):
            crosses = (np.minimum(y, next_y) < side) & (side < np.maximum(y, next_y))
            share = (side - y) / np.where(crosses, next_y - y, 1.0)
            crossing_x = x + (next_x - x) * share
            first_x = np.where(crosses, np.minimum(first_x, crossing_x), first_x)
    beside = np.minimum.reduce(np.broadcast_arrays(*(x for x, _ in corners)))
    return np.where(np.isinf(first_x), beside, first_x)[()]


CORNERS = (1, 1), (1, -1), (-1, -1), (-1, 1)
"""The corners of a rectangle, once around it: 1 is the front or the left, -1 the rear or the right.
"""


def corners_of(body: Track) -> list[tuple[Quantity, Quantity]]:
    """The four corners of a body [m], in order around the body."""
    corners = []
    for end, side in CORNERS:
        lengthwise = end * body.length / 2
        across = side * body.width / 2
        x = body.x + lengthwise * body.along - across * body.left
        y = body.y + lengthwise * body.left + across * body.along
        corners.append((x, y))
    return corners


def check_tracks(
    code: UserCode, method: str, tracks: Any, times: FloatArray
) -> Sequence[Track]:
    """Refuse the result of a user's `tracks` if it is no list of tracks, or if a track's value is
    no number.
    """
    if (
        not isinstance(tracks, list | tuple)
        or not all(isinstance(track, Track) for track in tracks)
        or not tracks
    ):
        raise code.wrong(
            method,
            quoted(tracks),
            "a list of safevar_sumo.scenarios.Track, of one at least",
        )
    for track in tracks:
        for name, value in track.quantities.items():
            if np.asarray(value).dtype.kind not in "biuf":
                raise code.wrong(
                    method, f"{name} = {quoted(value)} of {track.name!r}", "numbers"
                )
    return tracks


LEGAL_FIELDS = {
    "start_speed": Legal(0.0, MAX_TEST_SPEED),
    "vut_length": Legal(0.0, MAX_VEHICLE_LENGTH, is_open=True),
    "vut_width": Legal(0.0, MAX_VEHICLE_LENGTH, is_open=True),
    "sensor_setback": Legal(0.0, MAX_VEHICLE_LENGTH),
}
"""Legal numbers of fields of a user's scenario of tracks, in addition to the fields of every
scenario.
"""


class TrackScenario(Scenario):
    """A scenario whose actors move on tracks, whatever the vehicle under test does. The fields of
    the class are the scenario's parameters. A field is a number, or an array of N values if
    encounters are searched.

    Attributes
    ----------
    duration
        Length of a run [s].
    speed
        Speed of the vehicle at the start [km/h].
    start_speed
        The same speed in m/s. A class states one of both.
    test_speed
        See `Scenario`. If it is not None, a robot holds the speed, and only contacts at the
        vehicle's front are collisions.
    vut_length, vut_width
        Size of the vehicle's body [m].
    sensor_setback
        Distance of the sensors behind the middle of the front bumper [m].
    network
        The network in which SUMO repeats runs, and which pictures show: a straight lane on which
        the vehicle departs.
    """

    RETURNS: ClassVar[Contract] = {"tracks": Returned(then=check_tracks)}
    reactive_actors = False
    goes_on = True
    network = "along"
    sensor_setback = 0.0
    if TYPE_CHECKING:
        speed: Quantity

        @property
        def vut_length(self) -> float: ...
        @property
        def vut_width(self) -> float: ...
    else:
        vut_length = VUT_LENGTH
        vut_width = VUT_WIDTH

    @property
    def start_speed(self) -> Quantity:
        """Speed of the vehicle at the start [m/s]."""
        return self.speed * KMH

    @abstractmethod
    def tracks(self, times: FloatArray) -> Sequence[Track]:
        """The tracks of all bodies at T `times`, shape (T, 1) [s]. The first time is 0."""

    @property
    def has_phase(self) -> bool:
        """Whether the encounter can begin later by a part of a step. A scenario with a parameter of
        this name decides the phase itself.
        """
        return PHASE not in free_parameters(type(self))

    def tracks_begun(self, times: FloatArray, later: Quantity) -> Sequence[Track]:
        """The tracks at T `times`, shape (T, 1), of an encounter that begins `later` [s], a number
        or shape (N,). Before its beginning, all bodies keep the velocities of the beginning, and
        the vehicle drives at its start speed.

        The vehicle is at (0, 0) at the first time, also if the encounter begins later. Therefore
        all bodies are farther ahead, by the distance that the vehicle covers until the encounter
        begins.

        Raises
        ------
        InputError
            If a user's scenario does not take times of shape (T, N).
        """
        if not np.any(later):
            return self.tracks(times)
        since = times - later
        tracks = self.tracks(np.maximum(since, 0.0))

        # A user's class that reads only the first column of `times` would give all encounters one
        # phase.
        if self.is_user_code and since.shape[1] > 1:
            alone = self.tracks(np.maximum(since[:, -1:], 0.0))
            ends = (np.atleast_2d(track.x)[:, -1] for track in (*tracks, *alone))
            columns = np.broadcast_arrays(*ends)
            if not np.allclose(columns[: len(alone)], columns[len(alone) :]):
                raise InputError(
                    "",
                    f"{type(self).__name__}.tracks reads the first of several times alone",
                    "tracks that take times of shape (T, N)",
                )

        # Before the encounter begins, each body moves at its first velocity.
        early = np.minimum(since, 0.0)
        way = self.start_speed * later
        late_tracks = []
        for track in tracks:
            along, lateral, speed = (np.atleast_2d(column)[:1] for column in track[6:])
            x = track.x + way + speed * along * early
            late_tracks.append(track._replace(x=x, y=track.y + speed * lateral * early))
        return late_tracks

    def actors(self, roads: Roads) -> XmlChanges:
        """Set the size and the departure speed of the vehicle under test."""
        return {
            "vType[@id='vut']": {
                "length": as_text(self.vut_length),
                "width": as_text(self.vut_width),
            },
            DEPARTURE: {"departSpeed": as_text(self.start_speed)},
        }


class LaneTest(TrackScenario, Table, frozen=True, kw_only=True):
    """Base of tests on a straight lane. A robot holds the vehicle's speed until the driving system
    acts.

    Parameters
    ----------
    speed
        Speed of the vehicle under test at the start [km/h].
    vut_length, vut_width
        Size of the vehicle under test [m].
    grade
        Rise of the road over its length, negative downhill [%].
    """

    speed: Speed = 40.0
    vut_length: Annotated[float, Meta(gt=0.5, le=30)] = VUT_LENGTH
    vut_width: Annotated[float, Meta(gt=0.5, le=3.5)] = VUT_WIDTH
    grade: Grade = 0.0
    network: str = "along"

    @property
    def test_speed(self) -> Quantity:
        """Speed that the vehicle holds until its driving system acts [m/s]."""
        return self.start_speed
