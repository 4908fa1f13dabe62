"""Delayed signals, and the base class of vehicles with delayed sensors and brakes."""

from __future__ import annotations

from abc import abstractmethod
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import (
    BoolArray,
    Command,
    FloatArray,
    IntArray,
    Observation,
    clip_to_share,
)
from safevar_sumo.vehicles.base import Prepared, Sensors, Vehicle

LONGEST_DELAY = 3600.0
"""Longest legal delay [s]: a longer delay is longer than any run."""


SPARE = 32
"""Number of new samples for which a history has room before its samples are copied."""


class DelayedSignal:
    """The last samples of a signal of N vehicles, of which each has its own delay. The time of one
    delay ago lies between two samples, a newer and an older sample.

    Attributes
    ----------
    samples
        The last L samples, the newest first, shape (L, ..., N).
    newer
        For every value of a sample, the index of this value in `samples.ravel()` for the newer of
        the two samples, shape (..., N).
    share
        The weight of the older sample in the interpolation, 0 to 1, shape (N,).
    """

    __slots__ = ("_begin", "_room", "newer", "samples", "share")

    def __init__(
        self,
        samples: FloatArray,
        newer: IntArray,
        share: FloatArray,
        room: _Room | None = None,
    ) -> None:
        if room is None:
            room = _Room(samples)
        self._room = room
        self._begin = room.begin
        self.samples = room.samples[room.begin : room.begin + len(samples)]
        self.newer = newer
        self.share = share

    @classmethod
    def of(cls, sample: FloatArray, delay: FloatArray, step: float) -> DelayedSignal:
        """A history for delays of shape (N,) [s]. The first sample, shape (..., N), stands for all
        earlier samples.

        Raises
        ------
        InputError
            If a delay is longer than `LONGEST_DELAY`.
        """
        longest = np.max(delay)
        age = delay / step
        if not longest <= LONGEST_DELAY:
            raise InputError(
                "vehicle",
                f"one of its delays is {longest:g} s",
                f"up to {LONGEST_DELAY:g} s",
            )
        whole_steps = np.floor(age)
        first_sample = np.arange(sample.size).reshape(sample.shape)
        newer = whole_steps.astype(np.intp) * sample.size + first_sample
        samples = np.repeat(sample[np.newaxis], int(longest / step) + 2, axis=0)
        return cls(samples, newer, age - whole_steps)

    def where(self, chosen: BoolArray, history: DelayedSignal) -> DelayedSignal:
        """A history that joins two of equal length: this history for the `chosen` vehicles, shape
        (N,), and `history` for all other vehicles.
        """
        samples = np.where(chosen, self.samples, history.samples)
        newer = np.where(chosen, self.newer, history.newer)
        return DelayedSignal(
            samples, newer, np.where(chosen, self.share, history.share)
        )

    def extended(self, sample: FloatArray) -> DelayedSignal:
        """The history with a new first sample and without its oldest sample."""
        # Copy the samples if the room is full, or if another history has grown in this room.
        room = self._room
        if room.begin != self._begin or not room.begin:
            room = _Room(self.samples)
        room.begin -= 1
        room.samples[room.begin] = sample
        return DelayedSignal(self.samples, self.newer, self.share, room)

    def delayed(self) -> FloatArray:
        """The signal of each vehicle as it was one delay ago, interpolated linearly between two
        samples, shape (..., N).
        """
        newer = self.samples.take(self.newer)
        older = self.samples[1:].take(self.newer)
        # A gap is infinite while nothing is in sight: 0 times infinity is NaN, so that the newer
        # sample counts.
        with np.errstate(invalid="ignore"):
            signal = newer * (1 - self.share) + older * self.share
        np.copyto(signal, newer, where=np.isnan(signal))
        return signal


class _Room:
    """Memory for the samples of histories, with room for `SPARE` samples in front of them. `begin`
    is the index of the newest sample, and falls as the history grows.
    """

    __slots__ = ("begin", "samples")

    def __init__(self, samples: FloatArray) -> None:
        self.begin = SPARE
        self.samples = np.empty((SPARE + len(samples), *samples.shape[1:]))
        self.samples[SPARE:] = samples


DELAYED = (
    "gap",
    "closing_speed",
    "lateral",
    "lateral_speed",
    "obstacle_speed",
    "obstacle_width",
    "obstacle_length",
    "obstacle",
)
"""The fields of an observation that sensors report late: all that they report of an obstacle."""


class SensingState(NamedTuple):
    """State of N vehicles: speed [m/s], positions of pedals and gear [-], and acceleration by the
    wheels [m/s^2].

    `observations` is None before the first observation. `frame` is the last report of sensors that
    may lose frames, in the order of `DELAYED`; None before the first one, and for other sensors.
    """

    speed: FloatArray
    throttle: FloatArray
    brake: FloatArray
    gear: FloatArray
    observations: DelayedSignal | None
    brake_commands: DelayedSignal
    acceleration: FloatArray
    frame: FloatArray | None = None


class SensingVehicle(Vehicle):
    """A vehicle with delayed sensors of limited range and a delayed brake.

    The constants that `prepare` returns have these fields: `step` [s], `mass` [kg], `drive` and
    `brake`, the accelerations by full pedals [m/s^2], `brake_delay`, the dead time of the brake
    [s], `max_speed` [m/s], `latency` [s] and `sensor_range` [m] of the sensors, and `slope`.
    """

    __slots__ = ()

    def sensors(self, prepared: Prepared) -> Sensors:
        return Sensors(
            prepared.latency, prepared.sensor_range, np.ones_like(prepared.sensor_range)
        )

    def sense(
        self, prepared: Prepared, state: SensingState, observation: Observation
    ) -> tuple[Observation, SensingState]:
        """The observation as it was one latency ago, without an obstacle beyond the sensors' range
        times the visibility; and the state with the observations so far.
        """
        sample = np.empty((len(DELAYED), *observation.gap.shape))
        for row, name in enumerate(DELAYED):
            sample[row] = getattr(observation, name)
        if state.observations is None:
            past = DelayedSignal.of(sample, prepared.latency, prepared.step)
        else:
            past = state.observations.extended(sample)
        then = dict(zip(DELAYED, past.delayed(), strict=True))
        is_detected = then["gap"] <= prepared.sensor_range * observation.visibility
        then["gap"] = np.where(is_detected, then["gap"], np.inf)
        return observation._replace(**then), state._replace(observations=past)

    def at_rest(self, prepared: Prepared) -> SensingState:
        zeros = np.zeros_like(prepared.mass)
        commands = DelayedSignal.of(zeros, prepared.brake_delay, prepared.step)
        return SensingState(
            zeros, zeros, zeros, np.ones_like(zeros), None, commands, zeros
        )

    def at_speed(self, prepared: Prepared, speed: FloatArray) -> SensingState:
        """The steady state at a speed. The slope is the only resistance: the pedals balance it."""
        standing = self.at_rest(prepared)
        back = prepared.slope.back
        throttle = clip_to_share(back / prepared.drive)
        brake = clip_to_share(-back / prepared.brake)
        return standing._replace(
            speed=speed,
            throttle=throttle,
            brake=brake,
            brake_commands=DelayedSignal.of(brake, prepared.brake_delay, prepared.step),
            acceleration=standing.acceleration + back,
        )

    def advance(
        self, prepared: Prepared, state: SensingState, command: Command
    ) -> SensingState:
        commands = state.brake_commands.extended(command.brake)
        brake = commands.delayed()
        acceleration = self._acceleration(prepared, state, command.throttle, brake)

        # A vehicle that begins faster than its top speed must not lose speed at once.
        back = prepared.slope.back
        highest_speed = np.maximum(prepared.max_speed, state.speed)
        speed = state.speed + (acceleration - back) * prepared.step
        speed = np.minimum(np.maximum(speed, 0.0), highest_speed)
        return state._replace(
            speed=speed,
            acceleration=(speed - state.speed) / prepared.step + back,
            throttle=np.where(brake > 0, 0.0, command.throttle),
            brake=brake,
            brake_commands=commands,
        )

    @abstractmethod
    def _acceleration(
        self, p: Prepared, state: SensingState, throttle: FloatArray, brake: FloatArray
    ) -> FloatArray:
        """Acceleration that the wheels give the vehicle at these pedal positions [m/s^2]."""
