"""A scenario that a file of OpenSCENARIO describes; the vehicle under test is its Ego."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.openscenario import EVERY, STEP, Moved, Played, play, text_of
from safevar_sumo.output import file_beside
from safevar_sumo.records import FloatArray, IntArray, Quantity
from safevar_sumo.scenarios.base import XmlChanges, as_text
from safevar_sumo.scenarios.roads import Roads
from safevar_sumo.scenarios.tracks import VUT_LENGTH, VUT_WIDTH, Track, TrackScenario
from safevar_sumo.study import FreeParameter

WIDEST = 1e9
"""Largest size of a parameter of a file, which says itself what it allows."""
AWAY_SPEED = 90.0
"""Speed at which a deleted entity, a point without size, leaves the scene to the left [m/s]."""
LANE_LENGTH = 4000.0
"""Length of the lane of the network `along` [m]."""
SAME = 1e-6
"""Difference of two samples' numbers up to which they are one [-]."""
DIGITS = 9
"""Decimals of the places in tracks [m]: the last bits of a sine differ between machines."""


class OpenScenario(TrackScenario):
    """A file of OpenSCENARIO XML with values of its parameters: what moves in it, around its Ego.

    Parameters
    ----------
    file
        Path of a concrete file.
    ego
        The name of the vehicle under test in it.
    values
        Values of the file's parameters by name, numbers or texts, or arrays of N numbers.
    """

    goes_on = False  # the file says when it ends
    has_phase = False  # its storyboard and its Ego's profile run on the clock of the simulation

    def __init__(self, file: str, ego: str = "Ego", **values: Quantity | str) -> None:
        self.name = file
        self.file = os.path.abspath(file)
        self.ego = ego
        self.values = values

    def __eq__(self, other: object) -> bool:
        return isinstance(other, OpenScenario) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def _key(self) -> tuple[object, ...]:
        values = {
            name: value.tobytes() if isinstance(value, np.ndarray) else value
            for name, value in self.values.items()
        }
        return self.file, self.ego, repr(values)

    def free(self) -> Mapping[str, FreeParameter]:
        """Every number among the file's parameters may be searched; a file states no units."""
        return {
            name: FreeParameter(lower=-WIDEST, upper=WIDEST, unit="", meaning=name)
            for name in self._scenes[0].numbers
        }

    def at(self, values: Mapping[str, Quantity]) -> OpenScenario:
        """The file at other values of its parameters."""
        return OpenScenario(self.file, self.ego, **{**self.values, **values})

    @cached_property
    def _different(self) -> tuple[list[Mapping[str, Any]], IntArray]:
        """The values of all different encounters, and the number of those of each of N
        encounters.
        """
        arrays = {name: value for name, value in self.values.items() if np.ndim(value)}
        if not arrays:
            return [self.values], np.zeros(1, dtype=int)
        rows, which = np.unique(np.stack([*arrays.values()], axis=1), axis=0, return_inverse=True)
        return [{**self.values, **dict(zip(arrays, row, strict=True))} for row in rows], np.reshape(
            which, -1
        )

    @cached_property
    def _scenes(self) -> list[Played]:
        """The scenes of all different encounters."""
        return self._played(EVERY)

    def _played(self, every: int) -> list[Played]:
        try:
            found = [
                play(
                    self.file,
                    {name: text_of(value) for name, value in values.items()},
                    self.ego,
                    every,
                )
                for values in self._different[0]
            ]
        except InputError as error:
            name = os.path.basename(self.file)
            raise InputError(
                "", f"scenario.file = {name!r}: {error.problem}", error.legal
            ) from None
        if len({scene.ego for scene in found}) > 1:
            problem = f"the body of {self.ego} depends on a searched parameter"
            raise InputError("over", problem, "values of it in the matrix")
        return found

    def __getstate__(self) -> dict[str, Any]:
        return {
            key: value
            for key, value in self.__dict__.items()
            if key not in ("_different", "_scenes")
        }

    def _of_scenes(self, values: Sequence[float]) -> Quantity:
        """A number, or an array for N encounters."""
        is_searched = any(np.ndim(value) for value in self.values.values())
        return np.array(values)[self._different[1]] if is_searched else values[0]

    @property
    def duration(self) -> Quantity:
        """Length of a run [s]."""
        return self._of_scenes([scene.duration for scene in self._scenes])

    @property
    def test_speed(self) -> Quantity:
        """The speed that Ego holds, and the vehicle under test until its driving system acts
        [m/s].
        """
        return self._of_scenes([scene.speed for scene in self._scenes])

    @property
    def start_speed(self) -> Quantity:
        """The speed of Ego at the start [m/s]."""
        return self.profile_speed(0.0)

    @property
    def profile_until(self) -> Quantity:
        """The time until which a robot drives Ego's own speeds [s]."""
        return self._of_scenes([(len(one.profile) - 1) * STEP for one in self._scenes])

    @property
    def profile_highest(self) -> Quantity:
        """The highest of Ego's own speeds [m/s]."""
        return self._of_scenes([float(one.profile.max()) for one in self._scenes])

    def profile_speed(self, time: float) -> Quantity:
        """Ego's own speed at a time [m/s], and after its profile the one that it holds."""
        return self._of_scenes(
            [
                float(np.interp(time / STEP, np.arange(len(one.profile)), one.profile))
                for one in self._scenes
            ]
        )

    @property
    def depends_until(self) -> Quantity:
        """The time until which motions depend on an Ego that holds its speed [s]."""
        return self._of_scenes([scene.depends_until for scene in self._scenes])

    @property
    def vut_length(self) -> float:
        """Length of Ego [m]."""
        return self._scenes[0].ego.length

    @property
    def vut_width(self) -> float:
        """Width of Ego [m]."""
        return self._scenes[0].ego.width

    @property
    def is_hit_in_front(self) -> bool:
        """Every contact is a collision."""
        return False

    @property
    def dependence(self) -> str:
        """What depends on Ego, and until when."""
        played = self._scenes[0]
        return (
            f"{played.dependence} at {played.depends_until:.1f} s depends on an Ego that keeps its"
            " speed"
        )

    @property
    def uneventful(self) -> str:
        """Why nothing happens to an Ego that keeps its speed."""
        return self._scenes[0].uneventful

    @property
    def is_uneventful(self) -> Quantity | bool:
        """In which of N searched encounters nothing happens to an Ego that keeps its speed, shape
        (N,).
        """
        are_uneventful = self._of_scenes([bool(scene.uneventful) for scene in self._scenes])
        return are_uneventful if np.ndim(are_uneventful) else False

    def read_files(self, folders: Sequence[str]) -> None:
        """The file, which is refused if it has what nobody can play."""
        self.file = file_beside(self.name, folders) or self.file
        self.remarks()

    def remarks(self) -> list[str]:
        """What of the file has no effect here, or never happens, and that the vehicle has Ego's
        body.
        """
        played = self._scenes[0]
        car = f"{VUT_LENGTH:.2f} m x {VUT_WIDTH:.2f} m"
        body = f"{played.ego.length:.2f} m x {played.ego.width:.2f} m"
        differs = (
            []
            if body == car
            else [f"the vehicle has {self.ego}'s body, {body}, not that of other tests, {car}"]
        )
        return [*played.remarks, *differs]

    def lanes(self, roads: Roads) -> XmlChanges:
        """A longer lane in SUMO for a long scene."""
        way = float(np.max(self.profile_highest) * np.max(self.duration))
        if way < LANE_LENGTH / 2:
            return {}
        end = as_text(LANE_LENGTH + way)
        return {"edge/lane[@id='road_0']": {"length": end, "shape": f"0,-1.75 {end},-1.75"}}

    def tracks(self, times: FloatArray) -> list[Track]:
        """All entities but Ego; beyond the end of the scene they go on as they move there."""
        samples = times[:, 0] / STEP
        are_kept = np.abs(samples / EVERY - np.round(samples / EVERY)).max() < SAME
        every = EVERY if are_kept else 1
        scenes = self._scenes if are_kept else self._played(every)
        return [
            self._track(scenes, [scene.others[number] for scene in scenes], samples, every)
            for number in range(len(scenes[0].others))
        ]

    def _track(
        self, scenes: Sequence[Played], bodies: Sequence[Moved], samples: FloatArray, every: int
    ) -> Track:
        # One body of the same size in all encounters.
        name = bodies[0].name
        shape = bodies[0].shape
        if len({(body.name, body.shape.length, body.shape.width) for body in bodies}) > 1:
            problem = f"the body of {name} depends on a searched parameter"
            raise InputError("over", problem, "values of it in the matrix")

        # Places relative to where Ego starts, along its direction.
        place, facing, speed = (
            np.stack([_sampled(getattr(body, column), samples / every) for body in bodies], axis=1)
            for column in ("place", "facing", "speed")
        )
        ahead = np.array([scene.start.facing for scene in scenes])
        place = np.round((place - [scene.start.place for scene in scenes]) / ahead, DIGITS)
        facing = np.round(facing / ahead, DIGITS + 3)

        # At the end of its scene it goes on straight.
        beyond = np.maximum(
            samples[:, np.newaxis] - [every * (len(body.speed) - 1) for body in bodies], 0.0
        )
        facing = facing / np.abs(facing)
        place = place + beyond * STEP * speed * facing

        # A deleted body has no size and moves away.
        which = self._different[1]
        length: Quantity = shape.length
        width: Quantity = shape.width
        deleted = np.array([body.deleted for body in bodies])
        gone = np.maximum(samples[:, np.newaxis] * STEP - deleted, 0.0)
        if gone.any():
            length, width = (np.where(gone > 0, 0.0, size)[:, which] for size in (length, width))
        y = place.imag + AWAY_SPEED * gone
        columns = (column[:, which] for column in (place.real, y, facing.real, facing.imag, speed))
        return Track(name, shape.kind, length, width, *columns)


def _sampled(column: Any, samples: FloatArray) -> Any:
    """A column at fractions of samples, linear in between."""
    last = len(column) - 1
    whole = np.floor(samples + SAME)
    below = np.minimum(whole.astype(int), last)
    share = samples - whole
    if (share < SAME).all():
        return column[below]
    return column[below] + share * (column[np.minimum(below + 1, last)] - column[below])
