"""The second vehicle model replaces ours in the simulation: it takes the driving system's commands and returns speeds.

Its sensors are the study's; its engine torque comes from our original vehicle, which is simulated in parallel with the
same pedal at the same speed. Brakes, tyres, axles and body are the second model's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.questions.multi_body import (
    LONGEST_STEP,
    WHEEL_COUNT,
    MultiBodyState,
    Plant,
    advance,
    balanced_state,
    build_plant,
    load_bmw_parameters,
)
from safevar_sumo.records import BoolArray, Command, FloatArray, JsonObject, Observation, Quantity
from safevar_sumo.study import Study, load_study
from safevar_sumo.vehicles import LEVEL, VEHICLES, Carla, Sensors, Slope, SumoType, Vehicle
from safevar_sumo.vehicles.base import Characteristics, State
from safevar_sumo.vehicles.carla import AIR_DENSITY, FRONTAL_AREA, WHEEL_MASS
from safevar_sumo.vehicles.lgsvl import FRICTION, Lgsvl
from safevar_sumo.vehicles.sensing import SumoVehicle, WornVehicle
from safevar_sumo.vehicles.sensors import DelayedSignal

METRES_PER_CM = 0.01  # m


class Road(NamedTuple):
    """The road as `Vehicle.prepare` gets it: its factor on the tyres' friction (of all N vehicles, or shape (N,)), its
    slope, and the water on it [mm].
    """

    friction: Quantity
    slope: Slope
    water: float | FloatArray


def _brakes_for(force: FloatArray, mass: float) -> JsonObject:
    """The package's wheels, and brakes that decelerate a vehicle of `mass` [kg] with them by `force` / `mass`: they
    also brake the wheels, whose inertia is that of `wheel_inertia` / `radius`^2 each.
    """
    bmw = load_bmw_parameters()
    return {
        "radius": bmw.R_w,
        "wheel_inertia": bmw.I_y_w,
        "brake_torque": force * bmw.R_w * (1 + WHEEL_COUNT * bmw.I_y_w / (mass * bmw.R_w**2)),
    }


def _represent_worn(vehicle: WornVehicle, values: Characteristics, original: Mapping[str, float], road: Road) -> Plant:
    # What is read here does not depend on the step of 1 s: mass, grip, and the rear axle's share of the weight.
    prepared = vehicle.prepare(values, road.friction, 1.0, road.slope, road.water)
    return build_plant(
        prepared.mass,
        vehicle.kerb_mass,
        road.slope,
        centre=prepared.rear_load * vehicle.wheelbase,
        wheelbase=vehicle.wheelbase,
        height=vehicle.centre_height,
        friction=vehicle.friction(prepared, np.zeros_like(prepared.mass)),
        front_brake_share=vehicle.front_share,
        front_drive_share=load_bmw_parameters().T_se,
        brake_delay=values["brakeResponse"],
        **_brakes_for(values["brakeTorque"] * vehicle.brake_force, vehicle.kerb_mass + original["payload"]),
    )


def _represent_carla(vehicle: Carla, values: Characteristics, original: Mapping[str, float], road: Road) -> Plant:
    radius = METRES_PER_CM * values["radius"]
    return build_plant(
        values["mass"],
        original["mass"],
        road.slope,
        radius=radius,
        wheel_inertia=0.5 * WHEEL_MASS * radius**2,  # a disc
        friction=values["tireFric"] * vehicle.tyre_friction * road.friction,
        brake_torque=WHEEL_COUNT * values["maxBrakeTorque"],
        brake_rise=vehicle.brake_rise,
        brake_fall=vehicle.brake_fall,
        # The original's own losses are in the torque of its engine.
        air_drag=0.5 * AIR_DENSITY * FRONTAL_AREA * (values["dragCoeff"] - original["dragCoeff"]),
        wheel_damping=WHEEL_COUNT * (values["dampRate"] - original["dampRate"]),
    )


def _represent_lgsvl(vehicle: Lgsvl, values: Characteristics, original: Mapping[str, float], road: Road) -> Plant:
    wheels = WHEEL_COUNT * vehicle.wheel_mass_share
    return build_plant(
        values["mass"] + wheels * values["wheelMass"],
        original["mass"] + wheels * original["wheelMass"],
        road.slope,
        radius=values["radius"],
        wheel_inertia=0.5 * values["wheelMass"] * values["radius"] ** 2,
        friction=FRICTION * road.friction,
        brake_torque=WHEEL_COUNT * values["maxBrakeTorque"],
        brake_lag=vehicle.pedal_lag,
        drag=values["tireDragCoeff"] - original["tireDragCoeff"],
        wheel_damping=WHEEL_COUNT * vehicle.wheel_damping_share * (values["wheelDamping"] - original["wheelDamping"]),
    )


def _represent_sumo(vehicle: SumoVehicle, values: Characteristics, original: Mapping[str, float], road: Road) -> Plant:
    bmw = load_bmw_parameters()
    return build_plant(
        values["mass"],
        original["mass"],
        road.slope,
        friction=vehicle.tyre_friction * road.friction,
        front_brake_share=bmw.T_sb,
        front_drive_share=bmw.T_se,
        brake_delay=values["brakeDelay"],
        brake_lag=values["actuatorLag"],
        drive_ratio=values["accel"] / original["accel"],
        **_brakes_for(vehicle.reference_mass * values["decel"] * values["brakeGain"], original["mass"]),
    )


Represent = Callable[[Any, Characteristics, Mapping[str, float], Road], Plant]
MAPPINGS: Mapping[str, tuple[str, Represent]] = {
    "worn": ("wear", _represent_worn),
    "carla": ("sun", _represent_carla),
    "lgsvl": ("lgsvl", _represent_lgsvl),
    "sumo": ("native", _represent_sumo),
}
"""By the name of a shipped vehicle: a shipped study, which has the original value of each of its characteristics, and
the equations (docs/opinion.md).
"""
NO_ENGINE = "the model takes a torque at the wheels: it has no engine, clutch or gearbox"
CARLA_ENGINE = ("max_rpm", "dampRateFullT", "dampRateZeroT_CE", "dampRateZeroT_CD", "gearSwitchTime", "clutchStrength")
LGSVL_ENGINE = ("maxRpm", "minRpm", "maxMotorTorque", "shiftTime", "tractionControlSlipLimit")
OUTSIDE: Mapping[str, str] = {
    **dict.fromkeys((*CARLA_ENGINE, *LGSVL_ENGINE), NO_ENGINE),
    "maxSteeringAngle": "the second model drives straight, without steering",
    "maxSpeed": "the model has no governor",
    "sensorAngle": "the model has no direction of its sensors",
    "sensorDropout": "the model's sensors lose no frames",
}
"""Characteristics that the second model cannot represent, each with the reason."""

SPIN_LIMIT = 1.0
"""Speed of a rim above the car's from which the wheels spin [m/s]: such a simulation confirms nothing."""
CREEP_SPEED = 0.01
"""Speed above which the original vehicle's wheel speed is scaled with its speed [m/s]."""


class Prepared(NamedTuple):
    """Constants of N vehicles: the study's vehicle, for its sensors; the original, for its engine; the second model.

    `engine_mass` is the mass that the original's engine moves, with its wheels [kg]; `engine_radius` their radius [m].
    `settings`, shape (N, n), tell the vehicles apart.
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
    vehicle: State
    original: State
    body: MultiBodyState
    brake_commands: DelayedSignal


class SecondVehicle(Vehicle):
    """A vehicle of the second model for every setting of a study; the contract is `safevar_sumo.vehicles.Vehicle`.

    Raises
    ------
    InputError
        If the vehicle says by no `second_model` how it is represented.
    """

    def __init__(self, vehicle: Vehicle, study: Study) -> None:
        self._vehicle = vehicle
        self.UNITS = vehicle.UNITS
        self._spinning = set[bytes]()  # settings
        if vehicle.second_model not in MAPPINGS:
            problem = f"vehicle.model = {study.vehicle.model!r} is no vehicle that the second model can represent"
            raise InputError(study.source, problem, f"one of {', '.join(MAPPINGS)}, or a class derived from one")
        cls = VEHICLES[vehicle.second_model]
        shipped, self._represent = MAPPINGS[vehicle.second_model]
        self._engine = cls(**{key: getattr(vehicle, key) for key in cls.__struct_fields__})
        rows = study.vehicle.characteristics.items()
        matching = {name: row.original for name, row in rows if cls.UNITS.get(name) == row.unit}
        originals = {name: row.original for name, row in load_study(shipped).vehicle.characteristics.items()}
        self._original = originals | matching
        self._matching = matching.keys()

    def has_spun(self, setting: FloatArray) -> bool:
        """Whether the wheels of a vehicle, shape (n,), spun in a simulation so far."""
        return setting.tobytes() in self._spinning

    def reasons_to_omit(self, changes: Mapping[str, float]) -> list[str]:
        """The reason for each changed characteristic that cannot be represented; empty if all can."""
        unknown = "no parameter of the second model is known for it"
        return [
            f"{name}: {OUTSIDE.get(name, unknown)}" for name in changes if name in OUTSIDE or name not in self._matching
        ]

    def prepare(
        self,
        characteristics: Characteristics,
        road_friction: Quantity,
        step: float,
        slope: Slope = LEVEL,
        water: float | FloatArray = 0.0,
    ) -> Prepared:
        road = Road(road_friction, slope, water)
        settings = np.stack([*characteristics.values()], axis=1)
        original = {name: np.full(len(settings), value) for name, value in self._original.items()}
        represented = original | {name: characteristics[name] for name in self._matching}
        plant = self._represent(self._engine, represented, self._original, road)
        original_plant = self._represent(self._engine, original, self._original, road)
        return Prepared(
            vehicle=self._vehicle.prepare(characteristics, road_friction, step, slope, water),
            original=self._engine.prepare(original, road_friction, step, slope, water),
            plant=plant,
            engine_mass=original_plant.mass + WHEEL_COUNT * original_plant.wheel_inertia / original_plant.radius**2,
            engine_radius=original_plant.radius,
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
        commands = DelayedSignal.of(original.brake, prepared.plant.brake_delay, prepared.step)
        vehicle = self._vehicle.at_start(prepared.vehicle, speed)
        body = balanced_state(prepared.plant, speed)
        return SecondState(speed, original.throttle, original.brake, original.gear, vehicle, original, body, commands)

    def sensors(self, prepared: Prepared) -> Sensors | None:
        return self._vehicle.sensors(prepared.vehicle)

    def sense(self, prepared: Prepared, state: SecondState, seen: Observation) -> tuple[Observation, SecondState]:
        observation, vehicle = self._vehicle.sense(prepared.vehicle, state.vehicle, seen)
        return observation, state._replace(vehicle=vehicle)

    def hold_gear(self, prepared: Prepared, state: SecondState, holds: BoolArray) -> SecondState:
        return state._replace(original=self._engine.hold_gear(prepared.original, state.original, holds))

    def advance(self, prepared: Prepared, state: SecondState, command: Command) -> SecondState:
        plant = prepared.plant
        body = state.body
        brake = state.brake
        friction = self._engine.friction(prepared.vehicle, state.speed)
        if friction is not None:
            plant = plant._replace(friction=friction)
        original, drive_torque = self._advance_engine(prepared, state, command.throttle)
        commands = state.brake_commands.extended(command.brake)
        demand = commands.delayed()
        step_count = math.ceil(prepared.step / LONGEST_STEP)
        step = prepared.step / step_count
        lag_share = step / (step + plant.brake_lag)
        for _ in range(step_count):
            change = (demand - brake) * lag_share
            brake = brake + np.minimum(np.maximum(change, -plant.brake_fall * step), plant.brake_rise * step)
            body = advance(plant, body, brake, drive_torque, step)
        spins = np.max(body.wheel_speeds * plant.radius, axis=0) > body.speed + SPIN_LIMIT
        self._spinning.update(setting.tobytes() for setting in prepared.settings[spins])
        return SecondState(body.speed, original.throttle, brake, original.gear, state.vehicle, original, body, commands)

    def _advance_engine(self, prepared: Prepared, state: SecondState, throttle: FloatArray) -> tuple[State, FloatArray]:
        """The original vehicle one step later, and the torque of its engine and all drags on all wheels [N m]."""
        plant = prepared.plant
        radius = prepared.plant.radius
        speed = state.speed
        original = state.original
        # The speed at which the original's wheels turn as fast as the second model's.
        original_speed = speed * prepared.engine_radius / radius
        if hasattr(original, "wheel_speed"):  # `carla` and `lgsvl` have wheels
            wheel_speed = original.wheel_speed * original_speed / np.maximum(original.speed, CREEP_SPEED)
            wheel_speed = np.where(original.speed > CREEP_SPEED, wheel_speed, original.wheel_speed)
            original = original._replace(wheel_speed=wheel_speed)
        command = Command(throttle, brake=np.zeros_like(throttle))
        original = self._engine.advance(prepared.original, original._replace(speed=original_speed), command)
        acceleration = (original.speed - original_speed) / prepared.step
        torque = prepared.engine_mass * (acceleration + prepared.slope.back) * prepared.engine_radius
        resistance = radius * (plant.drag + plant.air_drag * speed) * speed + plant.wheel_damping * speed / radius
        return original, np.where(torque > 0, torque * plant.drive_ratio, torque) - resistance
