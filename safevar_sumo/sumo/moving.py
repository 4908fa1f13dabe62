"""Bodies of a scenario's tracks: what follows from a track alone, at every sample, before any
vehicle moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest
from typing import NamedTuple, TypeVar

import numpy as np

from safevar_sumo.records import BoolArray, FloatArray, IntArray
from safevar_sumo.scenarios import Point, Track, TrackScenario
from safevar_sumo.scenarios.tracks import SCREEN, first_in_strip
from safevar_sumo.sumo.bodies import Body
from safevar_sumo.sumo.track_check import check_motion, check_shapes, check_start

TIE = 1e-6
"""Margin of a body's sides [m]: a body that is exactly at an edge at a sample counts, whatever the
last bit says.
"""
LEAST_SINE = 1e-9
"""Sine of an angle above which a body is rotated against the lane [-]."""
NOBODY = Track("", SCREEN, 0.0, 0.0, 1e6, 1e6, 1.0, 0.0, 0.0)
"""Who stands in for the bodies that other scenarios of the same batch have: far away."""
Sampled = TypeVar("Sampled", FloatArray, BoolArray)
BESIDE, IN_PATH = 1, 2
"""Levels of a body that moves beside the vehicle's path, and of one that is ever in it; that of
scenery is 0.
"""


class Moving(NamedTuple):
    """A body at T samples in M encounters; columns have the shapes (T or 1, M or 1): what does not
    vary has length 1.

    Attributes
    ----------
    track
        The body's track with such columns.
    edge, far_end, half_length, half_width
        Position along the lane of the body's rear (of who faces along the lane, of its first point
        in the vehicle's path) and of its far end; half its extent along and across the lane [m].
    vx, vy, least_vx, most_vx
        Speeds along the lane and to its left; the least and largest speed along it from now on
        [m/s].
    lateral, lateral_speed
        Position of its middle across the lane, from the side that the body comes from, and its rate
        of change [m, m/s].
    is_there, is_in_path, is_cleared, is_avoidable
        Whether it has a size; is in the vehicle's path; has left it for good, or is gone; or stays
        in it to the end, so that a vehicle that is never faster again has avoided it.
    level
        `IN_PATH`, `BESIDE` (who moves there) or 0 (who stands there); of several bodies those of
        the highest level count. Below 0 for a body that is not met at all.
    is_rotated, faces_along
        Whether it is ever rotated against the lane, and whether it always faces along it.
    """

    track: Track
    edge: FloatArray
    far_end: FloatArray
    half_length: FloatArray
    half_width: FloatArray
    vx: FloatArray
    vy: FloatArray
    least_vx: FloatArray
    most_vx: FloatArray
    lateral: FloatArray
    lateral_speed: FloatArray
    is_there: BoolArray
    is_in_path: BoolArray
    is_cleared: BoolArray
    is_avoidable: BoolArray
    level: IntArray
    is_rotated: bool
    faces_along: bool

    @classmethod
    def of(cls, track: Track, step: float, vehicle_width: float) -> Moving:
        """What follows from a track with columns; `vehicle_width` is that of the vehicle under test
        [m].
        """
        cosine = np.abs(track.along)
        sine = np.abs(track.left)
        half_length = (track.length * cosine + track.width * sine) / 2
        half_width = (track.length * sine + track.width * cosine) / 2

        # The rear corner of a rotated body may be beside the path: its first point in it counts.
        rear = track.x - half_length
        edge = rear
        is_lengthwise = _rotated(track) & (cosine > sine)
        if is_lengthwise.any():
            edge = np.where(
                is_lengthwise, first_in_strip(track, vehicle_width / 2), rear
            )

        vx = slim(track.speed * track.along)
        vy = slim(np.diff(track.y, axis=0, prepend=track.y[:1]) / step)
        is_there: BoolArray = slim((track.length > 0) | (track.width > 0))
        is_beside = np.abs(track.y) >= vehicle_width / 2 + half_width + TIE
        is_in_path = slim(is_there & ~is_beside & (track.kind != SCREEN))
        is_gone = ~np.maximum.accumulate(is_there[::-1], axis=0)[::-1]
        has_entered = np.maximum.accumulate(is_in_path, axis=0)
        will_touch = np.maximum.accumulate(is_in_path[::-1], axis=0)[::-1]

        # Who crosses is seen from the side from which it comes.
        sign = np.where((vy > 0).any(axis=0), 1.0, -1.0)
        moves = (is_there & (track.speed > 0)).any(axis=0)
        level = np.where(is_in_path.any(axis=0), IN_PATH, np.where(moves, BESIDE, 0))
        return cls(
            track=track,
            edge=edge,
            far_end=track.x + half_length,
            half_length=slim(half_length),
            half_width=half_width,
            vx=vx,
            vy=vy,
            least_vx=slim(_from_now_on(np.minimum, vx)),
            most_vx=slim(_from_now_on(np.maximum, vx)),
            lateral=slim(track.y * sign),
            lateral_speed=slim(vy * sign),
            is_there=is_there,
            is_in_path=is_in_path,
            is_cleared=slim((has_entered & ~will_touch) | is_gone),
            is_avoidable=slim(has_entered & is_in_path[-1]),
            level=np.full_like(level, -1) if track.kind == SCREEN else level,
            is_rotated=bool(_rotated(track).any()),
            faces_along=bool((cosine == 1).all()),
        )

    def covers(self, body: Moving) -> bool:
        """Whether another body that stands is always inside this one, which then hides all that the
        other one does.
        """
        cover = self.track
        track = body.track
        can_cover = body is not self and self.faces_along and body.faces_along
        if not can_cover or len(track.x) > 1 or len(track.y) > 1:
            return False
        dx = np.abs(track.x - cover.x)
        dy = np.abs(track.y - cover.y)
        is_inside_x = dx <= (cover.length - track.length) / 2 + TIE
        is_inside_y = dy <= (cover.width - track.width) / 2 + TIE
        return bool((is_inside_x & is_inside_y).all())


def _rotated(track: Track) -> BoolArray:
    return np.asarray(np.minimum(np.abs(track.along), np.abs(track.left)) > LEAST_SINE)


def _from_now_on(ufunc: np.ufunc, column: FloatArray) -> FloatArray:
    """The least or largest value of a column from each sample on."""
    return ufunc.accumulate(column[::-1], axis=0)[::-1]


def slim(column: Sampled) -> Sampled:
    """A column without the axes along which it does not vary."""
    if len(column) > 1 and (column[1:] == column[:1]).all():
        column = column[:1]
    if column.shape[1] > 1 and (column[:, 1:] == column[:, :1]).all():
        column = column[:, :1]
    return column


def row(column: Sampled, sample: int, group: IntArray | None) -> Sampled:
    """A column at a sample: one value for all vehicles, or one for each; `group` is the encounter
    of each vehicle.
    """
    values: Sampled = column[sample if len(column) > 1 else 0]
    if group is not None and len(values) > 1:
        return values[group]
    return values


def tracks_of(
    points: Sequence[Point],
    times: FloatArray,
    n_encounters: int,
    step: float,
    vehicle: Body,
) -> list[Track]:
    """The bodies at K points, each in N encounters, with columns; body b is that of all scenarios'
    bodies b. `vehicle` is the vehicle under test at the start.

    Raises
    ------
    InputError
        If bodies cannot move as a scenario says.
    """
    tracks_of_scenarios = [
        point.scenario.tracks_begun(times, np.asarray(point.phase) * step)
        for point in points
        if isinstance(point.scenario, TrackScenario)
    ]
    for tracks in tracks_of_scenarios:
        check_shapes(tracks, len(times), n_encounters, step)
    of_bodies = zip_longest(*tracks_of_scenarios, fillvalue=NOBODY)
    width = n_encounters if len(points) > 1 else 1
    joined = [_joined(tracks, width) for tracks in of_bodies]
    for track in joined:
        check_motion(track, times, step)
    check_start(joined, vehicle)
    return joined


def _joined(tracks: Sequence[Track], width: int) -> Track:
    """A body of K scenarios as one track with columns, of at least this width for each."""
    columns = []
    for values in zip(*(track[2:] for track in tracks), strict=True):
        parts = [np.atleast_2d(np.asarray(value, float)) for value in values]
        length = max(map(len, parts))
        widened = [
            np.broadcast_to(part, (length, max(width, part.shape[1]))) for part in parts
        ]
        columns.append(slim(np.concatenate(widened, axis=1)))
    body = next(track for track in tracks if track is not NOBODY)
    return Track(body.name, body.kind, *columns)
