"""A comparison in sumo-gui: the original's road above, the changed vehicle's below, both at the same moment."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from safevar_sumo.replay.animation import OTHER, PERSON, VEHICLES, quad, stripes
from safevar_sumo.replay.comparison import CHANGED, ORIGINAL, Comparison
from safevar_sumo.replay.film import Lane
from safevar_sumo.replay.scene import FlatScene, scene_of
from safevar_sumo.replay.window import Colour, Place, Window, open_window
from safevar_sumo.scenarios import VUT

NAMES = {ORIGINAL: "blue", CHANGED: "orange"}
REST = 2.0
"""Pause at the nearest moment and at the end [s]."""
SPACE = 5.0
"""Between the two roads [m]."""
ROAD, PATH, WHITE = (154, 161, 169, 255), (207, 211, 207, 255), (255, 255, 255, 255)
ASIDE = 1.8
"""Height of the legend above the lower edge of the view [m]."""


def show_in_gui(comparison: Comparison, network: str | None = None, *, slower: float = 1.0, rest: float = REST,
                pictures: Path | None = None) -> None:
    """Play a comparison in SUMO's own window, rest at the nearest moments and at the end.

    Parameters
    ----------
    network
        The network to play it on, by default the comparison's own.
    slower
        So many times slower than real time.
    rest
        How long each rest takes [s].
    pictures
        A folder for pictures of the window at every rest, if they are wanted.

    Raises
    ------
    InputError, SimulationError
        As `simulation.window.open_window`.
    """
    scene = scene_of(comparison)
    turn = _Turn(scene)
    with open_window(network or comparison.network, scene.step) as window:
        for row in comparison.rows:
            _furnish(window, scene, row, turn)
        rests = {one.nearest for one in scene.moments if one.nearest is not None} | {scene.length - 1}
        begun = time.monotonic()
        for sample in range(scene.length):
            _show(window, scene, sample, turn)
            if sample in rests:
                if pictures is not None:
                    window.picture(pictures / f"{sample:04d}.png")
                time.sleep(rest)
                begun += rest
            time.sleep(max(0.0, begun + (sample + 1) * scene.step * slower - time.monotonic()))


class _Turn:
    """From a comparison's film to the window: the changed vehicle's road lies below, by the height of what is shown."""

    def __init__(self, scene: FlatScene) -> None:
        self._below = scene.view.height + SPACE
        track = scene.comparison.film.tracks[VUT]
        heading = np.deg2rad(90 - track.angle[0, 0])
        self._side = np.array([np.sin(heading), -np.cos(heading)])

    def offset(self, row: int) -> np.ndarray:
        """By how much a row's road is put aside, shape (2,) [m]."""
        return self._side * self._below * (row == CHANGED)


def _furnish(window: Window, scene: FlatScene, row: int, turn: _Turn) -> None:
    """The road of a row, if SUMO does not draw it, and its actors."""
    film = scene.comparison.film
    if row == CHANGED:
        for i, lane in enumerate(film.road):
            for j, points in enumerate(_areas(lane)):
                window.paint(f"road.{i}.{j}", _points(points + turn.offset(row)), _colour_of(lane), 2 if lane.kind == "crossing" else 0)
    for name, track in film.tracks.items():
        colour = _rgba(VEHICLES[row] if name == VUT else PERSON if track.is_person else OTHER)
        window.add(_id(row, name), track.is_person, track.length, track.width, colour)


def _show(window: Window, scene: FlatScene, sample: int, turn: _Turn) -> None:
    """One sample: the camera, everybody's place, the legend."""
    comparison, places = scene.comparison, []
    film = comparison.film
    corners = []
    for row in comparison.rows:
        aside, at = turn.offset(row), min(sample, scene.moments[row].end)
        for name, track in film.tracks.items():
            x, y = float(track.x[at, row]), float(track.y[at, row])
            if not np.isnan(x):
                brakes = name == VUT and bool(film.drives.trace.brake[at, row] > 0)
                places.append(Place(_id(row, name), x + float(aside[0]), y + float(aside[1]), float(track.angle[at, row]), brakes))
        frame = _frame(scene, sample) + aside
        corners.append(frame)
        words = f"{comparison.name(row)} ({NAMES[row]}): {film.drives.trace.speed[at, row]:.1f} m/s"
        over = sample >= (scene.moments[row].end if scene.moments[row].nearest is None else int(scene.moments[row].nearest or 0))
        middle = frame.mean(axis=0)
        window.write(f"legend.{row}", float(middle[0]), float(frame[:, 1].min()) + ASIDE,
                     f"{words}, {comparison.verdict(row)}" if over else f"{words}, {sample * scene.step:.2f} s")
    everything = np.concatenate(corners)
    window.look(*(float(value) for value in (*everything.min(axis=0), *everything.max(axis=0))))
    window.show(places)


def _frame(scene: FlatScene, sample: int) -> np.ndarray:
    """The corners of what a scene shows, in the film's plane; shape (4, 2)."""
    view, track = scene.view, scene.comparison.film.tracks[VUT]
    heading = np.deg2rad(90 - track.angle[0, 0])
    along, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    start = np.array([track.x[0, 0], track.y[0, 0]])
    return np.array([start + along * x + left * y for x in (view.left[sample], view.left[sample] + view.width)
                     for y in (view.bottom, view.bottom + view.height)])


def _areas(lane: Lane) -> Sequence[np.ndarray]:
    if lane.kind == "area":
        return [lane.line]
    if lane.kind == "crossing":
        return list(stripes(lane))
    return [quad(start, end, lane.width - 0.1) for start, end in zip(lane.line[:-1], lane.line[1:], strict=True)]


def _colour_of(lane: Lane) -> Colour:
    return {"road": ROAD, "crossing": WHITE}.get(lane.kind, PATH)


def _points(points: np.ndarray) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in points]


def _rgba(colour: str) -> Colour:
    red, green, blue = (int(colour[i:i + 2], 16) for i in (1, 3, 5))
    return red, green, blue, 255


def _id(row: int, name: str) -> str:
    return f"{'original' if row == ORIGINAL else 'changed'}.{name}"


