"""Checks of the bodies of a scenario, before any vehicle drives among them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial
from itertools import combinations

import numpy as np

from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.scenarios import VUT, Track
from safevar_sumo.scenarios.tracks import SCREEN, travelled
from safevar_sumo.sumo.bodies import TOUCH, Body, find_overlaps

MOST_SPEED = 100.0
"""Largest speed of a body [m/s]; a faster change of its place is a jump."""
UNIT_TOLERANCE = 1e-6
"""Largest difference of a direction's length from 1 [-]."""
WIDE_LANE = 4.0
"""Width of a wide lane [m]."""
LEAST_MISPLACEMENT = 1.0
"""Smallest distance of a body from the place where its speed takes it that can be an error [m]. The
distance is an error if it is more than this, and more than a third of the body's way.
"""
TRACKS_KEY = "scenario.model"
"""The key that errors name; the study stands before it."""


def check_shapes(
    tracks: Sequence[Track], n_samples: int, n_encounters: int, step: float
) -> None:
    """Refuse actors that share a name, and quantities that are neither numbers nor arrays with a
    value for each of the samples.

    Raises
    ------
    InputError
        With the actor, the time [s] and what is expected.
    """
    # The vehicle under test has a name, too.
    for name, count in Counter([VUT, *(track.name for track in tracks)]).items():
        if count > 1:
            raise InputError(
                "",
                f"{TRACKS_KEY}: at 0 s {count} actors are called {name!r}",
                "another name for each actor",
            )

    for track in tracks:
        for name, value in track.quantities.items():
            # A number or a single row has the same value at all samples.
            shape = (1, *np.shape(value))[-2:]
            if (
                np.ndim(value) > 2
                or shape[0] not in (1, n_samples)
                or shape[-1] not in (1, n_encounters)
            ):
                end = (
                    f" ends at {(shape[0] - 1) * step:g} s and"
                    if np.ndim(value) == 2
                    else ""
                )
                problem = (
                    f"actor {track.name!r}: {name}{end} has the shape {np.shape(value)}"
                )
                samples = (
                    f"({n_samples}, 1), a value for each time up to"
                    f" {(n_samples - 1) * step:g} s"
                )
                raise InputError(
                    "",
                    f"{TRACKS_KEY}: {problem}",
                    f"a number, or an array of the shape of `times`, {samples}",
                )


def check_motion(track: Track, times: FloatArray, step: float) -> None:
    """Refuse a body that jumps, that moves otherwise than its speed says, or that has illegal
    values (such as NaN, or a negative size) at one of T `times`, shape (T, 1).

    The quantities of the `track` are columns, as in `Moving`.

    Raises
    ------
    UserCodeError
        With the actor, the time [s] and what is expected.
    """
    refuse = partial(_refuse, track, step)
    for name, column in track.quantities.items():
        refuse(
            ~np.isfinite(column),
            column,
            f"has {name} = {{:g}}",
            "a finite number at every sample",
        )
    for name, column in (("length", track.length), ("width", track.width)):
        refuse(column < 0, column, f"has {name} = {{:g}} m", "a size of 0 m or more")
    speed = track.speed
    refuse(
        (speed < 0) | (speed > MOST_SPEED),
        speed,
        "has a speed of {:g} m/s",
        f"a speed from 0 to {MOST_SPEED:g} m/s",
    )
    norm = np.square(track.along) + np.square(track.left)
    refuse(
        np.abs(norm - 1) > UNIT_TOLERANCE,
        np.sqrt(norm),
        "has a direction of length {:g}",
        "a unit vector (along, left)",
    )

    for column in (track.x, track.y):
        jumps = np.diff(column, axis=0, prepend=column[:1]) / step
        refuse(
            np.abs(jumps) > MOST_SPEED,
            jumps,
            "jumps, at {:g} m/s",
            f"at most {MOST_SPEED:g} m/s between two samples",
        )

    # A body may face along the road while it changes lane: across the road, a lane's width and a
    # third of the whole way may differ.
    along = _way_and_driven(track, track.x, speed * track.along, times)
    across = _way_and_driven(track, track.y, speed * track.left, times)
    longer_along = np.maximum(*np.abs(along))
    longer_way = np.hypot(longer_along, np.maximum(*np.abs(across)))
    for (way, driven), axis, longer, least_difference in (
        (along, "x", longer_along, LEAST_MISPLACEMENT),
        (across, "y", longer_way, WIDE_LANE),
    ):
        refuse(
            np.abs(way - driven) > np.maximum(least_difference, longer / 3),
            way - driven,
            f"is {{:.3g}} m in {axis} from where its speed takes it",
            f"a place whose {axis} changes by v{axis}, the speed in {axis}, times the time",
        )


def _way_and_driven(
    track: Track, place: FloatArray, velocity: FloatArray, times: FloatArray
) -> FloatArray:
    """The way of a body by its places, and the way by its velocity, since its start [m]. A step
    counts if the body has a length at its beginning and its end.
    """
    is_there, place, velocity, _ = np.broadcast_arrays(
        track.length > 0, place, velocity, times
    )
    stays = is_there & np.vstack([is_there[:1], is_there[:-1]])
    ways = []
    for path in (place, travelled(velocity, times)):
        steps = np.diff(path, axis=0, prepend=path[:1])
        ways.append(np.cumsum(steps * stays, axis=0))
    return np.stack(ways)


def _refuse(
    track: Track,
    step: float,
    wrong: BoolArray,
    values: FloatArray,
    problem: str,
    expected: str,
) -> None:
    """Raise an error about the first sample at which `wrong` is true, if there is any."""
    if wrong.any():
        sample, column = np.argwhere(wrong)[0].tolist()
        text = problem.format(float(values[sample, column]))
        raise UserCodeError(
            "",
            f"{TRACKS_KEY}: at {sample * step:g} s actor {track.name!r} {text}",
            expected,
        )


def check_start(tracks: Sequence[Track], vehicle: Body) -> None:
    """Refuse bodies that are inside each other, or inside the vehicle under test, at the start. The
    quantities of the `tracks` are columns, as in `Moving`.

    Raises
    ------
    InputError
        With the actors, the time [s] and what is expected.
    """
    bodies = {}
    for track in tracks:
        if track.kind != SCREEN:
            bodies[f"actor {track.name!r}"] = _first(track)
    bodies["the vehicle under test"] = vehicle
    for (name, body), (obstacle_name, obstacle) in combinations(bodies.items(), 2):
        # A body without a size is not there (yet): it can overlap nothing.
        is_there = body.length + body.width > 0
        has_obstacle = obstacle.length + obstacle.width > 0
        overlaps = find_overlaps(body, obstacle)
        depth = np.where(is_there & has_obstacle, overlaps, 0.0).max()
        if depth > TOUCH:
            problem = f"at 0 s {name} is {depth:.2f} m inside {obstacle_name}"
            raise InputError(
                "",
                f"{TRACKS_KEY}: {problem}",
                "bodies that do not overlap at the start",
            )


def _first(track: Track) -> Body:
    """A body at the first sample of M encounters, in columns."""
    length, width, x, y, cosine, sine, speed = np.broadcast_arrays(
        *(column[0] for column in track.quantities.values())
    )
    along = np.stack([cosine, sine], axis=1)
    return Body(np.stack([x, y], axis=1), along, length, width, speed)
