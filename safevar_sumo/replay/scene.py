"""A comparison as a flat scene in metres, turned so that the vehicle under test starts towards the right."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from safevar_sumo.records import FloatArray
from safevar_sumo.replay.comparison import CHANGED, Comparison, Moments, find_moments
from safevar_sumo.replay.film import ActorTrack, Film, LaneLine
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
MAX_OFFSET = 0.05
"""Distance below which two copies of an actor are drawn as one [m]."""


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


@dataclass(frozen=True, kw_only=True)
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
    bodies = tuple(
        _lay_out_body(name, track, row, all_moments[row].end, sample_count, rotation, start, turn)
        for name, track in film.tracks.items()
        for row in comparison.rows
        if name == VUT or (_is_near(film, name, row) and not _is_duplicate(comparison, name, row))
    )
    road = tuple(lane._replace(line=(lane.line - start) @ rotation.T) for lane in film.road)
    return FlatScene(
        comparison=comparison,
        step=film.runs.trace.step,
        sample_count=sample_count,
        road=road,
        bodies=bodies,
        moments=all_moments,
        view=_choose_view(bodies, sample_count),
    )


def _lay_out_body(
    name: str,
    track: ActorTrack,
    row: int,
    end: int,
    sample_count: int,
    rotation: FloatArray,
    start: FloatArray,
    turn: float,
) -> FlatBody:
    """An actor until its simulation ends; afterwards the actor stays in place."""
    samples = np.minimum(np.arange(sample_count), end)
    x, y = rotation @ (np.stack([track.x[samples, row], track.y[samples, row]]) - start[:, np.newaxis])
    return FlatBody(
        name=name,
        row=row,
        is_vut=name == VUT,
        is_person=track.is_person,
        length=track.length,
        width=track.width,
        x=x,
        y=y,
        heading=np.deg2rad(90 - track.angle[samples, row]) - turn,
    )


def _is_near(film: Film, name: str, row: int) -> bool:
    """Whether an actor ever comes near the vehicle under test."""
    track, vut, end = film.tracks[name], film.tracks[VUT], film.last_samples[row] + 1
    distance = np.hypot(track.x[:end, row] - vut.x[:end, row], track.y[:end, row] - vut.y[:end, row])
    return bool(np.any(distance < MAX_DISTANCE + track.length))


def _is_duplicate(comparison: Comparison, name: str, row: int) -> bool:
    """Whether the changed vehicle's copy of an actor is always at the same position, so that only this copy is
    drawn.
    """
    if row == CHANGED or len(comparison.rows) == 1:
        return False
    track, end = comparison.film.tracks[name], int(comparison.film.last_samples.min()) + 1
    offset = np.hypot(track.x[:end, 0] - track.x[:end, CHANGED], track.y[:end, 0] - track.y[:end, CHANGED])
    return _is_near(comparison.film, name, CHANGED) and bool(np.all((offset < MAX_OFFSET) | np.isnan(offset)))


def _choose_view(bodies: tuple[FlatBody, ...], sample_count: int) -> View:
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
