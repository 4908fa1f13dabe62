"""Quantities of a scenario's bodies that follow from their tracks alone: they are computed for all
samples before any vehicle moves.
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
"""Margin by which a body's sides are widened [m]: a body that is exactly at an edge at a sample
counts, whatever the last bit of its position is.
"""
LEAST_SINE = 1e-9
"""Sine of an angle above which a body is rotated against the lane [-]."""
FAR_BODY = Track("", SCREEN, 0.0, 0.0, 1e6, 1e6, 1.0, 0.0, 0.0)
"""A body far away. It fills the place of a body that other scenarios of the same batch have, but
this scenario lacks.
"""
Sampled = TypeVar("Sampled", FloatArray, BoolArray)
BESIDE_LEVEL = 1
"""Level of a body that moves beside the vehicle's path; the level of scenery is 0."""
IN_PATH = 2
"""Level of a body that is ever in the vehicle's path."""


class Moving(NamedTuple):
    """A body at T samples in M encounters. Columns have the shape (T or 1, M or 1): the length is 1
    along an axis along which the values do not vary.

    Attributes
    ----------
    track
        The body's track, with such columns.
    edge, far_end, half_length, half_width
        Positions along the lane of the body's rear and of its far end; half the body's extents
        along and across the lane [m]. If the body is rotated, but rather along than across the
        lane, `edge` is its first point in the vehicle's path.
    vx, vy, least_vx, most_vx
        Speeds along the lane and to the left of the lane; the least and the largest speed along the
        lane from this sample on [m/s].
    lateral, lateral_speed
        Position of the body's middle across the lane, negative on the side from which the body
        comes, and the rate of change of this position [m, m/s].
    is_there, is_in_path, is_cleared, is_avoidable
        Whether the body has a size; whether it is in the vehicle's path; whether it has left the
        path for good, or is gone for good; whether it has entered the path and is in it at the end,
        so that a vehicle that is never faster than the body again has avoided it.
    level
        `IN_PATH`, `BESIDE_LEVEL` (moves beside the path) or 0 (stands beside the path). Only the
        bodies with the highest level of an encounter count. Below 0 for a body that is never met.
    is_rotated, faces_along
        Whether the body is rotated against the lane at any sample; whether it faces along the lane
        at all samples.
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
        """Compute all quantities of a track with columns. `step` is the time between samples [s],
        `vehicle_width` the width of the vehicle under test [m].
        """
        cosine = np.abs(track.along)
        sine = np.abs(track.left)
        half_length = (track.length * cosine + track.width * sine) / 2
        half_width = (track.length * sine + track.width * cosine) / 2

        # The rear corner of a rotated body may be beside the path: the vehicle then touches the
        # body's first point within the path.
        edge = track.x - half_length
        is_rotated = np.minimum(cosine, sine) > LEAST_SINE
        is_lengthwise = is_rotated & (cosine > sine)
        if is_lengthwise.any():
            first_in_path = first_in_strip(track, vehicle_width / 2)
            edge = np.where(is_lengthwise, first_in_path, edge)

        vx = slim(track.speed * track.along)
        vy = slim(np.diff(track.y, axis=0, prepend=track.y[:1]) / step)
        is_there: BoolArray = slim((track.length > 0) | (track.width > 0))
        is_beside = np.abs(track.y) >= vehicle_width / 2 + half_width + TIE
        is_in_path = slim(is_there & ~is_beside & (track.kind != SCREEN))
        is_gone = ~_from_now_on(np.maximum, is_there)
        has_entered = np.maximum.accumulate(is_in_path, axis=0)
        will_touch = _from_now_on(np.maximum, is_in_path)

        # With this sign `lateral` rises while a body crosses, from whichever side it comes.
        sign = np.where((vy > 0).any(axis=0), 1.0, -1.0)
        moves = (is_there & (track.speed > 0)).any(axis=0)
        level_beside = np.where(moves, BESIDE_LEVEL, 0)
        level = np.where(is_in_path.any(axis=0), IN_PATH, level_beside)
        if track.kind == SCREEN:
            level = np.full_like(level, -1)
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
            level=level,
            is_rotated=bool(is_rotated.any()),
            faces_along=bool((cosine == 1).all()),
        )

    def covers(self, body: Moving) -> bool:
        """Whether another standing body is always inside this standing body: this body then hides
        everything that the other body hides.
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


def _from_now_on(ufunc: np.ufunc, column: Sampled) -> Sampled:
    """The least or largest value of a column from each sample to the last sample."""
    return ufunc.accumulate(column[::-1], axis=0)[::-1]


def slim(column: Sampled) -> Sampled:
    """The column with length 1 along each axis along which its values do not vary."""
    if len(column) > 1 and (column[1:] == column[:1]).all():
        column = column[:1]
    if column.shape[1] > 1 and (column[:, 1:] == column[:, :1]).all():
        column = column[:, :1]
    return column


def at_sample(column: Sampled, sample: int, group: IntArray | None) -> Sampled:
    """The values of a column at a sample: one for all vehicles, or one for each vehicle. `group`,
    shape (N,), has the number of each vehicle's encounter; None if columns need no index.
    """
    if len(column) == 1:
        sample = 0
    values: Sampled = column[sample]
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
    """The tracks of all bodies at K points, with columns for the N encounters of each point. Track
    b joins the b-th bodies of all points. `vehicle` is the vehicle under test at the start.

    Raises
    ------
    InputError
        If a body cannot move as its track says, or touches the vehicle at the start.
    """
    tracks_of_scenarios = [
        point.scenario.tracks_begun(times, point.phase * step)
        for point in points
        if isinstance(point.scenario, TrackScenario)
    ]
    for tracks in tracks_of_scenarios:
        check_shapes(tracks, len(times), n_encounters, step)
    tracks_of_bodies = zip_longest(*tracks_of_scenarios, fillvalue=FAR_BODY)
    width = n_encounters if len(points) > 1 else 1
    joined = [_joined(tracks, width) for tracks in tracks_of_bodies]
    for track in joined:
        check_motion(track, times, step)
    check_start(joined, vehicle)
    return joined


def _joined(tracks: Sequence[Track], width: int) -> Track:
    """Join the tracks of a body in K scenarios into one track, whose columns have at least `width`
    values for each scenario.
    """
    quantities = [track.quantities for track in tracks]
    columns = {}
    for name in FAR_BODY.quantities:
        parts = [
            np.atleast_2d(np.asarray(values[name], float)) for values in quantities
        ]
        length = max(len(part) for part in parts)
        widened = [
            np.broadcast_to(part, (length, max(width, part.shape[1]))) for part in parts
        ]
        columns[name] = slim(np.concatenate(widened, axis=1))
    body = next(track for track in tracks if track is not FAR_BODY)
    return Track(body.name, body.kind, **columns)
