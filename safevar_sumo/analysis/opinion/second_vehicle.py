"""The second vehicle model replaces ours: in the same simulation it takes the driving system's commands and returns speeds.

Its sensors are the study's; its engine torque comes from our original vehicle, which is simulated in parallel with the same pedal at
the same speed. Brakes, tyres, axles and body are the second model's.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.analysis.opinion.mapping import SecondModelParameters, Surface, VehicleMapping
from safevar_sumo.analysis.opinion.multi_body import LONGEST_STEP, WHEEL_COUNT, MultiBodyState, advance, at_speed
from safevar_sumo.records import BoolArray, Command, FloatArray, Observation
from safevar_sumo.study import Study, load_study
from safevar_sumo.vehicles import LEVEL, CharacteristicSet, Sensors, Slope, SumoType, Vehicle
from safevar_sumo.vehicles.base import Characteristics
from safevar_sumo.vehicles.sensors import delay_signal, extend_history, start_history

SPIN_LIMIT = 1.0
"""Speed of a rim above the car's from which the wheels of a driven car spin [m/s]: its simulation confirms nothing."""
CREEP_SPEED = 0.01
"""Speed above which the original vehicle's wheel speed is scaled with its speed [m/s]."""


class _Prepared(NamedTuple):
    """Constants of a run: the study's vehicle, for its sensors; the original vehicle, for its engine; the second model's parameters.

    `engine_mass` is the mass that the original vehicle's engine moves, with its turning wheels [kg], `engine_radius` the radius of
    those wheels [m].
    """

    vehicle: Any
    original: Any
    parameters: SecondModelParameters
    engine_mass: FloatArray
    engine_radius: FloatArray
    slope: Slope
    step: float
    settings: FloatArray


class SecondState(NamedTuple):
    """State of N vehicles: speed [m/s], actuated pedals, gear; states of the study's vehicle, the original vehicle and the second model."""

    speed: FloatArray
    throttle: FloatArray
    brake: FloatArray
    gear: FloatArray
    vehicle: Any
    original: Any
    body: MultiBodyState
    brake_commands: FloatArray


class SecondVehicle:
    """A vehicle of the second model for every setting of a study; the contract is `safevar_sumo.vehicles.Vehicle`.

    Parameters
    ----------
    vehicle
        The study's vehicle.
    mapping
        The vehicle's mapping to the second model.
    study
        The study.

    Attributes
    ----------
    spinning
        The settings, as bytes, of the vehicles whose wheels spun in a simulation.
    """

    def __init__(self, vehicle: Vehicle, mapping: VehicleMapping, study: Study) -> None:
        self._vehicle, self.mapping, self.spinning = vehicle, mapping, set[bytes]()
        self.UNITS = vehicle.UNITS
        shipped_tables = load_study(mapping.table.study).vehicle.characteristics
        tables = {**shipped_tables, **{name: table for name, table in study.vehicle.characteristics.items()
                                       if name not in mapping.unmatched_names}}
        self._original = {characteristic.name: characteristic.original
                          for characteristic in CharacteristicSet.of({name: tables[name] for name in mapping.vehicle.UNITS})}

    def prepare(self, characteristics: Characteristics, road_friction: Any, step: float, slope: Slope = LEVEL,
                wet: bool | BoolArray = False) -> _Prepared:
        ones = np.ones_like(next(iter(characteristics.values())))
        original = {name: value * ones for name, value in self._original.items()}
        surface = Surface(road_friction, slope, wet)
        road_arguments = (slope, wet) if np.any(wet) else () if slope is LEVEL else (slope,)  # a user's vehicle may lack slope and wet
        original_vehicle, represent = self.mapping.vehicle, self.mapping.table.represent
        original_plant = represent(original_vehicle, original, self._original, surface).plant
        return _Prepared(
            vehicle=self._vehicle.prepare(characteristics, road_friction, step, *road_arguments),
            original=original_vehicle.prepare(original, road_friction, step, slope, wet),
            parameters=represent(
                original_vehicle, {**original, **{name: characteristics[name] for name in original if name in characteristics}},
                self._original, surface),
            engine_mass=original_plant.mass + WHEEL_COUNT * original_plant.wheel_inertia / original_plant.radius**2,
            engine_radius=original_plant.radius, slope=slope, step=step, settings=np.stack([*characteristics.values()], axis=1))

    def sumo_type(self, prepared: _Prepared) -> SumoType:
        return self._vehicle.sumo_type(prepared.vehicle)

    def at_rest(self, prepared: _Prepared) -> SecondState:
        zeros = np.zeros_like(prepared.engine_mass)
        return self._initial_state(prepared, zeros, self._vehicle.at_rest(prepared.vehicle),
                                   self.mapping.vehicle.at_rest(prepared.original))

    def at_speed(self, prepared: _Prepared, speed: FloatArray) -> SecondState:
        """The state in which the pedals hold the original vehicle's speed."""
        return self._initial_state(prepared, speed, self._vehicle.at_speed(prepared.vehicle, speed),
                                   self.mapping.vehicle.at_speed(prepared.original, speed))

    def _initial_state(self, prepared: _Prepared, speed: FloatArray, vehicle: Any, original: Any) -> SecondState:
        commands = start_history(float(np.max(prepared.parameters.brake_delay)), prepared.step, original.brake)
        body = at_speed(prepared.parameters.plant, speed)
        return SecondState(speed, original.throttle, original.brake, original.gear, vehicle, original, body, commands)

    def sensors(self, prepared: _Prepared) -> Sensors | None:
        sensors = getattr(self._vehicle, "sensors", None)
        return None if sensors is None else sensors(prepared.vehicle)

    def sense(self, prepared: _Prepared, state: SecondState, seen: Observation) -> tuple[Observation, SecondState]:
        """Sense through the sensors of the study's vehicle."""
        observation, vehicle = self._vehicle.sense(prepared.vehicle, state.vehicle, seen)
        return observation, state._replace(vehicle=vehicle)

    def hold_gear(self, prepared: _Prepared, state: SecondState, holds: BoolArray) -> SecondState:
        hold = getattr(self.mapping.vehicle, "hold_gear", None)
        return state if hold is None else state._replace(original=hold(prepared.original, state.original, holds))

    def advance(self, prepared: _Prepared, state: SecondState, command: Command) -> SecondState:
        parameters = prepared.parameters
        original, drive_torque = self._advance_engine(prepared, state, command.throttle)
        commands = extend_history(state.brake_commands, command.brake)
        demand, body, brake = delay_signal(commands, parameters.brake_delay, prepared.step), state.body, state.brake
        step_count = math.ceil(prepared.step / LONGEST_STEP)
        step = prepared.step / step_count
        lag_share = step / (step + parameters.brake_lag)
        for _ in range(step_count):
            change = np.maximum((demand - brake) * lag_share, -parameters.brake_fall * step)
            brake = brake + np.minimum(change, parameters.brake_rise * step)
            body = advance(parameters.plant, body, brake, drive_torque, step)
        spins = np.max(body.wheel_speeds * parameters.plant.radius, axis=0) > body.speed + SPIN_LIMIT
        self.spinning.update(setting.tobytes() for setting in prepared.settings[spins])
        return SecondState(body.speed, original.throttle, brake, original.gear, state.vehicle, original, body, commands)

    def _advance_engine(self, prepared: _Prepared, state: SecondState, throttle: FloatArray) -> tuple[Any, FloatArray]:
        """The original vehicle one step later, and the torque of its engine and drags on all wheels at their speed [N m]."""
        parameters, original, radius = prepared.parameters, state.original, prepared.parameters.plant.radius
        speed = state.speed * prepared.engine_radius / radius
        original = original._replace(speed=speed) if not hasattr(original, "wheel_speed") else original._replace(
            speed=speed, wheel_speed=np.where(
                original.speed > CREEP_SPEED, original.wheel_speed * speed / np.maximum(original.speed, CREEP_SPEED), original.wheel_speed))
        next_original = self.mapping.vehicle.advance(prepared.original, original, Command(throttle, brake=np.zeros_like(throttle)))
        torque = prepared.engine_mass * ((next_original.speed - speed) / prepared.step + prepared.slope.back) * prepared.engine_radius
        torque = np.where(torque > 0, torque * parameters.drive_ratio, torque)
        resistance = (radius * (parameters.drag + parameters.air_drag * state.speed) * state.speed
                      + parameters.wheel_damping * state.speed / radius)
        return next_original, torque - resistance
