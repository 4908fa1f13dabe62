"""Vehicles in many recorded scenes of one road whose targets are known at all samples: all scenes advance in one operation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safevar_sumo.records import BoolArray
from safevar_sumo.scenarios import VUT, Scenario, Scene
from safevar_sumo.scenarios.frame import Frame
from safevar_sumo.scenarios.target import Course, Target, TargetTest, scene_of
from safevar_sumo.sumo.recorded_world import RecordedWorld, Samples, not_on_the_road


class Meetings:
    """The meetings of K scenes, each with `size` of a world's vehicles; `scene` must be called once per sample.

    Parameters
    ----------
    frame
        Frame of the lane that the vehicles are on.
    courses, targets
        Courses and targets of the K scenes; a target's columns have one row per sample.
    samples
        Samples of the K scenes: which actor is not on the road, and when.
    """

    def __init__(self, frame: Frame, courses: Sequence[Course], targets: Sequence[Target], samples: Sequence[Samples],
                 world: RecordedWorld, size: int) -> None:
        self._frame, self._world, self._size, self._samples = frame, world, size, samples
        self._course = Course._make(_per_vehicle(column, size) for column in zip(*courses, strict=True))
        length = max(len(target.edge) for target in targets)
        self._target = [_table(column, length) for column in zip(*targets, strict=True)]
        self._absent = _table([scene.absent for scene in samples], length)
        self._sample, self._approached = 0, np.zeros(world.n, dtype=bool)

    @classmethod
    def of(cls, scenarios: Sequence[Scenario], world: RecordedWorld, size: int) -> Meetings | None:
        """The meetings in the scenes of a world; None unless all scenarios have a target that does not react, and the same lane."""
        if not all(isinstance(scenario, TargetTest) for scenario in scenarios):
            return None
        samples = [scene.samples() for scene in world.scenes]
        meetings, targets = zip(*(scenario.at_all_samples(*scene, world.step_length)  # type: ignore[attr-defined]
                                  for scenario, *scene in zip(scenarios, world.scenes, samples, strict=True)), strict=True)
        frames = {meeting.frame for meeting in meetings}
        return cls(frames.pop(), [meeting.course for meeting in meetings], targets, samples, world, size) if len(frames) == 1 else None

    def scene(self, open_: BoolArray) -> Scene:
        """The scene of all vehicles now; raises `SimulationError` if the target of an open run is not on the road."""
        sample, world = min(self._sample, len(self._absent) - 1), self._world
        if self._absent[sample].any():
            missing = self._absent[sample] & open_.reshape(-1, self._size).any(axis=1)
            if missing.any():
                raise not_on_the_road(self._samples[np.flatnonzero(missing)[0]].actor, self._sample * world.step_length)
        target = Target._make(column if column.ndim == 0 else column[sample].repeat(self._size) for column in self._target)
        front = self._frame.along(world.vehicle_positions(VUT))
        scene, self._approached = scene_of(self._course, target, front, world.speeds(), self._approached)
        self._sample += 1
        return scene


def _per_vehicle(values: Sequence[Any], size: int) -> Any:
    """A scalar if all values are equal, else one value for each vehicle, shape (N,)."""
    return values[0] if all(value == values[0] for value in values) else np.repeat(values, size)


def _table(columns: Sequence[Any], length: int) -> Any:
    """Columns of T samples, or scalars, as a table of shape (length, K), shorter ones padded with their last value; or one scalar."""
    if all(np.ndim(column) == 0 and column == columns[0] for column in columns):
        return np.asarray(columns[0])
    table = np.empty((length, len(columns)), dtype=np.result_type(*columns))
    for k, column in enumerate(columns):
        table[:, k] = column if np.ndim(column) == 0 else column[np.minimum(np.arange(length), len(column) - 1)]
    return table
