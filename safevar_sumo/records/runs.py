"""Records of finished simulations: outcomes, traces, geometry of encounters, and contacts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.records.driving import (
    ALL_TRUE,
    LEAST_COLLISION_SPEED,
    LENGTH_DECIMALS,
    STANDSTILL,
    TOUCH_OVERLAP,
    UNDEFINED,
    ZERO,
    BoolArray,
    FloatArray,
    FloatOrArray,
    IntArray,
    TextArray,
    nans,
)


class Outcome(StrEnum):
    """How a simulation ended."""

    STOPPED = "stopped"
    PASSED = "passed"
    COLLISION = "collision"
    TIMEOUT = "timeout"
    NEVER_MOVED = "never-moved"
    INVALID_TEST = "invalid-test"
    SIMULATOR_ERROR = "simulator-error"
    INFEASIBLE = "infeasible"


class Encounter(NamedTuple):
    """The geometry of N vehicles and their obstacle at T samples, shape (T, N).

    Attributes
    ----------
    separation
        The distance of which the safety degree is the least value [m].
    distance, closing_speed
        The distance, and the speed at which it shrinks [m, m/s]: their quotient is the time to
        collision.
    in_conflict
        Whether the sample counts for the safety degree and for the time to collision.
    """

    separation: FloatArray
    distance: FloatArray
    closing_speed: FloatArray
    in_conflict: BoolArray


@dataclass(frozen=True, kw_only=True)
class Trace:
    """T samples of N vehicles, `step` seconds apart. Arrays have shape (T, N); `time` has shape
    (T,).

    A vehicle's samples count while `active`. Later samples mean nothing: SUMO goes on with the
    other vehicles of the batch.

    - `vehicle_length`, `vehicle_width`, `position` along the path, `gap` and `lateral` are in m.
      All speeds are in m/s.
    - `throttle` and `brake` are the commanded pedals; `pedal` is the brake pedal's position.
    - `obstacle_speed` is the obstacle's speed along the vehicle's path. `obstacle_length` is the
      obstacle's extent along the lane [m], and `obstacle_width` its extent across the lane [m].
      Both are 0 if the scenario does not state them.
    - `gap` is the distance from the front bumper to the obstacle, as in `Observation`. The gap is
      at most 0 after the vehicle has reached the obstacle, and infinite without an obstacle.
    - `visible` is true while nothing hides the obstacle.
    """

    step: float
    vehicle_length: float
    time: FloatArray
    position: FloatArray
    speed: FloatArray
    gap: FloatArray
    lateral: FloatArray
    lateral_speed: FloatArray
    throttle: FloatArray
    brake: FloatArray
    gear: FloatArray
    active: BoolArray
    obstacle_speed: FloatArray = field(default_factory=lambda: ZERO)
    obstacle_length: FloatArray = field(default_factory=lambda: ZERO)
    obstacle_width: FloatArray = field(default_factory=lambda: ZERO)
    visible: BoolArray = field(default_factory=lambda: ALL_TRUE)
    vehicle_width: float = 0.0
    pedal: FloatArray = field(default_factory=lambda: ZERO)

    @property
    def last_active(self) -> IntArray:
        """The last active sample of each of N vehicles, shape (N,)."""
        return np.asarray(len(self.time) - 1 - np.argmax(self.active[::-1], axis=0))

    def of(self, vehicles: slice | IntArray) -> Trace:
        """The trace of a part of the vehicles."""
        columns = {
            name: value[:, vehicles]
            for name, value in vars(self).items()
            if np.ndim(value) == 2
        }
        return replace(self, **columns)


QUANTITIES: Mapping[str, tuple[str, ...]] = {
    "gap": ("gap", "lateral", "lateral_speed", "distance"),
    "obstacle_speed": ("obstacle_speed", "closing_speed"),
    **{
        name: (name,)
        for name in (
            "speed",
            "separation",
            "position",
            "throttle",
            "brake",
            "pedal",
            "gear",
        )
    },
}
"""Quantities that a metric may need, with the columns of `Trace` and `Encounter` that hold them. In
a run with a `gap` alone, the obstacle is ahead in the path: `lateral` is 0.
"""


class Contact(NamedTuple):
    """The place of the first contact on the outline of each of N vehicles, shape (N,).

    Attributes
    ----------
    side
        front, left, right or rear; "" without a contact.
    place
        Position of the obstacle's middle, 0 to 100; NaN without a contact. At the front or rear: in
        % of the vehicle's width, from the side on which `lateral` is negative. At the left or
        right: in % of the vehicle's length, from the front.
    speed
        Speed of the obstacle along the vehicle's lane at that sample [m/s]; 0 without a contact.
    """

    side: TextArray
    place: FloatArray
    speed: FloatArray


NO_CONTACT = Contact(np.array("", "U5"), np.array(np.nan), np.array(0.0))
"""The record of N vehicles without any contact."""
for _array in NO_CONTACT:
    _array.flags.writeable = False


@dataclass(frozen=True, kw_only=True)
class SimulationRuns:
    """Trajectories and outcomes of N simulations. Arrays have shape (N,).

    Attributes
    ----------
    outcome
        Values of `Outcome`.
    collision_speed
        The vehicle's own speed at the end of the step in which bodies overlap [m/s]; NaN without a
        collision.
    test_speed_error
        Largest deviation from the test's speed before the driving system acted [m/s]; NaN if the
        test prescribes no speed.
    warning_ttc
        Time to collision at which the system first warned its driver [s]; NaN without a warning.
    centre_to_centre
        Whether the safety degree is measured between the middles of bodies.
    allowed_impact_speed
        Relative speed up to which the test case allows an impact [m/s].
    lacks
        For a quantity: which runs do not have it. A run without a trace has no quantity. A quantity
        that is no key exists in all runs.
    stated
        Values of metrics that a simulator stated itself; NaN for runs without a stated value.
    """

    trace: Trace
    encounter: Encounter
    outcome: TextArray
    collision_speed: FloatArray
    contact: Contact = NO_CONTACT
    test_speed_error: FloatArray = field(default_factory=lambda: UNDEFINED)
    warning_ttc: FloatArray = field(default_factory=lambda: UNDEFINED)
    centre_to_centre: bool = False
    allowed_impact_speed: FloatArray = field(default_factory=lambda: ZERO)
    lacks: Mapping[str, BoolArray] = field(default_factory=dict)
    stated: Mapping[str, FloatArray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.outcome)

    @cached_property
    def is_approach(self) -> BoolArray:
        """Whether each sample belongs to the approach, shape (T, N): the encounter up to the
        vehicle's first stop after it has moved.
        """
        trace = self.trace
        has_moved = np.logical_or.accumulate(trace.speed > STANDSTILL, axis=0)
        has_stopped = np.logical_or.accumulate(
            has_moved & (trace.speed <= STANDSTILL), axis=0
        )
        return trace.active & self.encounter.in_conflict & ~has_stopped

    @cached_property
    def time_to_collision(self) -> FloatArray:
        """TTC(t) = L_s / v_L: the distance between both road users over the speed at which it
        shrinks [s], shape (T, N).

        TTC is infinite while the distance does not shrink, outside of the encounter, and after the
        vehicle's first stop. The distance is the distance of the published data (method section 4):
        the speed of a crossing road user makes it shrink, too. For times along the path alone, see
        `conflict` in `metrics/measures.py`.
        """
        _, distance, closing_speed, _ = self.encounter
        is_counted = self.is_approach & (closing_speed > 0) & (distance >= 0)
        return np.divide(
            distance,
            closing_speed,
            out=np.full_like(distance, np.inf),
            where=is_counted,
        )

    def of(self, vehicles: slice | IntArray) -> SimulationRuns:
        """The runs of a part of the vehicles."""

        def select(value: Any) -> Any:
            """Take the vehicles' part of a field: arrays have the vehicles on their last axis."""
            if isinstance(value, Trace):
                return value.of(vehicles)
            if isinstance(value, Encounter | Contact):
                return type(value)(*(select(item) for item in value))
            if isinstance(value, Mapping):
                return {name: select(item) for name, item in value.items()}
            if np.ndim(value):
                return value[..., vehicles]
            return value

        return replace(
            self,
            **{item.name: select(getattr(self, item.name)) for item in fields(self)},
        )

    def lacking(self, *quantities: str) -> BoolArray:
        """Which runs lack at least one of these quantities, shape (N,)."""
        no_runs = np.zeros(len(self), bool)
        lacks = [self.lacks.get(name, no_runs) for name in quantities]
        return np.asarray(np.any([no_runs, *lacks], axis=0))

    def with_all(self, quantity: str, value: FloatOrArray) -> SimulationRuns:
        """The runs with the same value of a quantity at all samples, or with values of shape
        (T, 1). The speed of a collision is kept.
        """

        def changed(record: Trace | Encounter) -> dict[str, Any]:
            return {
                name: np.full(np.shape(getattr(record, name)), value)
                for name in QUANTITIES[quantity]
                if hasattr(record, name)
            }

        runs = replace(
            self,
            trace=replace(self.trace, **changed(self.trace)),
            encounter=self.encounter._replace(**changed(self.encounter)),
        )
        vars(runs)["relative_speed"] = self.relative_speed
        return runs

    def nearest(self, vehicle: int) -> int | None:
        """The sample of a vehicle's impact. Without a collision, the sample of the smallest
        separation in conflict; None if no sample is in conflict.
        """
        if np.isfinite(self.collision_speed[vehicle]):
            return int(self.trace.last_active[vehicle])
        in_conflict = (
            self.trace.active[:, vehicle] & self.encounter.in_conflict[:, vehicle]
        )
        if not in_conflict.any():
            return None
        return int(
            np.argmin(
                np.where(in_conflict, self.encounter.separation[:, vehicle], np.inf)
            )
        )

    @property
    def middles_apart(self) -> float:
        """The distance between the middles of two bodies that touch [m], if the scenario measures
        between middles; else 0.
        """
        if not self.centre_to_centre:
            return 0.0
        length = float(np.max(self.trace.obstacle_length))
        return round((self.trace.vehicle_length + length) / 2, LENGTH_DECIMALS)

    @property
    def closing_speed(self) -> FloatArray:
        """The severity of a collision [m/s], shape (N,): `collision_speed` minus the struck body's
        speed along the lane at that sample. At least `LEAST_COLLISION_SPEED`; NaN without a
        collision.
        """
        return np.maximum(
            self.collision_speed - self.contact.speed, LEAST_COLLISION_SPEED
        )

    @cached_property
    def relative_speed(self) -> FloatArray:
        """The speed of the vehicle relative to the obstacle at the moment of contact, along the
        vehicle's path [m/s], shape (N,). Euro NCAP uses this speed. NaN without a collision, or
        without a trace.

        A gap d that closes within a time step, from the relative speed v at the relative
        acceleration a, closes at sqrt(v^2 + 2 a d). If no gap closes within the step, the speed at
        the end of the step counts: `collision_speed` minus the obstacle's speed.
        """
        trace = self.trace
        if not len(trace.time):
            return nans(len(self))

        vehicles = np.arange(len(self.collision_speed))
        last_sample = trace.last_active
        sample_before = np.maximum(last_sample - 1, 0)
        obstacle_speed = np.broadcast_to(trace.obstacle_speed, trace.speed.shape)
        speed = trace.speed - obstacle_speed
        speed_before = speed[sample_before, vehicles]
        speed_after = speed[last_sample, vehicles]
        gap_before = trace.gap[sample_before, vehicles]
        gap_after = trace.gap[last_sample, vehicles]

        # Within a step the acceleration is constant: the contact happens before the end of the
        # step, at a speed between both samples.
        gap_closes = (
            (gap_before > -TOUCH_OVERLAP)
            & np.isfinite(gap_before)
            & (gap_after <= 0)
            & (speed_before > 0)
        )
        distance = np.where(gap_closes, np.maximum(gap_before, 0.0), 0.0)
        squared_speed = (
            speed_before * speed_before
            + 2 * (speed_after - speed_before) / trace.step * distance
        )
        min_speed = np.minimum(speed_before, speed_after)
        max_speed = np.maximum(speed_before, speed_after)
        contact_speed = np.minimum(
            np.maximum(np.sqrt(np.maximum(squared_speed, 0.0)), min_speed), max_speed
        )

        # Otherwise the speed at the end of the step counts.
        end_speed = self.collision_speed - obstacle_speed[last_sample, vehicles]
        return np.where(
            gap_closes & ~np.isnan(self.collision_speed), contact_speed, end_speed
        )
