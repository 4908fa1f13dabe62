"""Drives vehicles under test through a world, sample by sample: a sample begins with what the
vehicles observe, and leads to the speeds that they reach at the next sample.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import NamedTuple

import numpy as np

from safevar_sumo.ads import Ads, FullBrake
from safevar_sumo.ads.varied import with_tau
from safevar_sumo.errors import InputError
from safevar_sumo.plugins import check_open_runs, open_rows
from safevar_sumo.records import (
    STANDSTILL,
    TIME_DECIMALS,
    BoolArray,
    Command,
    FloatArray,
    IntArray,
    Nominal,
    Observation,
    Outcome,
    Quantity,
    SimulationRuns,
    TextArray,
    Trace,
    nans,
)
from safevar_sumo.scenarios import VUT, Point, Scene
from safevar_sumo.scenarios.roads import Frame
from safevar_sumo.sumo.bodies import FirstContacts, VehicleStates, VehicleWorld
from safevar_sumo.sumo.driving_robot import DrivingRobot
from safevar_sumo.sumo.perception import (
    Observer,
    Perception,
    SceneObserver,
    of_vehicles,
    per_vehicle,
)
from safevar_sumo.sumo.system import System
from safevar_sumo.sumo.traci_controller import TraciController
from safevar_sumo.sumo.traffic import OVERTIME, Traffic
from safevar_sumo.vehicles import LEVEL, CharacteristicSet, Sensors, slope_of
from safevar_sumo.vehicles.base import Prepared

Listener = Callable[[Observation], None]
"""A function that is called at every sample, with the observation that the ADS gets."""
OF_ALL_RUNS = ("step", "vehicle_length", "vehicle_width", "time")
"""Fields of a trace for which a log keeps no column of its own."""
TRUTHS = ("active", "visible")
"""Columns of a log that are true or false."""


@np.errstate(all="ignore")
def drive(
    system: System,
    settings: FloatArray,
    world: VehicleWorld,
    observer: Observer,
    listen: Listener | None = None,
) -> SimulationRuns:
    """Simulate N settings of the vehicle's n characteristics, shape (N, n), in a `world` that has
    not taken its first step. `observer` returns the scene of each sample; see `drive_all`.

    With K points, `settings` holds K groups of equal size, and group k drives at point k.
    """
    points = system.points
    vehicle = system.vehicle
    step = world.step_length
    n = len(settings)
    group_size = n // len(points)

    prepared, ads, motion = enter(system, settings, world)
    state = vehicle.at_start(prepared, motion.speeds)
    nominal = system.nominal._replace(
        length=float(world.vehicle_length(VUT)), width=float(world.vehicle_width)
    )
    memory = ads.start(n, nominal, step)
    perception = Perception([point.weather for point in points], step, group_size)
    robot = DrivingRobot(points, vehicle, prepared, state, step)
    # Contacts with the vehicle's front alone count in tests; some runs go on at their end while the
    # vehicle closes in on a body.
    is_tested = [point.scenario.is_hit_in_front for point in points]
    may_go_on = np.repeat([point.scenario.goes_on for point in points], group_size)
    last_sample = of_vehicles(
        [np.round(last_sample_of(point, step)) for point in points], group_size
    ).astype(int)
    contacts = FirstContacts(n, np.repeat(is_tested, group_size))
    outcomes = _Outcomes(n)
    log = _Log(world.frame, n, _most_samples(last_sample, may_go_on, step))
    with check_open_runs(outcomes.is_checked):
        for sample in range(log.capacity):
            time = sample * step
            speed = motion.speeds
            scene = observer.observe(motion)
            if system.sees_nobody:
                scene = _unseen(scene)
            collisions = contacts.count(world, motion.hits, scene)
            # SUMO misses contacts in some places, such as between lanes. Contacts with bodies on
            # tracks follow from their geometry, and need no check.
            if isinstance(observer, SceneObserver):
                is_checked = outcomes.is_open & ~scene.over
                contacts.check(observer.world, scene, is_checked, time)
            # Tracks have no end, so that a run among them may be extended; recorded scenes end.
            if isinstance(observer, Traffic):
                ends = may_go_on & outcomes.is_open & (sample == last_sample)
                if ends.any():
                    may_go_on &= ~_extend_runs(observer, motion, ends, last_sample)
            is_last = sample >= last_sample
            active = outcomes.note_sample(speed, scene.over, collisions, is_last)

            truth = perception.observe(time, speed, scene)
            truth = truth._replace(throttle=state.throttle, brake=state.brake)
            observation, state = vehicle.sense(prepared, state, truth)
            if listen is not None:
                listen(observation)
            command, memory = ads.drive(observation, memory)
            outcomes.note_warnings(ads.warns(memory), speed, scene)
            command, state = robot.drive(command, state, outcomes.is_open)
            log.write(
                motion.fronts,
                scene,
                command,
                speed=speed,
                gear=state.gear,
                active=active,
                pedal=state.brake,
            )
            if not outcomes.is_open.any():
                break

            np.copyto(outcomes.is_checked, outcomes.is_open)
            state = vehicle.advance(prepared, state, command)
            _check_finite(state.speed, settings, system.characteristics)
            motion = world.step(state.speed, outcomes.is_open)
    trace = log.trace(step, nominal)
    return SimulationRuns(
        trace=trace,
        encounter=observer.encounter(trace),
        outcome=np.where(robot.invalid, Outcome.INVALID_TEST, outcomes.classify()),
        collision_speed=np.where(robot.invalid, np.nan, outcomes.collision_speed),
        contact=contacts.first,
        test_speed_error=robot.error,
        warning_ttc=outcomes.warning_ttc,
        centre_to_centre=points[0].scenario.centre_to_centre,
        allowed_impact_speed=of_vehicles(
            [point.allowed_impact_speed for point in points], group_size
        ),
    )


def _most_samples(last_sample: IntArray, may_go_on: BoolArray, step: float) -> int:
    """The largest number of samples that runs can have, with the extension of those that may go
    on.
    """
    number = int(last_sample.max()) + 1
    if may_go_on.any():
        number += round(OVERTIME / step)
    return number


def _unseen(scene: Scene) -> Scene:
    """The scene of a driving system that sees nobody. This system would drive on: a run ends when
    the vehicle reaches the body.
    """
    over = scene.over | (scene.gap <= 0)
    return scene._replace(visible=np.array(False), over=over)


def _extend_runs(
    traffic: Traffic, motion: VehicleStates, ends: BoolArray, last_sample: IntArray
) -> BoolArray:
    """Extend those of the runs that end at this sample (`ends`) whose vehicles close in on a body:
    `last_sample` grows by `OVERTIME`. Returns the extended runs, shape (N,).
    """
    goes_on = ends & traffic.are_closing(motion)
    last_sample[goes_on] += round(OVERTIME / traffic.step)
    traffic.place_until(int(last_sample.max()) + 1)
    return goes_on


def last_sample_of(point: Point, step: float) -> Quantity:
    """The number of the last sample of runs at a point: its duration in steps, plus its phase,
    because bodies begin to move later by the phase.
    """
    return point.scenario.duration / step + point.phase


class RoadVehicles(NamedTuple):
    """Vehicles on the road: the constants of their model, their ADS, and their first motion."""

    prepared: Prepared
    ads: Ads
    motion: VehicleStates


def enter(system: System, settings: FloatArray, world: VehicleWorld) -> RoadVehicles:
    """Put the vehicles of N settings, shape (N, n), into a world that has not taken a step yet."""
    vehicle = system.vehicle
    n = len(settings)

    characteristics = system.characteristics.columns(settings)
    roads = _roads(system.points, n, world.step_length)
    prepared = vehicle.prepare(characteristics, *roads)
    types = vehicle.sumo_type(prepared)

    # A controller written for TraCI reads and commands the world itself, beside SUMO's own driver.
    ads = with_tau(system.ads, types.tau)
    if system.points[0].scenario.brakes_fully:
        ads = FullBrake()
    if not isinstance(ads, TraciController):
        return RoadVehicles(prepared, ads, world.enter(types))
    motion = world.enter(ads.known_types(system.nominal, types), keeps_drivers=True)
    sensors = _sensors_in_weather(system, prepared, n)
    return RoadVehicles(prepared, ads.in_world(world, sensors), motion)


def _check_finite(
    speed: FloatArray, settings: FloatArray, characteristics: CharacteristicSet
) -> None:
    """Refuse speeds that are not finite: SUMO would replace them by 0, and a vehicle whose model
    diverged would appear to stand.

    The error replaces numpy's overflow warnings, which name neither a characteristic nor a value.
    """
    is_finite = np.isfinite(speed)
    if is_finite.all():
        return
    for copy in open_rows(~is_finite)[:1]:
        changes = characteristics.changes_in_words(settings[copy])
        values = changes or "the original's values"
        raise InputError(
            "vehicle",
            f"its speed is {speed[copy]} with {values}",
            "values that the model can compute with",
        )


def _roads(points: Sequence[Point], n: int, step: float) -> tuple[Quantity, ...]:
    """The arguments of `Vehicle.prepare` after the characteristics of n vehicles: the weather's
    factor on the tyres' friction (a number if all points have the same), the time step, then the
    slope and the water. Slope and water are left out if no road has a slope or water.
    """
    size = n // len(points)
    frictions = [point.weather.road_friction for point in points]
    grades = [point.scenario.grade for point in points]
    water = [point.weather.water for point in points]
    roads: tuple[Quantity, ...] = (per_vehicle(frictions, size), step)
    if any(grades):
        roads += (slope_of(np.repeat(grades, size)),)
    elif any(water):
        roads += (LEVEL,)
    if any(water):
        roads += (np.repeat(water, size),)
    return roads


def _sensors_in_weather(system: System, prepared: Prepared, n: int) -> Sensors:
    """The vehicles' sensors at the system's only point. The weather adds its recognition delay to
    the latency, and its visibility scales the range.
    """
    (point,) = system.points
    latency, reach, scale = system.vehicle.sensors(prepared) or Sensors.perfect(n)
    reach = reach * point.weather.visibility
    if system.sees_nobody:
        # A negative range hides everybody.
        reach = np.full(n, -1.0)
    return Sensors(latency + point.weather.recognition_delay, reach, scale)


class _Log:
    """A log of up to `capacity` samples of N runs. A quantity has the shape (capacity, N). `frame`
    has the coordinates of the lane, along which positions are logged.
    """

    def __init__(self, frame: Frame, n: int, capacity: int) -> None:
        self.capacity = capacity
        self._frame = frame
        self._samples = 0
        self._columns = {}
        for field in fields(Trace):
            if field.name not in OF_ALL_RUNS:
                # A truth takes one byte, a float eight.
                kind = bool if field.name in TRUTHS else float
                self._columns[field.name] = np.zeros((capacity, n), dtype=kind)

    def write(
        self,
        fronts: FloatArray,
        scene: Scene,
        command: Command,
        **quantities: FloatArray | BoolArray,
    ) -> None:
        """Write the next sample."""
        values = {**scene._asdict(), **command._asdict(), **quantities}
        values["position"] = self._frame.along(fronts)
        for name, column in self._columns.items():
            column[self._samples] = values[name]
        self._samples += 1

    def trace(self, step: float, nominal: Nominal) -> Trace:
        """The trace of all samples that were written, which are `step` seconds apart."""
        samples = self._samples
        columns = {name: values[:samples] for name, values in self._columns.items()}
        return Trace(
            step=step,
            vehicle_length=nominal.length,
            vehicle_width=nominal.width,
            time=np.round(np.arange(samples) * step, TIME_DECIMALS),
            **columns,
        )


class _Outcomes:
    """Outcomes of N runs (docs/method.md, section 4); all arrays have the shape (N,).

    `collision_speed` [m/s] is NaN without a collision. `warning_ttc`, the true time to collision at
    the first warning [s], is NaN without a warning. `is_open` is true while the outcome of a run
    can change. `is_checked` is true if a run was open when its vehicle last advanced: values that
    user code returns are checked in these runs alone.
    """

    def __init__(self, n: int) -> None:
        self.is_open = np.ones(n, bool)
        self.is_checked = np.ones(n, bool)
        self.collision_speed = nans(n)
        self.warning_ttc = nans(n)
        self._has_moved = np.zeros(n, bool)
        self._has_stopped = np.zeros(n, bool)
        self._is_over = np.zeros(n, bool)

    def note_sample(
        self,
        speed: FloatArray,
        over: BoolArray,
        collisions: dict[int, float],
        is_last: BoolArray,
    ) -> BoolArray:
        """Process one sample. Returns whether the sample is part of each run, shape (N,)."""
        active = self.is_open & ~over

        # A collision ends a run. Its sample is part of the run even if the encounter is over.
        for copy, collision_speed in collisions.items():
            if self.is_open[copy]:
                self.collision_speed[copy] = collision_speed
                active[copy] = True
                self.is_open[copy] = False

        is_standing = speed <= STANDSTILL
        self._has_stopped |= self.is_open & self._has_moved & is_standing
        self._has_moved |= self.is_open & ~is_standing
        self._is_over |= self.is_open & over
        self.is_open &= ~over & ~is_last
        return active

    def note_warnings(
        self, warns: BoolArray | None, speed: FloatArray, scene: Scene
    ) -> None:
        """Note the time to collision at each open run's first warning. `scene` has the true gap,
        and not the gap that sensors report.
        """
        if warns is not None:
            closing_speed = speed - scene.obstacle_speed
            is_first = np.isnan(self.warning_ttc) & self.is_open & (closing_speed > 0)
            time_to_collision = scene.gap / closing_speed
            np.copyto(self.warning_ttc, time_to_collision, where=is_first & warns)

    def classify(self) -> TextArray:
        """The outcomes of all runs, once no run is open."""
        outcome = np.full(len(self.is_open), Outcome.TIMEOUT.value, "U16")
        outcome[self._is_over] = Outcome.PASSED
        outcome[self._has_stopped] = Outcome.STOPPED
        outcome[~self._has_moved] = Outcome.NEVER_MOVED
        outcome[~np.isnan(self.collision_speed)] = Outcome.COLLISION
        return outcome
