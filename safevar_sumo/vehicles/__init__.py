"""Vehicle models by name; and the calibration drive of the original vehicle, which tells an ADS how
the vehicle reacts to its pedals.
"""

from collections.abc import Mapping
from functools import cache, lru_cache, partial
from typing import Any

import numpy as np

from safevar_sumo.records import Command, FloatArray, Nominal, PedalTables
from safevar_sumo.vehicles.base import (
    LEVEL as LEVEL,
    Prepared as Prepared,
    Sensors as Sensors,
    SimulatedVehicle as SimulatedVehicle,
    Slope as Slope,
    SumoType as SumoType,
    Vehicle as Vehicle,
    VehicleState as VehicleState,
    slope_of as slope_of,
)
from safevar_sumo.vehicles.carla import Carla as Carla
from safevar_sumo.vehicles.characteristics import (
    Characteristic as Characteristic,
    CharacteristicSet as CharacteristicSet,
)
from safevar_sumo.vehicles.lgsvl import Lgsvl
from safevar_sumo.vehicles.region import (
    FeasibleRegion as FeasibleRegion,
    region_of as region_of,
)
from safevar_sumo.vehicles.sensing import SumoVehicle, WornVehicle

VEHICLES: Mapping[str, type[Any]] = {
    "carla": Carla,
    "lgsvl": Lgsvl,
    "sumo": SumoVehicle,
    "worn": WornVehicle,
}

DRY_ROAD_FRICTION = 1.0  # -
STEP = 0.1  # s
SPEEDS = np.arange(0.0, 20.5, 0.5)  # m/s, of the tables
LONGEST_DRIVE = 60.0  # s
LIGHT_BRAKE = 0.1  # pedal position while braking, far from the limit of the tyres


def calibration_drive(vehicle: Vehicle, characteristics: CharacteristicSet) -> Nominal:
    """The original vehicle as an ADS knows it, on a dry road. The calibration drive is simulated
    when its tables are first used.
    """
    types = vehicle.sumo_type(prepared_original(vehicle, characteristics))
    mass, accel, decel, max_speed, lag = (float(values[0]) for values in types[:5])
    return Nominal(
        mass=mass,
        accel=accel,
        decel=decel,
        max_speed=max_speed,
        actuator_lag=lag,
        tables=cache(partial(_simulated_tables, vehicle, characteristics)),
    )


def prepared_original(
    vehicle: Vehicle,
    characteristics: CharacteristicSet,
    friction: float = DRY_ROAD_FRICTION,
    **changes: FloatArray,
) -> Prepared:
    """The model's constants of the original vehicle with `changes` of its characteristics.
    `friction` is the factor of the weather on the tyres' friction.
    """
    original = characteristics.columns(characteristics.original_settings)
    return vehicle.prepare(original | changes, friction, STEP)


@lru_cache(maxsize=4)
def _simulated_tables(
    vehicle: Vehicle, characteristics: CharacteristicSet
) -> PedalTables:
    """Tables from three drives of the original vehicle: it accelerates at full throttle to the
    highest speed of the tables; from there it coasts in one drive, and brakes lightly in another.
    """
    prepared = prepared_original(vehicle, characteristics)

    def drive(
        state: VehicleState, throttle: float, brake: float
    ) -> tuple[list[float], VehicleState]:
        """Drive with constant pedals until the speed leaves the range of the tables, or for
        `LONGEST_DRIVE`. Returns the speed after each step [m/s], and the last state.
        """
        speeds = [float(state.speed[0])]
        command = Command(np.full(1, throttle), np.full(1, brake))
        for _ in range(round(LONGEST_DRIVE / STEP)):
            state = vehicle.advance(prepared, state, command)
            speeds.append(float(state.speed[0]))
            is_complete = (
                speeds[-1] >= SPEEDS[-1] + 1 if throttle else speeds[-1] < SPEEDS[1]
            )
            if is_complete:
                break
        return speeds, state

    launch, fast_state = drive(vehicle.at_rest(prepared), throttle=1.0, brake=0.0)
    coasting_speeds, _ = drive(fast_state, throttle=0.0, brake=0.0)
    braking_speeds, _ = drive(fast_state, throttle=0.0, brake=LIGHT_BRAKE)
    # With time reversed, decelerations are accelerations:
    coasting = _accelerations(coasting_speeds[::-1])
    braking = _accelerations(braking_speeds[::-1])
    tables = PedalTables(
        speeds=SPEEDS,
        full_throttle=_accelerations(launch),
        coasting=coasting,
        braking=float(np.median(braking - coasting)) / LIGHT_BRAKE,
    )
    # Many ADSs share these tables: none of them may change a table.
    for table in (tables.speeds, tables.full_throttle, tables.coasting):
        table.flags.writeable = False
    return tables


def _accelerations(speeds: list[float]) -> FloatArray:
    """The acceleration between each of `SPEEDS` and the next one [m/s^2], from the speeds of a
    drive that gains speed.

    Outside the speeds of the drive, the nearest acceleration is used. The acceleration is 0 if the
    drive reaches fewer than two of `SPEEDS`.
    """
    distinct_speeds, samples = np.unique(
        np.maximum.accumulate(speeds), return_index=True
    )
    reached = np.flatnonzero(
        (distinct_speeds[0] <= SPEEDS) & (distinct_speeds[-1] >= SPEEDS)
    )
    if len(reached) < 2:
        return np.zeros(len(SPEEDS))
    times = np.interp(SPEEDS[reached], distinct_speeds, samples * STEP)
    accelerations = np.diff(SPEEDS[reached]) / np.diff(times)
    rows = np.clip(np.arange(len(SPEEDS)) - reached[0], 0, len(accelerations) - 1)
    return np.asarray(accelerations[rows])
