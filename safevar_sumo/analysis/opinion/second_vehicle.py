"""The second vehicle model replaces ours in the simulation: it takes the driving system's commands and returns speeds.

Its sensors are the study's; its engine torque comes from our original vehicle, which is simulated in parallel with the
same pedal at the same speed. Brakes, tyres, axles and body are the second model's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.analysis.opinion.mapping import MAPPING_TABLES, Road
from safevar_sumo.analysis.opinion.multi_body import (
    LONGEST_STEP,
    WHEEL_COUNT,
    MultiBodyState,
    Plant,
    advance,
    balanced_state,
)
from safevar_sumo.errors import InputError
from safevar_sumo.records import BoolArray, Command, FloatArray, Observation
from safevar_sumo.study import Study, load_study
from safevar_sumo.vehicles import LEVEL, VEHICLES, GuardedVehicle, Sensors, Slope, SumoType, Vehicle
from safevar_sumo.vehicles.base import Characteristics
from safevar_sumo.vehicles.sensors import delay_signal, extend_history, start_history

SPIN_LIMIT = 1.0
"""Speed of a rim above the car's from which the wheels spin [m/s]: such a simulation confirms nothing."""
CREEP_SPEED = 0.01
"""Speed above which the original vehicle's wheel speed is scaled with its speed [m/s]."""


class Prepared(NamedTuple):
    """Constants of N vehicles: the study's vehicle, for its sensors; the original, for its engine; the second model.

    `engine_mass` is the mass that the original's engine moves, with its wheels [kg]; `engine_radius` their radius [m].
    """

    vehicle: Any
    original: Any
    plant: Plant
    engine_mass: FloatArray
    engine_radius: FloatArray
    settings: FloatArray
    slope: Slope
    step: float


class SecondState(NamedTuple):
    """State of N vehicles: speed [m/s], pedals, gear; then states of the study's vehicle, the original and the body."""

    speed: FloatArray
    throttle: FloatArray
    brake: FloatArray
    gear: FloatArray
    vehicle: Any
    original: Any
    body: MultiBodyState
    brake_commands: FloatArray


class SecondVehicle(Vehicle):
    """A vehicle of the second model for every setting of a study; the contract is `safevar_sumo.vehicles.Vehicle`.

    The study's vehicle is a shipped one, derived from one, or user code with all characteristics of a shipped one.

    Attributes
    ----------
    name, table
        The shipped vehicle that the study's vehicle is or resembles, and its mapping.
    spinning
        The settings, as bytes, of the vehicles whose wheels spun in a simulation.

    Raises
    ------
    InputError
        If the vehicle resembles no shipped one.
    """

    def __init__(self, vehicle: Vehicle, study: Study) -> None:
        self._vehicle, self.UNITS, self.spinning = vehicle, vehicle.UNITS, set[bytes]()
        model: Any = vehicle.model if isinstance(vehicle, GuardedVehicle) else vehicle
        rows = study.vehicle.characteristics
        for name, cls in VEHICLES.items():
            matching = {key: row.original for key, row in rows.items() if cls.UNITS.get(key) == row.unit}
            if isinstance(model, cls) or len(matching) == len(cls.UNITS):
                self.name, self.table, self._matching = name, MAPPING_TABLES[name], set(matching)
                break
        else:
            raise InputError(
                study.source,
                f"vehicle.model = {study.vehicle.model!r} with {', '.join(rows)} is no vehicle that the "
                "second model can represent",
                f"one of {', '.join(MAPPING_TABLES)}, a class derived from one, or one "
                "with the same characteristics in the same units",
            )
        shipped = load_study(self.table.study).vehicle
        given = {**shipped.parameters, **study.vehicle.parameters}
        parameters = {key: getattr(model, key, given.get(key)) for key in cls.__struct_fields__}
        self._engine = cls(**{key: value for key, value in parameters.items() if value is not None})
        self._original = {key: row.original for key, row in shipped.characteristics.items()} | matching

    def reasons_to_omit(self, changes: Mapping[str, float]) -> list[str]:
        """The reason for each changed characteristic that cannot be represented; empty if all can."""
        unknown = "no parameter of the second model is known for it"
        return [
            f"{name}: {self.table.outside.get(name, unknown)}"
            for name in changes
            if name in self.table.outside or name not in self._matching
        ]

    def prepare(
        self,
        characteristics: Characteristics,
        road_friction: Any,
        step: float,
        slope: Slope = LEVEL,
        wet: bool | BoolArray = False,
    ) -> Prepared:
        road, settings = Road(road_friction, slope, wet), np.stack([*characteristics.values()], axis=1)
        original = {name: np.full(len(settings), value) for name, value in self._original.items()}
        represented = original | {name: characteristics[name] for name in self._matching}
        plant, own = (self.table.represent(self._engine, c, self._original, road) for c in (represented, original))
        return Prepared(
            vehicle=self._vehicle.prepare(characteristics, road_friction, step, slope, wet),
            original=self._engine.prepare(original, road_friction, step, slope, wet),
            plant=plant,
            engine_mass=own.mass + WHEEL_COUNT * own.wheel_inertia / own.radius**2,
            engine_radius=own.radius,
            settings=settings,
            slope=slope,
            step=step,
        )

    def sumo_type(self, prepared: Prepared) -> SumoType:
        return self._vehicle.sumo_type(prepared.vehicle)

    def at_rest(self, prepared: Prepared) -> SecondState:
        return self.at_speed(prepared, np.zeros_like(prepared.plant.mass))

    def at_speed(self, prepared: Prepared, speed: FloatArray) -> SecondState:
        """The state in which the pedals hold the original vehicle's speed, which may be 0."""
        original = self._engine.at_start(prepared.original, speed)
        commands = start_history(float(np.max(prepared.plant.brake_delay)), prepared.step, original.brake)
        vehicle, body = self._vehicle.at_start(prepared.vehicle, speed), balanced_state(prepared.plant, speed)
        return SecondState(speed, original.throttle, original.brake, original.gear, vehicle, original, body, commands)

    def sensors(self, prepared: Prepared) -> Sensors | None:
        return self._vehicle.sensors(prepared.vehicle)

    def sense(self, prepared: Prepared, state: SecondState, seen: Observation) -> tuple[Observation, SecondState]:
        observation, vehicle = self._vehicle.sense(prepared.vehicle, state.vehicle, seen)
        return observation, state._replace(vehicle=vehicle)

    def hold_gear(self, prepared: Prepared, state: SecondState, holds: BoolArray) -> SecondState:
        return state._replace(original=self._engine.hold_gear(prepared.original, state.original, holds))

    def advance(self, prepared: Prepared, state: SecondState, command: Command) -> SecondState:
        plant, body, brake = prepared.plant, state.body, state.brake
        original, drive_torque = self._advance_engine(prepared, state, command.throttle)
        commands = extend_history(state.brake_commands, command.brake)
        demand = delay_signal(commands, plant.brake_delay, prepared.step)
        step_count = math.ceil(prepared.step / LONGEST_STEP)
        step = prepared.step / step_count
        lag_share = step / (step + plant.brake_lag)
        for _ in range(step_count):
            change = np.maximum((demand - brake) * lag_share, -plant.brake_fall * step)
            brake = brake + np.minimum(change, plant.brake_rise * step)
            body = advance(plant, body, brake, drive_torque, step)
        spins = np.max(body.wheel_speeds * plant.radius, axis=0) > body.speed + SPIN_LIMIT
        self.spinning.update(setting.tobytes() for setting in prepared.settings[spins])
        return SecondState(body.speed, original.throttle, brake, original.gear, state.vehicle, original, body, commands)

    def _advance_engine(self, prepared: Prepared, state: SecondState, throttle: FloatArray) -> tuple[Any, FloatArray]:
        """The original vehicle one step later, and the torque of its engine and all drags on all wheels [N m]."""
        plant, radius, own_radius, v = prepared.plant, prepared.plant.radius, prepared.engine_radius, state.speed
        original, speed = state.original, v * own_radius / radius
        if hasattr(original, "wheel_speed"):
            wheels = original.wheel_speed * speed / np.maximum(original.speed, CREEP_SPEED)
            wheels = np.where(original.speed > CREEP_SPEED, wheels, original.wheel_speed)
            original = original._replace(wheel_speed=wheels)
        command = Command(throttle, brake=np.zeros_like(throttle))
        original = self._engine.advance(prepared.original, original._replace(speed=speed), command)
        torque = prepared.engine_mass * ((original.speed - speed) / prepared.step + prepared.slope.back) * own_radius
        resistance = radius * (plant.drag + plant.air_drag * v) * v + plant.wheel_damping * v / radius
        return original, np.where(torque > 0, torque * plant.drive_ratio, torque) - resistance
