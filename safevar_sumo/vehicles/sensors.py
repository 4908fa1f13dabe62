"""Sensors that report the past, brakes that follow late: delayed signals, and the base of vehicles
that have them.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import BoolArray, Command, FloatArray, IntArray, Observation
from safevar_sumo.vehicles.base import Prepared, Sensors, Vehicle

LONGEST_DELAY = 3600.0
"""Longest delay [s]."""


SPARE = 32
"""Number of further samples for which a history has room before it is copied."""


class DelayedSignal:
    """A signal of N vehicles, each with its own delay, which ends between two samples: a newer and
    an older one.

    Attributes
    ----------
    samples
        The last L samples, newest first, shape (L, ..., N).
    newer
        For every value of a sample, its index in `samples.ravel()` where that is the newer sample,
        shape (..., N).
    share
        The older sample's share, shape (N,).
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
        """A history for delays [s], shape (N,), filled with the first sample, shape (..., N).

        Raises
        ------
        InputError
            If a delay is longer than any run.
        """
        longest = float(np.max(delay))
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
        samples = np.repeat(sample[None], int(longest / step) + 2, axis=0)
        return cls(samples, newer, age - whole_steps)

    def where(self, chosen: BoolArray, history: DelayedSignal) -> DelayedSignal:
        """This history of the `chosen` vehicles, shape (N,), and another one, of equal length, of
        all others.
        """
        samples = np.where(chosen, self.samples, history.samples)
        newer = np.where(chosen, self.newer, history.newer)
        return DelayedSignal(
            samples, newer, np.where(chosen, self.share, history.share)
        )

    def extended(self, sample: FloatArray) -> DelayedSignal:
        """The history with a new sample at its front and the oldest one dropped."""
        # Another history may go on from the same room, or the room may be full.
        room = self._room
        if room.begin != self._begin or not room.begin:
            room = _Room(self.samples)
        room.begin -= 1
        room.samples[room.begin] = sample
        return DelayedSignal(self.samples, self.newer, self.share, room)

    def delayed(self) -> FloatArray:
        """The signal of each vehicle as it was one delay ago, interpolated linearly; shape (...,
        N).
        """
        newer = self.samples.take(self.newer)
        older = self.samples[1:].take(self.newer)
        # A signal is infinite while out of sight, finite a step later.
        with np.errstate(invalid="ignore"):
            signal = newer * (1 - self.share) + older * self.share
        np.copyto(signal, newer, where=np.isnan(signal))
        return signal


class _Room:
    """Room for `SPARE` samples before those of a history, which grows towards the `begin`."""

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
"""What sensors report of an obstacle."""


def sensed_observation(
    observation: Observation,
    past: DelayedSignal | None,
    latency: FloatArray,
    reach: FloatArray,
    step: float,
) -> tuple[Observation, DelayedSignal]:
    """The observation `latency` [s] ago, without obstacles beyond `reach` [m] times the visibility;
    and the history for the next call.
    """
    sample = np.empty((len(DELAYED), *observation.gap.shape))
    for row, name in enumerate(DELAYED):
        sample[row] = getattr(observation, name)
    past = (
        DelayedSignal.of(sample, latency, step)
        if past is None
        else past.extended(sample)
    )
    then = dict(zip(DELAYED, past.delayed(), strict=True))
    is_detected = then["gap"] <= reach * observation.visibility
    then["gap"] = np.where(is_detected, then["gap"], np.inf)
    return observation._replace(**then), past


class SensingState(NamedTuple):
    """State of N vehicles: speed [m/s], positions of the actuators [-], and acceleration by the
    wheels [m/s^2].

    `observations` and `brake_commands` are delayed signals; `observations` is None before the first
    one.
    `frame` is what the sensors last reported, in the order of `DELAYED`, in vehicles whose sensors
    may lose frames.
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

    Its constants, which `prepare` returns, have a `step` [s], the vehicle's `mass` [kg], the
    accelerations `drive` and `brake` by full pedals [m/s^2], the dead time `brake_delay` of the
    brake [s], `max_speed` [m/s], the sensors' `latency` [s] and `sensor_range` [m], and the
    `slope`.
    """

    __slots__ = ()

    def sensors(self, prepared: Prepared) -> Sensors:
        return Sensors(
            prepared.latency, prepared.sensor_range, np.ones_like(prepared.sensor_range)
        )

    def sense(
        self, prepared: Prepared, state: SensingState, observation: Observation
    ) -> tuple[Observation, SensingState]:
        """Sensors report the scene as it was one latency ago, and nothing beyond their range times
        the visibility.
        """
        sensed, past = sensed_observation(
            observation,
            state.observations,
            prepared.latency,
            prepared.sensor_range,
            prepared.step,
        )
        return sensed, state._replace(observations=past)

    def at_rest(self, prepared: Prepared) -> SensingState:
        zeros = np.zeros_like(prepared.mass)
        commands = DelayedSignal.of(zeros, prepared.brake_delay, prepared.step)
        return SensingState(
            zeros, zeros, zeros, np.ones_like(zeros), None, commands, zeros
        )

    def at_speed(self, prepared: Prepared, speed: FloatArray) -> SensingState:
        """The steady state: the pedals balance the slope, the only resistance."""
        standing = self.at_rest(prepared)
        back = prepared.slope.back
        throttle = np.minimum(np.maximum(back / prepared.drive, 0.0), 1.0)
        brake = np.minimum(np.maximum(-back / prepared.brake, 0.0), 1.0)
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
        p = prepared

        commands = state.brake_commands.extended(command.brake)
        brake = commands.delayed()
        acceleration = self._acceleration(p, state, command.throttle, brake)

        # Who is faster than the top speed is not slowed down to it.
        highest_speed = np.maximum(p.max_speed, state.speed)
        speed = state.speed + (acceleration - p.slope.back) * p.step
        speed = np.minimum(np.maximum(speed, 0.0), highest_speed)
        return state._replace(
            speed=speed,
            acceleration=(speed - state.speed) / p.step + p.slope.back,
            throttle=np.where(brake > 0, 0.0, command.throttle),
            brake=brake,
            brake_commands=commands,
        )

    @abstractmethod
    def _acceleration(
        self, p: Prepared, state: SensingState, throttle: FloatArray, brake: FloatArray
    ) -> FloatArray:
        """Acceleration by the wheels with these positions of the pedals [m/s^2]."""
