"""How each characteristic of our vehicles is represented by parameters of the second model, with units and equations.

Each shipped vehicle has a table; the second model cannot represent characteristics without a row in that table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import msgspec
import numpy as np

from safevar_sumo.analysis.opinion.multi_body import WHEEL_COUNT, Plant, build_plant, load_commonroad
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
SENSOR_PARAMETER, SAME_EQUATION = "the same sensors before the driving system", "as here"


class MapRow(NamedTuple):
    """A characteristic, the parameter of the second model that represents it, and the equation between them."""

    characteristic: str
    unit: str
    parameter: str
    parameter_unit: str
    equation: str


class SecondParameters(NamedTuple):
    """N vehicles as parameters of the second model.

    `brake_delay` [s], `brake_rise`, `brake_fall` [1/s] and `brake_lag` [s] lead from the brake's command to its torque: a dead time, rates,
    a first-order lag. `drag` [N s/m], `air_drag` [N s^2/m^2] and `wheel_damping` of all wheels [N m s] are resistances in addition to those
    of the original vehicle. `drive` is the engine's torque divided by the original engine's.
    """

    plant: Plant
    brake_delay: FloatArray
    brake_rise: FloatArray
    brake_fall: FloatArray
    brake_lag: FloatArray
    drag: FloatArray
    air_drag: FloatArray
    wheel_damping: FloatArray
    drive: FloatArray


class Surface(NamedTuple):
    """Friction factor and slope of the road, and whether it is wet."""

    friction: Any
    slope: Slope
    wet: bool | BoolArray


def _fill_parameters(plant: Plant, **values: Any) -> SecondParameters:
    """Parameters with a plant and values; those without a value have no effect."""
    defaults: dict[str, Any] = {"brake_delay": 0.0, "brake_rise": np.inf, "brake_fall": np.inf, "brake_lag": 0.0, "drag": 0.0,
                                "air_drag": 0.0, "wheel_damping": 0.0, "drive": 1.0}
    ones = np.ones_like(plant.mass)
    return SecondParameters(plant, **{name: np.asarray(value, dtype=float) * ones for name, value in {**defaults, **values}.items()})


def _represent_worn(vehicle: WornVehicle, setting: Characteristics, original: Mapping[str, float], surface: Surface) -> SecondParameters:
    bmw, prepared = load_commonroad(), vehicle.prepare(setting, surface.friction, 1.0, surface.slope, surface.wet)
    brake_torque = _brake_torque_of(setting["brakeTorque"] * vehicle.brake_force, vehicle.kerb_mass + original["payload"])
    return _fill_parameters(
        build_plant(prepared.mass, vehicle.kerb_mass, surface.slope, centre=prepared.rear_load * vehicle.wheelbase,
                    wheelbase=vehicle.wheelbase, height=vehicle.centre_height, radius=bmw.R_w, wheel_inertia=bmw.I_y_w,
                    friction=prepared.grip, brake_front=vehicle.front_share, drive_front=bmw.T_se, brake_torque=brake_torque),
        brake_delay=setting["brakeResponse"])


def _brake_torque_of(force: FloatArray, mass: float) -> FloatArray:
    """The torque of all wheels [N m] that brakes a vehicle of this mass [kg] as a force on its body [N] would; it also stops the wheels."""
    bmw = load_commonroad()
    return np.asarray(force * bmw.R_w * (1 + WHEEL_COUNT * bmw.I_y_w / (mass * bmw.R_w**2)))


def _represent_carla(vehicle: Carla, setting: Characteristics, original: Mapping[str, float], surface: Surface) -> SecondParameters:
    radius = METRES_PER_CM * setting["radius"]
    return _fill_parameters(
        build_plant(setting["mass"], original["mass"], surface.slope, radius=radius, wheel_inertia=0.5 * WHEEL_MASS * radius**2,
                    friction=setting["tireFric"] * vehicle.tyre_friction * surface.friction,
                    brake_torque=WHEEL_COUNT * setting["maxBrakeTorque"], brake_front=0.5, drive_front=0.5),
        brake_rise=vehicle.brake_rise, brake_fall=vehicle.brake_fall,
        air_drag=0.5 * AIR_DENSITY * FRONTAL_AREA * (setting["dragCoeff"] - original["dragCoeff"]),
        wheel_damping=WHEEL_COUNT * (setting["dampRate"] - original["dampRate"]))


def _represent_lgsvl(vehicle: Lgsvl, setting: Characteristics, original: Mapping[str, float], surface: Surface) -> SecondParameters:
    counted_wheels = WHEEL_COUNT * vehicle.wheel_mass_share
    return _fill_parameters(
        build_plant(setting["mass"] + counted_wheels * setting["wheelMass"], original["mass"] + counted_wheels * original["wheelMass"],
                    surface.slope, radius=setting["radius"], wheel_inertia=0.5 * setting["wheelMass"] * setting["radius"]**2,
                    friction=FRICTION * surface.friction, brake_torque=WHEEL_COUNT * setting["maxBrakeTorque"], brake_front=0.5,
                    drive_front=0.5),
        brake_lag=vehicle.pedal_lag, drag=setting["tireDragCoeff"] - original["tireDragCoeff"],
        wheel_damping=WHEEL_COUNT * vehicle.wheel_damping_share * (setting["wheelDamping"] - original["wheelDamping"]))


def _represent_sumo(vehicle: SumoVehicle, setting: Characteristics, original: Mapping[str, float], surface: Surface) -> SecondParameters:
    bmw, brake_force = load_commonroad(), vehicle.reference_mass * setting["decel"] * setting["brakeGain"]
    return _fill_parameters(
        build_plant(setting["mass"], original["mass"], surface.slope, radius=bmw.R_w, wheel_inertia=bmw.I_y_w,
                    friction=vehicle.tyre_friction * surface.friction, brake_front=bmw.T_sb, drive_front=bmw.T_se,
                    brake_torque=_brake_torque_of(brake_force, original["mass"])),
        brake_delay=setting["brakeDelay"], brake_lag=setting["tau"], drive=setting["accel"] / original["accel"])


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
    rows: tuple[MapRow, ...]
    omission_reasons: Mapping[str, str]
    represent: Callable[[Any, Characteristics, Mapping[str, float], Surface], SecondParameters]

    @property
    def represented_names(self) -> frozenset[str]:
        """The characteristics that the second model represents."""
        return frozenset(row.characteristic for row in self.rows)


NO_ENGINE = "the model takes a torque at the wheels: it has no engine, clutch or gearbox"
DEAD_TIME = "dead time from command to brake torque"
MAPPING_TABLES: Mapping[str, MappingTable] = {
    "worn": MappingTable("wear", (
        MapRow("treadDepth", "mm", "p_dx1", "-", "p_dx1 = mu, our friction coefficient of tyre, road and tread"),
        MapRow("brakeTorque", "-", "T_B", "N m", "T_B = brakeTorque brake_force R_w (1 + 4 I_y_w / (m_0 R_w^2)), m_0 the original's m"),
        MapRow("brakeResponse", "s", DEAD_TIME, "s", SAME_EQUATION),
        MapRow("payload", "kg", "m, m_s", "kg", "m = kerb_mass + payload; m_s = m - m_uf - m_ur"),
        MapRow("payloadCentre", "m", "a, b", "m", "a = (m x - m_ur L) / m_s, b = L - a; x common centre from the front axle, L wheelbase"),
        MapRow("sensorRange", "m", SENSOR_PARAMETER, "m", SAME_EQUATION),
        MapRow("sensorLatency", "s", SENSOR_PARAMETER, "s", SAME_EQUATION)), {}, _represent_worn),
    "carla": MappingTable("sun", (
        MapRow("mass", "kg", "m, m_s", "kg", "m = mass; m_s = m - m_uf - m_ur"),
        MapRow("tireFric", "-", "p_dx1", "-", "p_dx1 = tireFric tyre_friction f, f the road's factor"),
        MapRow("radius", "cm", "R_w, I_y_w", "m, kg m^2", "R_w = radius / 100; I_y_w = 20 kg R_w^2 / 2; and the camera's height as here"),
        MapRow("maxBrakeTorque", "N m", "T_B", "N m", "T_B = 4 maxBrakeTorque, T_sb = 0.5"),
        MapRow("dampRate", "kg m^2/s", "torque on the wheels", "N m", "-4 (dampRate - original) omega"),
        MapRow("dragCoeff", "-", "torque on the wheels", "N m", "-R_w (dragCoeff - original) rho A v^2 / 2, rho 1.2 kg/m^3, A 2.2 m^2")),
        dict.fromkeys(("max_rpm", "dampRateFullT", "dampRateZeroT_CE", "dampRateZeroT_CD", "gearSwitchTime", "clutchStrength"), NO_ENGINE),
        _represent_carla),
    "lgsvl": MappingTable("lgsvl", (
        MapRow("mass", "kg", "m, m_s", "kg", "m = mass + 4 wheel_mass_share wheelMass; m_s = m - m_uf - m_ur"),
        MapRow("wheelMass", "kg", "I_y_w, m", "kg m^2, kg", "I_y_w = wheelMass R_w^2 / 2; m as above"),
        MapRow("radius", "m", "R_w, I_y_w", "m, kg m^2", "R_w = radius"),
        MapRow("maxBrakeTorque", "N m", "T_B", "N m", "T_B = 4 maxBrakeTorque, T_sb = 0.5"),
        MapRow("tireDragCoeff", "-", "torque on the wheels", "N m", "-R_w (tireDragCoeff - original) v"),
        MapRow("wheelDamping", "kg m^2/s", "torque on the wheels", "N m", "-4 wheel_damping_share (wheelDamping - original) omega")),
        {**dict.fromkeys(("maxRpm", "minRpm", "maxMotorTorque", "shiftTime", "tractionControlSlipLimit"), NO_ENGINE),
         "maxSteeringAngle": "the model drives straight here"}, _represent_lgsvl),
    "sumo": MappingTable("native", (
        MapRow("mass", "kg", "m, m_s", "kg", "m = mass; m_s = m - m_uf - m_ur"),
        MapRow("accel", "m/s^2", "T_E", "N m", "T_E = the original's accel / original"),
        MapRow("decel", "m/s^2", "T_B", "N m", "T_B = brakeGain decel reference_mass R_w (1 + 4 I_y_w / (m_0 R_w^2)), m_0 as above"),
        MapRow("brakeGain", "-", "T_B", "N m", "as decel"),
        MapRow("brakeDelay", "s", DEAD_TIME, "s", SAME_EQUATION),
        MapRow("tau", "s", "first-order lag of the brake torque", "s", SAME_EQUATION),
        MapRow("sensorRange", "m", SENSOR_PARAMETER, "m", SAME_EQUATION),
        MapRow("reactionTime", "s", SENSOR_PARAMETER, "s", SAME_EQUATION)),
        {"maxSpeed": "the model has no governor"}, _represent_sumo),
}
"""Tables by the names of shipped vehicles."""


class VehicleMapping(NamedTuple):
    """Mapping of a study's vehicle: name and table of the shipped vehicle that fits it, and that vehicle with the study's parameters.

    `unknown_names` lists characteristics whose name or unit the shipped vehicle does not have.
    """

    name: str
    vehicle: Any
    table: MappingTable
    unknown_names: tuple[str, ...]

    def reasons_to_omit(self, changes: Mapping[str, float]) -> list[str]:
        """The reason for each changed characteristic that cannot be represented; empty if all can."""
        return [f"{name}: {self.table.omission_reasons.get(name, 'no parameter of the second model is known for it')}" for name in changes
                if name not in self.table.represented_names or name in self.unknown_names]


def map_vehicle(study: Study, vehicle: Any) -> VehicleMapping:
    """Map a study's vehicle: a shipped vehicle, a class derived from one, or user code with all characteristics of a shipped one.

    Raises
    ------
    InputError
        If no table fits the vehicle.
    """
    model = vehicle.model if isinstance(vehicle, GuardedVehicle) else vehicle
    units = {name: row.unit for name, row in study.vehicle.characteristics.items()}
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
