"""Records that pass between the stages: observations and commands of an ADS, traces of runs, evaluations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from safevar_sumo.study import SAFETY_DEGREE

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int_]

STANDSTILL = 1e-3
"""Speed below which a vehicle counts as standing [m/s] (method section 4)."""
KMH_PER_MS = 3.6
"""km/h per m/s."""
GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""
TIME_ROUNDING = 1e-9
"""Difference below which two sums of time steps count as the same time [s]."""
TOUCH_OVERLAP = 2e-3
"""Overlap up to which bodies count as touching, not colliding: SUMO ignores an overlap of a millimetre [m]."""
TIME_DECIMALS = 9
"""Decimals to which sums of time steps are rounded: 0.15 s, not 0.15000000000000002 s."""


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


ZERO: FloatArray = np.zeros(())
"""Scalar zero, broadcast to all N vehicles."""
ALL_TRUE: BoolArray = np.ones((), dtype=bool)
"""Scalar True, broadcast to all N vehicles."""
for _constant in (ZERO, ALL_TRUE):
    _constant.flags.writeable = False


def finite_or_none(value: float) -> float | None:
    """Make a number fit for JSON, which has no NaN: an undefined number becomes None."""
    return None if np.isnan(value) else float(value)


class Observation(NamedTuple):
    """Sensor values of N vehicles; every array has shape (N,).

    `gap` is the distance along the vehicle's path from its front bumper to the obstacle, infinite
    while the obstacle is not detected [m]; `lateral` is the obstacle's offset from the middle of the
    vehicle's lane, negative on the side that the obstacle comes from, infinite while it is out of sight [m].
    `closing_speed` is the rate at which the gap shrinks, `obstacle_speed` the obstacle's own speed along the vehicle's path [m/s];
    `throttle` and `brake` are the pedals' positions [-].
    """

    time: float
    speed: FloatArray
    gap: FloatArray
    closing_speed: FloatArray
    lateral: FloatArray
    lateral_speed: FloatArray
    visibility: float | FloatArray
    obstacle_speed: FloatArray = ZERO
    throttle: FloatArray = ZERO
    brake: FloatArray = ZERO


class Command(NamedTuple):
    """Pedals that the ADS of N vehicles commands, each in [0, 1], shape (N,)."""

    throttle: FloatArray
    brake: FloatArray


class PedalTables(NamedTuple):
    """The effect of the original vehicle's pedals on a dry road, at `speeds` [m/s].

    `full_throttle` is the acceleration at full throttle, `coasting` the deceleration without pedals [m/s^2]; `braking` is the
    deceleration that the brake adds per unit of pedal, far from the limit of the tyres [m/s^2].
    """

    speeds: FloatArray
    full_throttle: FloatArray
    coasting: FloatArray
    braking: float


class Nominal(NamedTuple):
    """The original vehicle on a dry road: all that an ADS knows of the vehicle.

    `mass` [kg], `accel`, `decel` [m/s^2] and `max_speed` [m/s] are values of its SUMO type; `actuator_lag` [s] is the time constant
    with which its wheels follow the pedals (`tau` of its SUMO type). `tables` drives the vehicle on its first call, and returns
    `speeds`, `full_throttle`, `coasting` and `braking`.
    """

    mass: float
    accel: float
    decel: float
    max_speed: float
    actuator_lag: float
    tables: Callable[[], PedalTables]

    @property
    def tau(self) -> float:
        """`actuator_lag` by its former name, for ADSs that were written with it."""
        return self.actuator_lag

    @property
    def speeds(self) -> FloatArray:
        return self.tables().speeds

    @property
    def full_throttle(self) -> FloatArray:
        return self.tables().full_throttle

    @property
    def coasting(self) -> FloatArray:
        return self.tables().coasting

    @property
    def braking(self) -> float:
        return self.tables().braking


class Encounter(NamedTuple):
    """The geometry of N vehicles and their obstacle at T samples; shape (T, N).

    The safety degree uses `separation`, the time to collision `distance` and `closing_speed`
    [m, m, m/s]; both metrics count only samples `in_conflict`.
    """

    separation: FloatArray
    distance: FloatArray
    closing_speed: FloatArray
    in_conflict: BoolArray


@dataclass(frozen=True, kw_only=True)
class Trace:
    """T samples of N vehicles, `step` seconds apart; arrays of shape (T, N), `time` (T,).

    A vehicle's samples count while `active`; later samples are meaningless, as SUMO continues with the rest of the batch.

    - `vehicle_length`, `position` along the path, `gap` and `lateral` are in m, all speeds in m/s.
    - `throttle` and `brake` are the pedals as commanded, `pedal` is the brake pedal's position.
    - `obstacle_speed` is the obstacle's speed along the vehicle's path.
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
    pedal: FloatArray = field(default_factory=lambda: ZERO)

    def of(self, vehicles: slice) -> Trace:
        """The trace of some of the vehicles."""
        arrays = {item.name: getattr(self, item.name) for item in fields(self)}
        return replace(self, **{name: values[:, vehicles] for name, values in arrays.items() if np.ndim(values) == 2})


class Contact(NamedTuple):
    """The position of the first contact on the outline of each of N vehicles, shape (N,).

    `side` is front, left, right or rear; empty without a contact. `place` is the position of the obstacle's middle, 0 to 100; NaN without a
    contact. At the front or rear it is in % of the vehicle's width, from the side on which `lateral` is negative; at the left or right in %
    of its length, from the front.
    """

    side: npt.NDArray[np.str_]
    place: FloatArray


NO_CONTACT = Contact(np.array("", dtype="U5"), np.array(np.nan))
"""No contact of N vehicles."""
UNDEFINED: FloatArray = np.array(np.nan)
"""Scalar NaN, broadcast to all N vehicles."""
for _array in (*NO_CONTACT, UNDEFINED):
    _array.flags.writeable = False


@dataclass(frozen=True, kw_only=True)
class SimulationRuns:
    """Trajectories and outcomes of N simulations; `outcome` holds values of `Outcome`, `collision_speed` is NaN without a collision [m/s].

    `test_speed_error` is the largest deviation from the test's speed before the driving system acted, NaN if no speed is prescribed
    [m/s]; `warning_ttc` the time to collision at which the system first warned its driver, NaN if it never did [s].
    """

    trace: Trace
    encounter: Encounter
    outcome: npt.NDArray[np.str_]
    collision_speed: FloatArray
    contact: Contact = NO_CONTACT
    test_speed_error: FloatArray = field(default_factory=lambda: UNDEFINED)
    warning_ttc: FloatArray = field(default_factory=lambda: UNDEFINED)

    def of(self, vehicles: slice) -> SimulationRuns:
        """The runs of some of the vehicles."""
        def select(values: np.ndarray) -> np.ndarray:
            return values[vehicles] if values.ndim else values

        return SimulationRuns(
            trace=self.trace.of(vehicles), encounter=Encounter._make(values[:, vehicles] for values in self.encounter),
            outcome=self.outcome[vehicles], collision_speed=self.collision_speed[vehicles],
            contact=Contact._make(map(select, self.contact)), test_speed_error=select(self.test_speed_error),
            warning_ttc=select(self.warning_ttc))

    def nearest(self, vehicle: int) -> int | None:
        """The sample of the impact or, without a collision, of the smallest separation in conflict; None if never in conflict."""
        active = self.trace.active[:, vehicle]
        if np.isfinite(self.collision_speed[vehicle]):
            return int(np.flatnonzero(active)[-1])
        in_conflict = active & self.encounter.in_conflict[:, vehicle]
        return int(np.argmin(np.where(in_conflict, self.encounter.separation[:, vehicle], np.inf))) if in_conflict.any() else None

    @property
    def relative_speed(self) -> FloatArray:
        """Speed of a collision relative to the obstacle along the vehicle's path [m/s], shape (N,); NaN without a collision.

        A gap d that closes within a time step, from the relative speed v at the relative acceleration a, closes at sqrt(v^2 + 2 a d);
        Where no gap closes, the speed at the end of the step counts: `collision_speed` minus the obstacle's speed.
        """
        trace, vehicles = self.trace, np.arange(len(self.collision_speed))
        last_sample = len(trace.time) - 1 - np.argmax(trace.active[::-1], axis=0)
        obstacle_speed = np.broadcast_to(trace.obstacle_speed, trace.speed.shape)
        (first_speed, end_speed), (gap, gap_after) = (([values[np.maximum(last_sample - 1, 0), vehicles], values[last_sample, vehicles]])
                                                         for values in (trace.speed - obstacle_speed, trace.gap))
        gap_closes = (gap > -TOUCH_OVERLAP) & np.isfinite(gap) & (gap_after <= 0) & (first_speed > 0)
        distance = np.where(gap_closes, np.maximum(gap, 0.0), 0.0)
        squared_speed = first_speed * first_speed + 2 * (end_speed - first_speed) / trace.step * distance
        min_speed, max_speed = np.minimum(first_speed, end_speed), np.maximum(first_speed, end_speed)
        at_contact = np.minimum(np.maximum(np.sqrt(np.maximum(squared_speed, 0.0)), min_speed), max_speed)
        at_end_of_step = self.collision_speed - obstacle_speed[last_sample, vehicles]
        return np.asarray(np.where(gap_closes & ~np.isnan(self.collision_speed), at_contact, at_end_of_step))


class CellResults(NamedTuple):
    """Results of M vehicles in every cell of a rating, shape (M, number of cells).

    `impact` is the relative speed of the collision [km/h], NaN without one; `warning` the true time to collision at the warning [s],
    NaN without one; `valid` is false where the test could not be driven.
    """

    impact: FloatArray
    warning: FloatArray
    valid: BoolArray

    def of(self, vehicles: Sequence[int] | npt.NDArray[np.intp] | BoolArray) -> CellResults:
        return CellResults._make(values[vehicles] for values in self)


@dataclass(frozen=True, kw_only=True)
class Evaluations:
    """M evaluated settings with their outcomes, metrics and objectives.

    `settings` has shape (M, n) and holds the filtered values in their table units; all other arrays have shape (M,).
    `metrics` holds `safevar_sumo.metrics.METRICS` and the study's further metrics; an undefined value is NaN.
    `collision_speed` is in m/s, `f_diff` a fraction, `f_num_diff` a count. `reasons` says, by the bytes of a
    setting, why the setting could not be simulated. `files` are digests, by name, of files that user code
    read for the first time in a batch; they belong to the batch, not to its rows. `cells` are a rating's results, None without a rating.
    """

    settings: FloatArray
    outcome: npt.NDArray[np.str_]
    collision_speed: FloatArray
    metrics: Mapping[str, FloatArray]
    f_diff: FloatArray
    f_num_diff: FloatArray
    reasons: Mapping[bytes, str] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    cells: CellResults | None = None

    def __len__(self) -> int:
        return len(self.settings)

    @property
    def f_safe(self) -> FloatArray:
        """First objective: the safety degree (method section 3) [m, or -m/s on a collision]."""
        return self.metrics[SAFETY_DEGREE]

    def column(self, name: str) -> FloatArray:
        """A metric, f_safe, f_diff or f_num_diff by name; shape (M,). A metric without values is NaN everywhere."""
        if name in ("f_safe", "f_diff", "f_num_diff"):
            return np.asarray(getattr(self, name))
        return np.asarray(self.metrics.get(name, np.full(len(self), np.nan)))

    @property
    def objectives(self) -> FloatArray:
        """The published study's three objectives, all minimised, shape (M, 3)."""
        return np.stack([self.f_safe, self.f_diff, self.f_num_diff], axis=1)

    @property
    def collided(self) -> BoolArray:
        return np.asarray(self.outcome == Outcome.COLLISION)

    @property
    def valid(self) -> BoolArray:
        """Where the setting can be scored: it is feasible, the test was valid, and the simulator reported no error."""
        return np.asarray(~self.failed & (self.outcome != Outcome.INVALID_TEST) & ~self.infeasible)

    @property
    def infeasible(self) -> BoolArray:
        """Where a constraint of the study is violated, so that nothing was simulated."""
        return np.asarray(self.outcome == Outcome.INFEASIBLE)

    @property
    def failed(self) -> BoolArray:
        """Where the simulation failed."""
        return np.asarray(self.outcome == Outcome.SIMULATOR_ERROR)

    def reason(self, row: int) -> str:
        """Why a setting that is not valid could not be scored."""
        return self.reasons.get(self.settings[row].tobytes(), "no reason was recorded")

    def take(self, rows: Sequence[int] | npt.NDArray[np.intp] | BoolArray) -> Evaluations:
        """The evaluations of `rows`, in that order."""
        return replace(
            self, settings=self.settings[rows], outcome=self.outcome[rows], collision_speed=self.collision_speed[rows],
            metrics={name: values[rows] for name, values in self.metrics.items()}, f_diff=self.f_diff[rows],
            f_num_diff=self.f_num_diff[rows], cells=None if self.cells is None else self.cells.of(rows))

    @classmethod
    def none(cls, n: int, metrics: Iterable[str]) -> Evaluations:
        """Empty evaluations, for settings of `n` characteristics."""
        empty_array = np.zeros(0)
        return cls(settings=np.zeros((0, n)), outcome=np.zeros(0, dtype="U16"), collision_speed=empty_array,
                   metrics=dict.fromkeys(metrics, empty_array), f_diff=empty_array, f_num_diff=empty_array)

    @classmethod
    def concatenate(cls, batches: Sequence[Evaluations]) -> Evaluations:
        """Join batches of evaluations in order; a metric that a batch lacks is undefined in its rows.

        There are `cells` only if all batches have them.
        """
        def join(name: str) -> np.ndarray:
            return np.concatenate([getattr(batch, name) for batch in batches])

        cells = [batch.cells for batch in batches if batch.cells is not None]
        return cls(
            settings=join("settings"), outcome=join("outcome"), collision_speed=join("collision_speed"),
            metrics={name: np.concatenate([batch.metrics.get(name, np.full(len(batch), np.nan)) for batch in batches])
                     for name in dict.fromkeys(name for batch in batches for name in batch.metrics)},
            f_diff=join("f_diff"), f_num_diff=join("f_num_diff"),
            reasons={setting: reason for batch in batches for setting, reason in batch.reasons.items()},
            files={name: digest for batch in batches for name, digest in batch.files.items()},
            cells=CellResults._make(map(np.concatenate, zip(*cells, strict=True))) if len(cells) == len(batches) else None)
