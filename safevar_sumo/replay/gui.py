"""A comparison in sumo-gui: the original's road above and the changed vehicle's road below, at the same time."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from safevar_sumo.replay.animation import ACTOR_COLOUR, PERSON_COLOUR, VEHICLE_COLOURS, crossing_stripes, strip_corners
from safevar_sumo.replay.comparison import CHANGED, ORIGINAL, Comparison
from safevar_sumo.replay.film import LaneLine
from safevar_sumo.replay.scene import FlatScene, lay_out_scene
from safevar_sumo.replay.window import ActorPose, Colour, Window, open_window
from safevar_sumo.scenarios import VUT

COLOUR_NAMES = {ORIGINAL: "blue", CHANGED: "orange"}
PAUSE = 2.0
"""Pause at the nearest moment and at the end [s]."""
ROAD_SPACING = 5.0
"""Space between the two roads [m]."""
ROAD_COLOUR, PATH_COLOUR, WHITE = (154, 161, 169, 255), (207, 211, 207, 255), (255, 255, 255, 255)
LEGEND_HEIGHT = 1.8
"""Height of the legend above the lower edge of the view [m]."""


def show_in_gui(comparison: Comparison, *, slower: float = 1.0, rest: float = PAUSE, pictures: Path | None = None) -> None:
    """Play a comparison in SUMO's own window, with pauses at the nearest moments and at the end.

    Parameters
    ----------
    slower
        Factor by which to play slower than real time.
    rest
        Duration of each pause [s].
    pictures
        Folder for pictures of the window at every pause; no pictures by default.

    Raises
    ------
    InputError, SimulationError
        If `replay.window.open_window` raises it.
    """
    scene = lay_out_scene(comparison)
    layout = _Layout(scene)
    with open_window(comparison.network, scene.step) as window:
        for row in comparison.rows:
            _add_road_and_actors(window, scene, row, layout)
        pauses = {moments.nearest for moments in scene.moments if moments.nearest is not None} | {scene.sample_count - 1}
        start = time.monotonic()
        for sample in range(scene.sample_count):
            _show_sample(window, scene, sample, layout)
            if sample in pauses:
                if pictures is not None:
                    window.save_picture(pictures / f"{sample:04d}.png")
                time.sleep(rest)
                start += rest
            time.sleep(max(0.0, start + (sample + 1) * scene.step * slower - time.monotonic()))


class _Layout:
    """Positions of the roads in the window: the changed vehicle's road lies below the original's road by the height of the view."""

    def __init__(self, scene: FlatScene) -> None:
        self._road_distance = scene.view.height + ROAD_SPACING
        track = scene.comparison.film.tracks[VUT]
        heading = np.deg2rad(90 - track.angle[0, 0])
        self._rightward = np.array([np.sin(heading), -np.cos(heading)])

    def offset(self, row: int) -> np.ndarray:
        """Offset of a row's road, shape (2,) [m]."""
        return self._rightward * self._road_distance * (row == CHANGED)


def _add_road_and_actors(window: Window, scene: FlatScene, row: int, layout: _Layout) -> None:
    """Add the actors of a row, and the changed vehicle's road: SUMO draws only the original's road."""
    film = scene.comparison.film
    if row == CHANGED:
        for i, lane in enumerate(film.road):
            for j, points in enumerate(_lane_outlines(lane)):
                outline = _point_pairs(points + layout.offset(row))
                window.paint(f"road.{i}.{j}", outline, _colour_of(lane), layer=2 if lane.kind == "crossing" else 0)
    for name, track in film.tracks.items():
        colour = _rgba(VEHICLE_COLOURS[row] if name == VUT else PERSON_COLOUR if track.is_person else ACTOR_COLOUR)
        window.add(_actor_id(row, name), track.is_person, track.length, track.width, colour)


def _show_sample(window: Window, scene: FlatScene, sample: int, layout: _Layout) -> None:
    """Show one sample: the camera, the actors' poses, the legend."""
    comparison, poses = scene.comparison, []
    film = comparison.film
    corners = []
    for row in comparison.rows:
        offset, run_sample = layout.offset(row), min(sample, scene.moments[row].end)
        for name, track in film.tracks.items():
            x, y = float(track.x[run_sample, row]), float(track.y[run_sample, row])
            if not np.isnan(x):
                brakes = name == VUT and bool(film.runs.trace.brake[run_sample, row] > 0)
                angle = float(track.angle[run_sample, row])
                poses.append(ActorPose(_actor_id(row, name), x + float(offset[0]), y + float(offset[1]), angle, brakes))
        view_corners = _view_corners(scene, sample) + offset
        corners.append(view_corners)
        legend = f"{comparison.name(row)} ({COLOUR_NAMES[row]}): {film.runs.trace.speed[run_sample, row]:.1f} m/s"
        is_finished = sample >= (scene.moments[row].end if scene.moments[row].nearest is None else int(scene.moments[row].nearest or 0))
        middle = view_corners.mean(axis=0)
        window.write(f"legend.{row}", float(middle[0]), float(view_corners[:, 1].min()) + LEGEND_HEIGHT,
                     f"{legend}, {comparison.verdict(row)}" if is_finished else f"{legend}, {sample * scene.step:.2f} s")
    all_corners = np.concatenate(corners)
    window.set_view(*(float(value) for value in (*all_corners.min(axis=0), *all_corners.max(axis=0))))
    window.show(poses)


def _view_corners(scene: FlatScene, sample: int) -> np.ndarray:
    """The corners of a scene's view, in the film's plane; shape (4, 2)."""
    view, track = scene.view, scene.comparison.film.tracks[VUT]
    heading = np.deg2rad(90 - track.angle[0, 0])
    forward, leftward = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    start = np.array([track.x[0, 0], track.y[0, 0]])
    return np.array([start + forward * x + leftward * y for x in (view.left_ends[sample], view.left_ends[sample] + view.width)
                     for y in (view.bottom, view.bottom + view.height)])


def _lane_outlines(lane: LaneLine) -> Sequence[np.ndarray]:
    if lane.kind == "area":
        return [lane.line]
    if lane.kind == "crossing":
        return list(crossing_stripes(lane))
    return [strip_corners(start, end, lane.width - 0.1) for start, end in zip(lane.line[:-1], lane.line[1:], strict=True)]


def _colour_of(lane: LaneLine) -> Colour:
    return {"road": ROAD_COLOUR, "crossing": WHITE}.get(lane.kind, PATH_COLOUR)


def _point_pairs(points: np.ndarray) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in points]


def _rgba(colour: str) -> Colour:
    red, green, blue = (int(colour[i:i + 2], 16) for i in (1, 3, 5))
    return red, green, blue, 255


def _actor_id(row: int, name: str) -> str:
    return f"{'original' if row == ORIGINAL else 'changed'}.{name}"


