"""A comparison as a flat scene in metres, turned so that the vehicle under test starts towards the right."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from safevar_sumo.records import FloatArray
from safevar_sumo.replay.comparison import Comparison, Film, LaneLine, Moments, find_moments
from safevar_sumo.scenarios import VUT

SEAM_WIDTH = 0.12
"""Width of the line between two lanes [m]."""
MARGIN = 4.0
"""Free space around the actors [m]."""
MIN_HEIGHT = 11.0
"""Smallest height of a view [m]."""
MAX_LENGTH = 75.0
"""Length up to which a scene is shown whole; in a longer scene the camera follows the vehicles [m]."""
CAMERA_LENGTH = 48.0
"""Length of road that a following camera shows [m]."""
MAX_DISTANCE = 30.0
"""Distance to the vehicle under test beyond which actors are not shown [m]."""
MARK_DISTANCE = 10
"""Distance between two marks beside the road [m]."""


class FlatBody(NamedTuple):
    """An actor of one simulation: front bumper or person's middle, x to the right and y up [m], heading [rad from x];
    shape (T,).
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


class View(NamedTuple):
    """The part of the road that is shown: its left end at every sample, shape (T,), its lower end, and its size [m]."""

    left_ends: FloatArray
    bottom: float
    width: float
    height: float


@dataclass(frozen=True)
class FlatScene:
    """A comparison laid out for drawing; `sample_count` samples, `step` seconds apart."""

    comparison: Comparison
    step: float
    sample_count: int
    road: tuple[LaneLine, ...]
    bodies: tuple[FlatBody, ...]
    moments: tuple[Moments, ...]
    view: View

    @property
    def key_sample(self) -> int:
        """The sample that a still picture shows: the moment at which the changed vehicle, or else the original, is
        nearest.
        """
        last = self.moments[-1]
        return last.nearest if last.nearest is not None else last.end

    def brakes(self, body: FlatBody, sample: int) -> bool:
        """Whether an actor is the vehicle under test and brakes; after the end of its run, whether it braked then."""
        now = min(sample, self.moments[body.row].end)
        return body.is_vut and bool(self.comparison.film.runs.trace.brake[now, body.row] > 0)

    def reading(self, row: int, sample: int) -> str:
        """Speed and gap of a vehicle, whether it brakes and, from the nearest moment on, how its run ends."""
        trace, moments = self.comparison.film.runs.trace, self.moments[row]
        now = min(sample, moments.end)
        is_finished = sample >= (moments.end if moments.nearest is None else moments.nearest)
        ending = self.comparison.verdict(row) if is_finished else "brakes" if trace.brake[now, row] > 0 else ""
        gap = f"gap {max(trace.gap[now, row], 0):.1f} m" if np.isfinite(trace.gap[now, row]) else ""
        return f"{trace.speed[now, row]:4.1f} m/s  {gap:10}  {ending}"

    @property
    def all_marks(self) -> list[int]:
        """The marks that ever come into view, by their distance from the start [m]."""
        left, right = float(self.view.left_ends.min()), float(self.view.left_ends.max()) + self.view.width
        return list(range(math.floor(left / MARK_DISTANCE) * MARK_DISTANCE, int(right) + MARK_DISTANCE, MARK_DISTANCE))


def lay_out_scene(comparison: Comparison) -> FlatScene:
    """Lay out a comparison for drawing."""
    film = comparison.film
    vut = film.tracks[VUT]
    turn = np.deg2rad(90 - vut.angle[0, 0])
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    start = np.array([vut.x[0, 0], vut.y[0, 0]])
    all_moments = tuple(find_moments(film.runs, row) for row in comparison.rows)
    sample_count = max(run_moments.end for run_moments in all_moments) + 1
    bodies = []
    for name, track in film.tracks.items():
        for row in comparison.rows:
            if _is_near(film, name, row):
                samples = np.minimum(np.arange(sample_count), all_moments[row].end)  # then the actor stays in place
                x, y = rotation @ (np.stack([track.x[samples, row], track.y[samples, row]]) - start[:, np.newaxis])
                heading = np.deg2rad(90 - track.angle[samples, row]) - turn
                body = FlatBody(name, row, name == VUT, track.is_person, track.length, track.width, x, y, heading)
                bodies.append(body)
    road = tuple(lane._replace(line=(lane.line - start) @ rotation.T) for lane in film.road)
    view = _choose_view(bodies, sample_count)
    return FlatScene(comparison, film.runs.trace.step, sample_count, road, tuple(bodies), all_moments, view)


def _is_near(film: Film, name: str, row: int) -> bool:
    """Whether an actor ever comes near the vehicle under test."""
    track, vut, end = film.tracks[name], film.tracks[VUT], film.last_samples[row] + 1
    distance = np.hypot(track.x[:end, row] - vut.x[:end, row], track.y[:end, row] - vut.y[:end, row])
    return bool(np.any(distance < MAX_DISTANCE + track.length))


def _choose_view(bodies: Sequence[FlatBody], sample_count: int) -> View:
    """The whole road or, in a long scene, the view of a camera that follows the vehicles."""
    left_end = min(float(np.nanmin(body.x)) - body.length for body in bodies) - MARGIN / 2
    right_end = max(float(np.nanmax(body.x)) + (0 if body.is_vut else body.length) for body in bodies) + MARGIN
    edges = [
        edge for body in bodies for edge in (np.nanmin(body.y) - body.width / 2, np.nanmax(body.y) + body.width / 2)
    ]
    bottom, top = float(min(edges)) - MARGIN / 2, float(max(edges)) + MARGIN / 2
    padding = max(0.0, MIN_HEIGHT - (top - bottom)) / 2
    if right_end - left_end <= MAX_LENGTH:
        return View(np.full(sample_count, left_end), bottom - padding, right_end - left_end, top - bottom + 2 * padding)
    front = np.mean([body.x for body in bodies if body.is_vut], axis=0)
    left = np.clip(front - CAMERA_LENGTH * 0.45, left_end, max(left_end, right_end - CAMERA_LENGTH))
    return View(left, bottom - padding, CAMERA_LENGTH, top - bottom + 2 * padding)


STRIPE_LENGTH = 0.5
"""Length of a crossing's stripes, and of the space between them [m]."""


def strip_corners(start: FloatArray, end: FloatArray, width: float) -> FloatArray:
    """The corners of a straight strip from start to end, shape (4, 2)."""
    direction = end - start
    half_width = np.array([-direction[1], direction[0]]) / (np.hypot(*direction) or 1.0) * width / 2
    return np.array([start + half_width, end + half_width, end - half_width, start - half_width])


def crossing_stripes(lane: LaneLine) -> Iterator[FloatArray]:
    """The stripes of a crossing, each of shape (4, 2)."""
    for start, end in pairwise(lane.line):
        direction = (end - start) / (np.hypot(*(end - start)) or 1.0)
        for distance in np.arange(STRIPE_LENGTH / 2, np.hypot(*(end - start)) - STRIPE_LENGTH, 2 * STRIPE_LENGTH):
            yield strip_corners(
                start + direction * distance, start + direction * (distance + STRIPE_LENGTH), lane.width
            )
