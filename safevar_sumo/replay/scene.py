"""A comparison as a flat scene in metres, turned so that the vehicle under test starts towards the
right.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from safevar_sumo.records import FloatArray
from safevar_sumo.replay.comparison import Comparison, DrawnLane
from safevar_sumo.scenarios import VUT

SEAM_WIDTH = 0.12
"""Width of the line between two lanes [m]."""
MARGIN = 4.0
"""Free space around the actors [m]."""
MIN_HEIGHT = 11.0
"""Smallest height of a view [m]."""
MAX_LENGTH = 75.0
"""Length up to which a scene is shown whole; in a longer scene the camera follows the vehicles [m].
"""
CAMERA_LENGTH = 48.0
"""Length of road that a following camera shows [m]."""
CAMERA_LEAD = 0.45
"""Part of this length behind the front bumpers of the vehicles under test [-]."""
MAX_DISTANCE = 30.0
"""Distance to the vehicle under test beyond which actors are not shown [m]."""
MARK_DISTANCE = 10
"""Distance between two marks beside the road [m]."""
STRIPE_LENGTH = 0.5
"""Length of a crossing's stripes, and of the space between them [m]."""
LANE_KINDS = ("area", "path", "road", "crossing")
"""Kinds of lanes in the order in which they are drawn."""


class FlatBody(NamedTuple):
    """An actor of one simulation: front bumper or person's middle, x to the right and y up [m],
    heading [rad from x]; shape (T,).
    """

    name: str
    row: int
    is_vut: bool
    is_person: bool
    length: float
    width: float
    x: FloatArray
    y: FloatArray
    heading: FloatArray


@dataclass(frozen=True)
class FlatScene:
    """A comparison laid out for drawing; `sample_count` samples, `step` seconds apart.

    The lanes and bodies are in the order in which they are drawn. The part of the road that is
    shown has its left end at `left_ends`, shape (T,), its lower end at `bottom`, and the size
    `width` by `height` [m].
    """

    comparison: Comparison
    step: float
    sample_count: int
    road: tuple[DrawnLane, ...]
    bodies: tuple[FlatBody, ...]
    left_ends: FloatArray
    bottom: float
    width: float
    height: float

    @property
    def key_sample(self) -> int:
        """The sample that a still picture shows: the moment at which the changed vehicle, or else
        the original, is nearest.
        """
        return self.comparison.moments[-1].decided

    def brakes(self, body: FlatBody, sample: int) -> bool:
        """Whether an actor is the vehicle under test and brakes; after the end of its run, whether
        it braked then.
        """
        last_sample = self.comparison.moments[body.row].end
        return body.is_vut and bool(
            self.comparison.runs.trace.brake[min(sample, last_sample), body.row] > 0
        )

    def reading(self, row: int, sample: int) -> str:
        """Speed and gap of a vehicle, whether it brakes and, from the nearest moment on, how its
        run ends.
        """
        trace = self.comparison.runs.trace
        moments = self.comparison.moments[row]
        shown = min(sample, moments.end)
        ending = "brakes" if trace.brake[shown, row] > 0 else ""
        if sample >= moments.decided:
            ending = self.comparison.verdict(row)
        gap = (
            f"gap {max(trace.gap[shown, row], 0):.1f} m"
            if np.isfinite(trace.gap[shown, row])
            else ""
        )
        return f"{trace.speed[shown, row]:4.1f} m/s  {gap:10}  {ending}"

    @property
    def all_marks(self) -> list[int]:
        """The marks that ever come into view, by their distance from the start [m]."""
        first = math.floor(self.left_ends.min() / MARK_DISTANCE) * MARK_DISTANCE
        return list(
            range(first, int(self.left_ends.max() + self.width) + MARK_DISTANCE, MARK_DISTANCE)
        )


def lay_out_scene(comparison: Comparison) -> FlatScene:
    """Lay out a comparison for drawing, with the actors that ever come near the vehicle under
    test.
    """
    # Seen along the direction in which the vehicle under test starts.
    vut = comparison.tracks[VUT]
    turn = vut.heading[0, 0]
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    start = np.array([vut.x[0, 0], vut.y[0, 0]])
    sample_count = max(moments.end for moments in comparison.moments) + 1

    # Bodies that ever come near it.
    bodies = []
    for name, track in comparison.tracks.items():
        for row, moments in enumerate(comparison.moments):
            samples = np.minimum(
                np.arange(sample_count), moments.end
            )  # then the actor stays in place
            track_x = track.x[samples, row]
            track_y = track.y[samples, row]
            distance = np.hypot(track_x - vut.x[samples, row], track_y - vut.y[samples, row])
            if np.any(distance < MAX_DISTANCE + track.length):
                x, y = rotation @ (np.stack([track_x, track_y]) - start[:, np.newaxis])
                body = FlatBody(
                    name,
                    row,
                    name == VUT,
                    track.is_person,
                    track.length,
                    track.width,
                    x,
                    y,
                    track.heading[samples, row] - turn,
                )
                bodies.append(body)

    # The road in the same coordinates.
    lanes = (lane._replace(line=(lane.line - start) @ rotation.T) for lane in comparison.road)
    road = sorted(lanes, key=lambda lane: LANE_KINDS.index(lane.kind))
    view = _choose_view(bodies, sample_count)
    bodies.sort(key=lambda body: (body.is_vut, body.row))
    return FlatScene(
        comparison, comparison.runs.trace.step, sample_count, tuple(road), tuple(bodies), *view
    )


class _View(NamedTuple):
    """The part of the road that is shown, as `FlatScene` names it."""

    left_ends: FloatArray
    bottom: float
    width: float
    height: float


def _choose_view(bodies: Sequence[FlatBody], sample_count: int) -> _View:
    """The whole road or, in a long scene, what a camera that follows the vehicles shows."""
    # A frame around all bodies.
    x, y = (np.array([getattr(body, axis) for body in bodies]) for axis in "xy")
    is_vut = np.array([body.is_vut for body in bodies])
    length, half_width = np.array([(body.length, body.width / 2) for body in bodies]).T[
        :, :, np.newaxis
    ]
    left_end = float(np.nanmin(x - length)) - MARGIN / 2
    right_end = float(np.nanmax(x + np.where(is_vut[:, np.newaxis], 0, length))) + MARGIN
    bottom = float(np.nanmin(y - half_width)) - MARGIN / 2
    height = float(np.nanmax(y + half_width)) + MARGIN / 2 - bottom
    padding = max(0.0, MIN_HEIGHT - height) / 2

    # A long scene is followed by a camera.
    left_ends = np.full(sample_count, left_end)
    width = right_end - left_end
    if width > MAX_LENGTH:
        width = CAMERA_LENGTH
        left_ends = np.clip(
            x[is_vut].mean(axis=0) - width * CAMERA_LEAD, left_end, max(left_end, right_end - width)
        )
    return _View(left_ends, bottom - padding, width, height + 2 * padding)


def strip_corners(start: FloatArray, end: FloatArray, width: float) -> FloatArray:
    """The corners of a straight strip from start to end, shape (4, 2)."""
    direction = end - start
    half_width = np.array([-direction[1], direction[0]]) / (np.hypot(*direction) or 1.0) * width / 2
    return np.array([start + half_width, end + half_width, end - half_width, start - half_width])


def lane_outlines(lane: DrawnLane, width: float) -> Iterator[FloatArray]:
    """Polygons that show a lane, shape (P, 2) each: an area, the stripes of a crossing, or strips
    of this width [m].
    """
    if lane.kind == "area":
        yield lane.line
        return
    for start, end in pairwise(lane.line):
        if lane.kind != "crossing":
            yield strip_corners(start, end, width)
            continue
        length = np.hypot(*(end - start))
        stripe = (end - start) / (length or 1.0) * STRIPE_LENGTH
        for distance in np.arange(STRIPE_LENGTH / 2, length - STRIPE_LENGTH, 2 * STRIPE_LENGTH):
            corner = start + stripe * (distance / STRIPE_LENGTH)
            yield strip_corners(corner, corner + stripe, lane.width)
