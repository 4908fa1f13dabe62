"""Many recorded scenes of one road, observed in one operation: their targets do not react, so all their positions are known in advance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safevar_sumo.records import BoolArray
from safevar_sumo.scenarios import VUT, Scenario, Scene
from safevar_sumo.scenarios.frame import Frame
from safevar_sumo.scenarios.target import Course, Target, TargetTest, scene_of
from safevar_sumo.sumo.recorded_world import RecordedWorld, SampledScene, absence_error


class Meetings:
    """The meetings of vehicles and targets in K recorded scenes with `size` vehicles each; `observe` must be called once per sample.

    Parameters
    ----------
    frame
        Frame of the lane that the vehicles are on.
    courses, targets
        Courses and targets of the K scenes; a target's columns have one row per sample.
    sampled_scenes
        The K scenes at all samples, which record when a target is not on the road.
    """

    def __init__(self, frame: Frame, courses: Sequence[Course], targets: Sequence[Target], sampled_scenes: Sequence[SampledScene],
                 world: RecordedWorld, size: int) -> None:
        self._frame, self._world, self._size, self._sampled_scenes = frame, world, size, sampled_scenes
        self._course = Course._make(_per_vehicle(column, size) for column in zip(*courses, strict=True))
        length = max(len(target.edge) for target in targets)
        self._target = [_table(column, length) for column in zip(*targets, strict=True)]
        self._absence = _table([sampled.absence for sampled in sampled_scenes], length)
        self._sample, self._has_approached = 0, np.zeros(world.n, dtype=bool)

    @classmethod
    def of(cls, scenarios: Sequence[Scenario], world: RecordedWorld, size: int) -> Meetings | None:
        """The meetings in a world's scenes; None unless every scenario has a target that does not react, and all share one lane."""
        if not all(isinstance(scenario, TargetTest) for scenario in scenarios):
            return None
        sampled_scenes = [recorded.at_all_samples() for recorded in world.scenes]
        meetings, targets = zip(*(scenario.at_all_samples(*arguments, world.step_length)  # type: ignore[attr-defined]
                                  for scenario, *arguments in zip(scenarios, world.scenes, sampled_scenes, strict=True)), strict=True)
        frames, courses = {meeting.frame for meeting in meetings}, [meeting.course for meeting in meetings]
        return cls(frames.pop(), courses, targets, sampled_scenes, world, size) if len(frames) == 1 else None

    def observe(self, open_: BoolArray) -> Scene:
        """What all vehicles meet at the next sample; raises `SimulationError` if the target of an open run is not on the road."""
        sample, world = min(self._sample, len(self._absence) - 1), self._world
        if self._absence[sample].any():
            error_scenes = np.flatnonzero(self._absence[sample] & open_.reshape(-1, self._size).any(axis=1))
            if len(error_scenes):
                raise absence_error(self._sampled_scenes[error_scenes[0]].actor, self._sample * world.step_length)
        target = Target._make(column if column.ndim == 0 else column[sample].repeat(self._size) for column in self._target)
        front = self._frame.along(world.vehicle_positions(VUT))
        scene, self._has_approached = scene_of(self._course, target, front, world.speeds(), self._has_approached)
        self._sample += 1
        return scene


def _per_vehicle(values: Sequence[Any], size: int) -> Any:
    """The value of all scenes as a scalar if they agree, else the scene's value for each vehicle, shape (K * size,)."""
    return values[0] if all(value == values[0] for value in values) else np.repeat(values, size)


def _table(columns: Sequence[Any], length: int) -> Any:
    """K columns of samples, padded with their last values, as a table of shape (length, K); a scalar if all are the same scalar."""
    if all(np.ndim(column) == 0 and column == columns[0] for column in columns):
        return np.asarray(columns[0])
    table = np.empty((length, len(columns)), dtype=np.result_type(*columns))
    for k, column in enumerate(columns):
        table[:, k] = column if np.ndim(column) == 0 else column[np.minimum(np.arange(length), len(column) - 1)]
    return table
