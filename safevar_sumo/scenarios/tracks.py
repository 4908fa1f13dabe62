"""A scenario is who moves how: tracks of bodies, in coordinates of the vehicle's lane.

`x` leads along the lane and `y` to its left; the front of the vehicle under test is at (0, 0) at
the start. What is seen, measured and hit follows from the tracks (`sumo/traffic.py`), so no
scenario needs to know a road.
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
VUT_LENGTH, VUT_WIDTH = 4.9016, 2.1284
"""Bounding box of CARLA's vehicle.lincoln.mkz2017 [m]."""
Speed = Annotated[float, Meta(gt=0, le=250)]
"""Speed of a vehicle under test [km/h]."""


class BodySize(NamedTuple):
    """Size of a body [m]: length in the direction in which it faces, width across."""

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
MAX_LENGTH = 100.0
"""Largest size of a vehicle [m]."""
PERSONS = ("adult", "child")
"""Kinds of bodies that are persons in SUMO; all others are vehicles."""
DEPARTURE = "vehicle[@id='vut']"
"""Where a network's traffic says how the vehicle under test departs."""
SCREEN = "screen"
"""Kind of a body that only hides others: it is neither hit nor in SUMO."""


class Track(NamedTuple):
    """How a body moves; every quantity is a number or an array that broadcasts to (T, N): what is
    the same in all N encounters has the shape (T, 1).

    Attributes
    ----------
    name
        The body's name, of which a scenario has one each.
    kind
        A kind of `BODIES`, `screen`, or any other word, such as `van`.
    length, width
        Size in the direction in which the body faces, and across [m]. A body without size is not
        there: it is neither seen nor hit, and does not count.
    x, y
        The body's middle [m].
    along, left
        The direction in which it faces, a unit vector. (No sines in tracks: their last bits differ
        between machines.)
    speed
        Its speed in this direction [m/s].
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
        """A body with these velocities along the lane and to its left [m/s] that faces where it
        moves, and along the lane while it stands; without a `size` it has that of its kind.
        """
        if size is None and kind not in BODIES:
            raise InputError(
                "Track.of",
                f"a body of the kind {kind!r} has no size",
                f"a size, or {one_of(BODIES)}",
            )

        # A standing body faces along the lane.
        length, width = size or BODIES[kind]
        speed = np.sqrt(np.square(vx) + np.square(vy))
        moves = speed > 0
        divisor = np.where(moves, speed, 1.0)
        along = np.where(moves, vx / divisor, 1.0)
        lateral = np.where(moves, vy / divisor, 0.0)
        return cls(name, kind, length, width, x, y, along, lateral, speed)


def travelled(speeds: Quantity, times: FloatArray) -> FloatArray:
    """Distances [m] covered since the first of T `times`, shape (T, 1) [s], at speeds that are
    linear in between.
    """
    at_times = speeds + np.zeros_like(times)
    covered = (at_times[1:] + at_times[:-1]) / 2 * (times[1:] - times[:-1])
    return np.concatenate(
        [np.zeros_like(at_times[:1]), np.add.accumulate(covered, axis=0)]
    )


def first_in_strip(body: Track, half_width: float) -> Quantity:
    """Position along the lane [m] of the first point of a body in the strip of this half width
    around the lane's middle; of a body beside the strip that of its first corner.
    """
    corners = corners_of(body)
    first_x = np.full(np.broadcast(*chain(*corners)).shape, np.inf)
    for (x, y), (to_x, to_y) in pairwise([*corners, corners[0]]):
        first_x = np.where(np.abs(y) <= half_width, np.minimum(first_x, x), first_x)
        for side in (-half_width, half_width):
            crosses = (np.minimum(y, to_y) < side) & (side < np.maximum(y, to_y))
            share = (side - y) / np.where(crosses, to_y - y, 1.0)
            first_x = np.where(
                crosses, np.minimum(first_x, x + (to_x - x) * share), first_x
            )
    beside = np.minimum.reduce(np.broadcast_arrays(*(x for x, _ in corners)))
    return np.where(np.isinf(first_x), beside, first_x)[()]


def corners_of(body: Track) -> list[tuple[Quantity, Quantity]]:
    """The four corners of a body, once around it [m]."""
    half_length = body.length / 2
    half_width = body.width / 2
    return [
        (
            body.x + end * half_length * body.along - side * half_width * body.left,
            body.y + end * half_length * body.left + side * half_width * body.along,
        )
        for end, side in ((1, 1), (1, -1), (-1, -1), (-1, 1))
    ]


def check_tracks(
    code: UserCode, method: str, tracks: Any, times: FloatArray
) -> Sequence[Track]:
    """Refuse what a user's scenario returns if it is no list of tracks, or if a track has no
    number.
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
        for name, value in zip(Track._fields[2:], track[2:], strict=True):
            if np.asarray(value).dtype.kind not in "biuf":
                raise code.wrong(
                    method, f"{name} = {quoted(value)} of {track.name!r}", "numbers"
                )
    return tracks


LEGAL_FIELDS = {
    "start_speed": Legal(0.0, MAX_TEST_SPEED),
    "vut_length": Legal(0.0, MAX_LENGTH, is_open=True),
    "vut_width": Legal(0.0, MAX_LENGTH, is_open=True),
    "sensor_setback": Legal(0.0, MAX_LENGTH),
}
"""Legal numbers of a user's scenario of tracks, besides those of every scenario."""


class TrackScenario(Scenario):
    """A scenario whose actors move by tracks, whatever the vehicle under test does. Its fields are
    its parameters, each a number or, where encounters are searched, an array of N.

    Attributes
    ----------
    duration
        Length of a run [s].
    speed, start_speed
        Speed of the vehicle at the start [km/h], and the same in m/s; a scenario may have either.
    test_speed
        See `Scenario`: with it a robot holds the speed, and only contacts of the vehicle's front
        are collisions.
    vut_length, vut_width
        The vehicle's body [m].
    sensor_setback
        Distance of the sensors behind the middle of the front bumper [m].
    network
        Where SUMO repeats runs and pictures show them: a straight lane on which the vehicle
        departs.
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
        """The bodies at T `times`, shape (T, 1) [s], which begin at 0."""

    @property
    def has_phase(self) -> bool:
        """All bodies can begin later, unless the scenario has a parameter of that name itself."""
        return PHASE not in free_parameters(type(self))

    def tracks_begun(self, times: FloatArray, later: Quantity) -> Sequence[Track]:
        """The bodies at T `times`, shape (T, 1), of an encounter that begins `later` [s], a number
        or of shape (N,). Until then the vehicle and all bodies go on as they do at its beginning.

        The vehicle is at (0, 0) at the first time, as ever, so that all bodies are farther ahead by
        what it covers until the encounter begins.

        Raises
        ------
        InputError
            If a user's scenario does not take times of shape (T, N).
        """
        if not np.any(later):
            return self.tracks(times)
        since = times - later
        tracks = self.tracks(np.maximum(since, 0.0))

        # A user's class may read the first column of the times alone.
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

        # Before its encounter each body keeps its first velocity.
        early = np.minimum(since, 0.0)
        way = self.start_speed * later
        late_tracks = []
        for track in tracks:
            along, lateral, speed = (np.atleast_2d(column)[:1] for column in track[6:])
            x = track.x + way + speed * along * early
            late_tracks.append(track._replace(x=x, y=track.y + speed * lateral * early))
        return late_tracks

    def actors(self, roads: Roads) -> XmlChanges:
        """The vehicle under test, at its speed."""
        return {
            "vType[@id='vut']": {
                "length": as_text(self.vut_length),
                "width": as_text(self.vut_width),
            },
            DEPARTURE: {"departSpeed": as_text(self.start_speed)},
        }


class LaneTest(TrackScenario, Table, frozen=True, kw_only=True):
    """Base of tests on a straight lane, at whose speed a robot holds the vehicle until its driving
    system acts.

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
