"""How characteristics of our vehicles become parameters of the second model: equations for each shipped vehicle."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from safevar_sumo.analysis.opinion.multi_body import WHEEL_COUNT, Plant, build_plant, load_bmw_parameters
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.vehicles import Carla, Slope
from safevar_sumo.vehicles.base import Characteristics
from safevar_sumo.vehicles.carla import AIR_DENSITY, FRONTAL_AREA, WHEEL_MASS
from safevar_sumo.vehicles.lgsvl import FRICTION, Lgsvl
from safevar_sumo.vehicles.sumo import SumoVehicle
from safevar_sumo.vehicles.worn import WornVehicle

METRES_PER_CM = 0.01  # m


class Road(NamedTuple):
    """The road as `Vehicle.prepare` gets it: its factor on the tyres' friction, its slope, and whether it is wet."""

    friction: Any
    slope: Slope
    wet: bool | BoolArray


def _brakes_for(force: FloatArray, mass: float) -> dict[str, Any]:
    """The package's wheels, and brakes that decelerate a vehicle of `mass` [kg] with them by `force` / `mass`."""
    bmw = load_bmw_parameters()
    return {
        "radius": bmw.R_w,
        "wheel_inertia": bmw.I_y_w,
        "brake_torque": force * bmw.R_w * (1 + WHEEL_COUNT * bmw.I_y_w / (mass * bmw.R_w**2)),
    }


def _represent_worn(vehicle: WornVehicle, c: Characteristics, original: Mapping[str, float], road: Road) -> Plant:
    # Mass, grip and rear_load, the rear axle's share of the weight, do not depend on the step.
    prepared = vehicle.prepare(c, road.friction, 1.0, road.slope, road.wet)
    return build_plant(
        prepared.mass,
        vehicle.kerb_mass,
        road.slope,
        centre=prepared.rear_load * vehicle.wheelbase,
        wheelbase=vehicle.wheelbase,
        height=vehicle.centre_height,
        friction=prepared.grip,
        front_brake_share=vehicle.front_share,
        front_drive_share=load_bmw_parameters().T_se,
        brake_delay=c["brakeResponse"],
        **_brakes_for(c["brakeTorque"] * vehicle.brake_force, vehicle.kerb_mass + original["payload"]),
    )


def _represent_carla(vehicle: Carla, c: Characteristics, original: Mapping[str, float], road: Road) -> Plant:
    radius = METRES_PER_CM * c["radius"]
    return build_plant(
        c["mass"],
        original["mass"],
        road.slope,
        radius=radius,
        wheel_inertia=0.5 * WHEEL_MASS * radius**2,
        friction=c["tireFric"] * vehicle.tyre_friction * road.friction,
        brake_torque=WHEEL_COUNT * c["maxBrakeTorque"],
        brake_rise=vehicle.brake_rise,
        brake_fall=vehicle.brake_fall,
        air_drag=0.5 * AIR_DENSITY * FRONTAL_AREA * (c["dragCoeff"] - original["dragCoeff"]),
        wheel_damping=WHEEL_COUNT * (c["dampRate"] - original["dampRate"]),
    )


def _represent_lgsvl(vehicle: Lgsvl, c: Characteristics, original: Mapping[str, float], road: Road) -> Plant:
    wheels = WHEEL_COUNT * vehicle.wheel_mass_share
    return build_plant(
        c["mass"] + wheels * c["wheelMass"],
        original["mass"] + wheels * original["wheelMass"],
        road.slope,
        radius=c["radius"],
        wheel_inertia=0.5 * c["wheelMass"] * c["radius"] ** 2,
        friction=FRICTION * road.friction,
        brake_torque=WHEEL_COUNT * c["maxBrakeTorque"],
        brake_lag=vehicle.pedal_lag,
        drag=c["tireDragCoeff"] - original["tireDragCoeff"],
        wheel_damping=WHEEL_COUNT * vehicle.wheel_damping_share * (c["wheelDamping"] - original["wheelDamping"]),
    )


def _represent_sumo(vehicle: SumoVehicle, c: Characteristics, original: Mapping[str, float], road: Road) -> Plant:
    bmw = load_bmw_parameters()
    return build_plant(
        c["mass"],
        original["mass"],
        road.slope,
        friction=vehicle.tyre_friction * road.friction,
        front_brake_share=bmw.T_sb,
        front_drive_share=bmw.T_se,
        brake_delay=c["brakeDelay"],
        brake_lag=c["tau"],
        drive_ratio=c["accel"] / original["accel"],
        **_brakes_for(vehicle.reference_mass * c["decel"] * c["brakeGain"], original["mass"]),
    )


class MappingTable(NamedTuple):
    """The mapping of a shipped vehicle to the second model.

    Attributes
    ----------
    study
        A shipped study with the vehicle; the study supplies what a vehicle of user code lacks.
    represent
        The equations, as docs/opinion.md has them.
    outside
        Characteristics that the second model cannot represent, each with the reason.
    """

    study: str
    represent: Callable[[Any, Characteristics, Mapping[str, float], Road], Plant]
    outside: Mapping[str, str]


NO_ENGINE = "the model takes a torque at the wheels: it has no engine, clutch or gearbox"
CARLA_ENGINE = ("max_rpm", "dampRateFullT", "dampRateZeroT_CE", "dampRateZeroT_CD", "gearSwitchTime", "clutchStrength")
LGSVL_ENGINE = ("maxRpm", "minRpm", "maxMotorTorque", "shiftTime", "tractionControlSlipLimit")
MAPPING_TABLES: Mapping[str, MappingTable] = {
    "worn": MappingTable("wear", _represent_worn, {}),
    "carla": MappingTable("sun", _represent_carla, dict.fromkeys(CARLA_ENGINE, NO_ENGINE)),
    "lgsvl": MappingTable(
        "lgsvl",
        _represent_lgsvl,
        {
            **dict.fromkeys(LGSVL_ENGINE, NO_ENGINE),
            "maxSteeringAngle": "the second model drives straight, without steering",
        },
    ),
    "sumo": MappingTable("native", _represent_sumo, {"maxSpeed": "the model has no governor"}),
}
"""Tables by the names of shipped vehicles."""
