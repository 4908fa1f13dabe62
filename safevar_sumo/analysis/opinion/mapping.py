"""How each characteristic of our vehicles is represented by parameters of the second model, with units and equations.

Each shipped vehicle has a table; the second model cannot represent characteristics without a row in that table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import msgspec
import numpy as np

from safevar_sumo.analysis.opinion.multi_body import WHEEL_COUNT, Plant, build_plant, load_bmw_parameters
from safevar_sumo.errors import InputError
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import Study, load_study
from safevar_sumo.vehicles import VEHICLES, Carla, GuardedVehicle, Slope
from safevar_sumo.vehicles.base import Characteristics
from safevar_sumo.vehicles.carla import AIR_DENSITY, FRONTAL_AREA, WHEEL_MASS
from safevar_sumo.vehicles.lgsvl import FRICTION, Lgsvl
from safevar_sumo.vehicles.sumo import SumoVehicle
from safevar_sumo.vehicles.worn import WornVehicle

METRES_PER_CM = 0.01  # m
OUR_SENSORS, OUR_EQUATION = "none: our sensor model stays", "as in our vehicle model"


class MappingRow(NamedTuple):
    """A characteristic, the parameter of the second model that represents it, and the equation between them."""

    characteristic: str
    unit: str
    parameter: str
    parameter_unit: str
    equation: str


class SecondModelParameters(NamedTuple):
    """N vehicles as parameters of the second model.

    The brake pedal follows its command after the dead time `brake_delay` [s], as a first-order lag with the time constant `brake_lag` [s],
    at most at the rates `brake_rise` and `brake_fall` [1/s]. `drag` [N s/m], `air_drag` [N s^2/m^2] and `wheel_damping` of all wheels
    [N m s] are resistances in addition to those of the original vehicle. `drive_ratio` multiplies the original engine's driving torque.
    """

    plant: Plant
    brake_delay: FloatArray
    brake_rise: FloatArray
    brake_fall: FloatArray
    brake_lag: FloatArray
    drag: FloatArray
    air_drag: FloatArray
    wheel_damping: FloatArray
    drive_ratio: FloatArray


class Surface(NamedTuple):
    """Friction factor and slope of the road, and whether it is wet."""

    friction: Any
    slope: Slope
    wet: bool | BoolArray


def _fill_parameters(plant: Plant, **values: Any) -> SecondModelParameters:
    """Parameters from a plant and values; parameters that are not given have no effect."""
    defaults: dict[str, Any] = {"brake_delay": 0.0, "brake_rise": np.inf, "brake_fall": np.inf, "brake_lag": 0.0, "drag": 0.0,
                                "air_drag": 0.0, "wheel_damping": 0.0, "drive_ratio": 1.0}
    ones = np.ones_like(plant.mass)
    return SecondModelParameters(plant, **{name: np.asarray(value, dtype=float) * ones for name, value in {**defaults, **values}.items()})


def _represent_worn(vehicle: WornVehicle, setting: Characteristics, original: Mapping[str, float],
                    surface: Surface) -> SecondModelParameters:
    # Mass, grip and rear_load, the rear axle's share of the weight, do not depend on the step.
    bmw, prepared = load_bmw_parameters(), vehicle.prepare(setting, surface.friction, step=1.0, slope=surface.slope, wet=surface.wet)
    brake_torque = _brake_torque_for(setting["brakeTorque"] * vehicle.brake_force, vehicle.kerb_mass + original["payload"])
    return _fill_parameters(
        build_plant(prepared.mass, unladen_mass=vehicle.kerb_mass, slope=surface.slope, centre=prepared.rear_load * vehicle.wheelbase,
                    wheelbase=vehicle.wheelbase, height=vehicle.centre_height, radius=bmw.R_w, wheel_inertia=bmw.I_y_w,
                    friction=prepared.grip, front_brake_share=vehicle.front_share, front_drive_share=bmw.T_se, brake_torque=brake_torque),
        brake_delay=setting["brakeResponse"])


def _brake_torque_for(force: FloatArray, mass: float) -> FloatArray:
    """Torque of all brakes [N m] that decelerates a vehicle of this mass [kg] and its turning wheels by `force` / `mass` [N / kg]."""
    bmw = load_bmw_parameters()
    return np.asarray(force * bmw.R_w * (1 + WHEEL_COUNT * bmw.I_y_w / (mass * bmw.R_w**2)))


def _represent_carla(vehicle: Carla, setting: Characteristics, original: Mapping[str, float], surface: Surface) -> SecondModelParameters:
    radius = METRES_PER_CM * setting["radius"]
    return _fill_parameters(
        build_plant(setting["mass"], unladen_mass=original["mass"], slope=surface.slope, radius=radius,
                    wheel_inertia=0.5 * WHEEL_MASS * radius**2, friction=setting["tireFric"] * vehicle.tyre_friction * surface.friction,
                    brake_torque=WHEEL_COUNT * setting["maxBrakeTorque"], front_brake_share=0.5, front_drive_share=0.5),
        brake_rise=vehicle.brake_rise, brake_fall=vehicle.brake_fall,
        air_drag=0.5 * AIR_DENSITY * FRONTAL_AREA * (setting["dragCoeff"] - original["dragCoeff"]),
        wheel_damping=WHEEL_COUNT * (setting["dampRate"] - original["dampRate"]))


def _represent_lgsvl(vehicle: Lgsvl, setting: Characteristics, original: Mapping[str, float], surface: Surface) -> SecondModelParameters:
    effective_wheel_count = WHEEL_COUNT * vehicle.wheel_mass_share
    return _fill_parameters(
        build_plant(setting["mass"] + effective_wheel_count * setting["wheelMass"],
                    unladen_mass=original["mass"] + effective_wheel_count * original["wheelMass"], slope=surface.slope,
                    radius=setting["radius"], wheel_inertia=0.5 * setting["wheelMass"] * setting["radius"]**2,
                    friction=FRICTION * surface.friction, brake_torque=WHEEL_COUNT * setting["maxBrakeTorque"],
                    front_brake_share=0.5, front_drive_share=0.5),
        brake_lag=vehicle.pedal_lag, drag=setting["tireDragCoeff"] - original["tireDragCoeff"],
        wheel_damping=WHEEL_COUNT * vehicle.wheel_damping_share * (setting["wheelDamping"] - original["wheelDamping"]))


def _represent_sumo(vehicle: SumoVehicle, setting: Characteristics, original: Mapping[str, float],
                    surface: Surface) -> SecondModelParameters:
    bmw, brake_force = load_bmw_parameters(), vehicle.reference_mass * setting["decel"] * setting["brakeGain"]
    return _fill_parameters(
        build_plant(setting["mass"], unladen_mass=original["mass"], slope=surface.slope, radius=bmw.R_w, wheel_inertia=bmw.I_y_w,
                    friction=vehicle.tyre_friction * surface.friction, front_brake_share=bmw.T_sb, front_drive_share=bmw.T_se,
                    brake_torque=_brake_torque_for(brake_force, original["mass"])),
        brake_delay=setting["brakeDelay"], brake_lag=setting["tau"], drive_ratio=setting["accel"] / original["accel"])


class MappingTable(NamedTuple):
    """The mapping of a shipped vehicle.

    Attributes
    ----------
    study
        A shipped study with the vehicle; the study supplies parameters that a vehicle of user code lacks.
    rows
        The characteristics that the second model represents.
    omission_reasons
        Characteristics that the second model cannot represent, each with the reason.
    represent
        The equations of the rows.
    """

    study: str
    rows: tuple[MappingRow, ...]
    omission_reasons: Mapping[str, str]
    represent: Callable[[Any, Characteristics, Mapping[str, float], Surface], SecondModelParameters]

    @property
    def represented_names(self) -> frozenset[str]:
        """The characteristics that the second model represents."""
        return frozenset(row.characteristic for row in self.rows)


NO_ENGINE = "the model takes a torque at the wheels: it has no engine, clutch or gearbox"
DEAD_TIME = "dead time from command to brake torque"
MAPPING_TABLES: Mapping[str, MappingTable] = {
    "worn": MappingTable("wear", (
        MappingRow("treadDepth", "mm", "p_dx1", "-", "p_dx1 = our friction coefficient, from tyre_friction, road and tread"),
        MappingRow("brakeTorque", "-", "T_B", "N m", "T_B = brakeTorque * brake_force * R_w * (1 + 4 I_y_w / (m_0 R_w^2))"),
        MappingRow("brakeResponse", "s", DEAD_TIME, "s", OUR_EQUATION),
        MappingRow("payload", "kg", "m, m_s", "kg", "m = kerb_mass + payload; m_s = m - m_uf - m_ur"),
        MappingRow("payloadCentre", "m", "a, b", "m", "a = (m x - m_ur L) / m_s, b = L - a; L: wheelbase; "
                   "x: distance of the centre of mass of car and payload from the front axle"),
        MappingRow("sensorRange", "m", OUR_SENSORS, "m", OUR_EQUATION),
        MappingRow("sensorLatency", "s", OUR_SENSORS, "s", OUR_EQUATION)), {}, _represent_worn),
    "carla": MappingTable("sun", (
        MappingRow("mass", "kg", "m, m_s", "kg", "m = mass; m_s = m - m_uf - m_ur"),
        MappingRow("tireFric", "-", "p_dx1", "-", "p_dx1 = tireFric * tyre_friction * f; f: the road's friction factor"),
        MappingRow("radius", "cm", "R_w, I_y_w", "m, kg m^2", "R_w = radius / 100; I_y_w = 20 kg * R_w^2 / 2; camera as in our model"),
        MappingRow("maxBrakeTorque", "N m", "T_B", "N m", "T_B = 4 maxBrakeTorque, T_sb = 0.5"),
        MappingRow("dampRate", "kg m^2/s", "torque on the wheels", "N m", "-4 * (dampRate - dampRate_0) * omega"),
        MappingRow("dragCoeff", "-", "torque on the wheels", "N m", "-R_w * (dragCoeff - dragCoeff_0) * 1.2 kg/m^3 * 2.2 m^2 * v^2 / 2")),
        dict.fromkeys(("max_rpm", "dampRateFullT", "dampRateZeroT_CE", "dampRateZeroT_CD", "gearSwitchTime", "clutchStrength"), NO_ENGINE),
        _represent_carla),
    "lgsvl": MappingTable("lgsvl", (
        MappingRow("mass", "kg", "m, m_s", "kg", "m = mass + 4 * wheel_mass_share * wheelMass; m_s = m - m_uf - m_ur"),
        MappingRow("wheelMass", "kg", "I_y_w, m", "kg m^2, kg", "I_y_w = wheelMass * R_w^2 / 2; m as for mass"),
        MappingRow("radius", "m", "R_w, I_y_w", "m, kg m^2", "R_w = radius"),
        MappingRow("maxBrakeTorque", "N m", "T_B", "N m", "T_B = 4 maxBrakeTorque, T_sb = 0.5"),
        MappingRow("tireDragCoeff", "-", "torque on the wheels", "N m", "-R_w * (tireDragCoeff - tireDragCoeff_0) * v"),
        MappingRow("wheelDamping", "kg m^2/s", "torque on the wheels", "N m",
                   "-4 * wheel_damping_share * (wheelDamping - wheelDamping_0) * omega")),
        {**dict.fromkeys(("maxRpm", "minRpm", "maxMotorTorque", "shiftTime", "tractionControlSlipLimit"), NO_ENGINE),
         "maxSteeringAngle": "the second model drives straight, without steering"}, _represent_lgsvl),
    "sumo": MappingTable("native", (
        MappingRow("mass", "kg", "m, m_s", "kg", "m = mass; m_s = m - m_uf - m_ur"),
        MappingRow("accel", "m/s^2", "T_E", "N m", "T_E = T_E_0 * accel / accel_0"),
        MappingRow("decel", "m/s^2", "T_B", "N m", "T_B = brakeGain * decel * reference_mass * R_w * (1 + 4 I_y_w / (m_0 R_w^2))"),
        MappingRow("brakeGain", "-", "T_B", "N m", "as for decel"),
        MappingRow("brakeDelay", "s", DEAD_TIME, "s", OUR_EQUATION),
        MappingRow("tau", "s", "first-order lag of the brake torque", "s", OUR_EQUATION),
        MappingRow("sensorRange", "m", OUR_SENSORS, "m", OUR_EQUATION),
        MappingRow("reactionTime", "s", OUR_SENSORS, "s", OUR_EQUATION)),
        {"maxSpeed": "the model has no governor"}, _represent_sumo),
}
"""Tables by the names of shipped vehicles; in their equations, index 0 marks the original vehicle."""


class VehicleMapping(NamedTuple):
    """Mapping of a study's vehicle: name and table of the shipped vehicle that fits it, and that vehicle with the study's parameters.

    `unmatched_names` lists characteristics of the study that the shipped vehicle lacks or has in another unit.
    """

    name: str
    vehicle: Any
    table: MappingTable
    unmatched_names: tuple[str, ...]

    def reasons_to_omit(self, changes: Mapping[str, float]) -> list[str]:
        """The reason for each changed characteristic that cannot be represented; empty if all can."""
        return [f"{name}: {self.table.omission_reasons.get(name, 'no parameter of the second model is known for it')}" for name in changes
                if name not in self.table.represented_names or name in self.unmatched_names]


def map_vehicle(study: Study, vehicle: Any) -> VehicleMapping:
    """Map a study's vehicle: a shipped vehicle, a class derived from one, or user code with all characteristics of a shipped one.

    Raises
    ------
    InputError
        If no table fits the vehicle.
    """
    model = vehicle.model if isinstance(vehicle, GuardedVehicle) else vehicle  # user code stands behind a guard
    units = {name: characteristic.unit for name, characteristic in study.vehicle.characteristics.items()}
    for name, cls in [*((name, cls) for name, cls in VEHICLES.items() if isinstance(model, cls)),
                      *((name, cls) for name, cls in VEHICLES.items() if cls.UNITS.items() <= units.items())]:
        table = MAPPING_TABLES[name]
        defaults = load_study(table.study).vehicle.parameters
        parameters = {field.name: getattr(
            model, field.name, study.vehicle.parameters.get(field.name, defaults.get(field.name, field.default)))
            for field in msgspec.structs.fields(cls)}
        return VehicleMapping(name, cls(**parameters), table, tuple(key for key, unit in units.items() if cls.UNITS.get(key) != unit))
    alternatives = f"one of {', '.join(MAPPING_TABLES)}, a class derived from one, or one with the same characteristics in the same units"
    problem = f"vehicle.model = {study.vehicle.model!r} with {', '.join(units)} is no vehicle that the second model can represent"
    raise InputError(study.source, problem, alternatives)
