"""Many recorded scenes of one road, observed in one operation: their targets do not react, so all positions are known
in advance.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safevar_sumo.records import BoolArray
from safevar_sumo.scenarios import VUT, Scenario, Scene
from safevar_sumo.scenarios.frame import Frame
from safevar_sumo.scenarios.target import EncounterConstants, Target, TargetTest, scene_of
from safevar_sumo.sumo.recorded_world import RecordedWorld, SampledRecording, absence_error


class TargetObserver:
    """Observes the targets of K recorded scenes with `size` vehicles each; `observe` must be called once per sample.

    Parameters
    ----------
    frame
        Frame of the lane that the vehicles are on.
    constants, targets
        Constants and targets of the K scenes; a target's columns have one row per sample.
    sampled_recordings
        The K recordings at all samples, which tell when a target is not on the road.
    """

    def __init__(
        self,
        frame: Frame,
        constants: Sequence[EncounterConstants],
        targets: Sequence[Target],
        sampled_recordings: Sequence[SampledRecording],
        world: RecordedWorld,
        size: int,
    ) -> None:
        self._frame, self._world, self._size, self._sampled_recordings = frame, world, size, sampled_recordings
        self._constants = EncounterConstants._make(
            _per_vehicle(column, size) for column in zip(*constants, strict=True)
        )
        length = max(len(target.edge) for target in targets)
        self._target = [_table(column, length) for column in zip(*targets, strict=True)]
        self._absence = _table([sampled.absence for sampled in sampled_recordings], length)
        self._sample, self._has_approached = 0, np.zeros(world.n, dtype=bool)

    @classmethod
    def of(cls, scenarios: Sequence[Scenario], world: RecordedWorld, size: int) -> TargetObserver | None:
        """The observer of a world's scenes; None unless every scenario has a target that does not react, and all share
        one lane.
        """
        if not all(isinstance(scenario, TargetTest) for scenario in scenarios):
            return None
        sampled_recordings = [world_slice.at_all_samples() for world_slice in world.slices]
        motions, targets = zip(
            *(
                scenario.at_all_samples(*arguments, world.step_length)  # type: ignore[attr-defined]
                for scenario, *arguments in zip(scenarios, world.slices, sampled_recordings, strict=True)
            ),
            strict=True,
        )
        frames, constants = {motion.frame for motion in motions}, [motion.constants for motion in motions]
        return cls(frames.pop(), constants, targets, sampled_recordings, world, size) if len(frames) == 1 else None

    def observe(self, is_open: BoolArray) -> Scene:
        """The scene of all vehicles at the next sample; raises `SimulationError` if the target of an open run is not on
        the road.
        """
        sample, world = min(self._sample, len(self._absence) - 1), self._world
        if self._absence[sample].any():
            absent_scenes = np.flatnonzero(self._absence[sample] & is_open.reshape(-1, self._size).any(axis=1))
            if len(absent_scenes):
                raise absence_error(self._sampled_recordings[absent_scenes[0]].actor, self._sample * world.step_length)
        target = Target._make(
            column if column.ndim == 0 else column[sample].repeat(self._size) for column in self._target
        )
        front = self._frame.along(world.vehicle_positions(VUT))
        scene, self._has_approached = scene_of(self._constants, target, front, world.speeds(), self._has_approached)
        self._sample += 1
        return scene


def _per_vehicle(values: Sequence[Any], size: int) -> Any:
    """The value of all scenes as a scalar if they agree, else the scene's value for each vehicle, shape (K * size,)."""
    return values[0] if all(value == values[0] for value in values) else np.repeat(values, size)


def _table(columns: Sequence[Any], length: int) -> Any:
    """K columns of samples, padded with their last values, as a table of shape (length, K); a scalar if all are the
    same scalar.
    """
    if all(np.ndim(column) == 0 and column == columns[0] for column in columns):
        return np.asarray(columns[0])
    table = np.empty((length, len(columns)), dtype=np.result_type(*columns))
    for k, column in enumerate(columns):
        table[:, k] = column if np.ndim(column) == 0 else column[np.minimum(np.arange(length), len(column) - 1)]
    return table
