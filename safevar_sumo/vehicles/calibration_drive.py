"""The calibration drive of an ADS: the tables of its throttle and brake controller."""

from __future__ import annotations

from functools import cache, lru_cache, partial

import numpy as np

from safevar_sumo.records import Command, FloatArray, Nominal, PedalTables
from safevar_sumo.vehicles.base import Vehicle
from safevar_sumo.vehicles.characteristics import CharacteristicSet

STEP = 0.1  # s
SPEEDS = np.arange(0.0, 20.5, 0.5)  # m/s, of the tables
LONGEST = 60.0  # s, longest drive
LIGHT_BRAKE = 0.1  # pedal position while braking, far from the limit of the tyres


def calibration_drive(vehicle: Vehicle, characteristics: CharacteristicSet) -> Nominal:
    """The original vehicle on a dry road; its tables are simulated when first needed."""
    types = vehicle.sumo_type(vehicle.prepare(_original(characteristics), 1.0, STEP))
    tables = cache(partial(_simulated_tables, vehicle, characteristics))  # type: ignore[arg-type]
    mass, accel, decel, max_speed, lag = (float(values[0]) for values in types)
    return Nominal(mass=mass, accel=accel, decel=decel, max_speed=max_speed, actuator_lag=lag, tables=tables)


def _original(characteristics: CharacteristicSet) -> dict[str, FloatArray]:
    return {member.name: np.full(1, float(member.original)) for member in characteristics}


@lru_cache(maxsize=4)
def _simulated_tables(vehicle: Vehicle, characteristics: CharacteristicSet) -> PedalTables:
    """Accelerate at full throttle, then from the speed reached coast, and from it again brake lightly."""
    prepared = vehicle.prepare(_original(characteristics), 1.0, STEP)
    rest = vehicle.at_rest(prepared)

    def drive(state: object, throttle: float, brake: float) -> tuple[list[float], object]:
        """Speeds until the end of the tables, and the last state."""
        speeds = [float(state.speed[0])]  # type: ignore[attr-defined]
        command = Command(np.full(1, throttle), np.full(1, brake))
        for _ in range(round(LONGEST / STEP)):
            state = vehicle.advance(prepared, state, command)
            speeds.append(float(state.speed[0]))  # type: ignore[attr-defined]
            if speeds[-1] >= SPEEDS[-1] + 1 if throttle else speeds[-1] < SPEEDS[1]:
                break
        return speeds, state

    speeding_up, fast = drive(rest, 1.0, 0.0)
    coasting = _accelerations(drive(fast, 0.0, 0.0)[0][::-1])
    braking = _accelerations(drive(fast, 0.0, LIGHT_BRAKE)[0][::-1])
    tables = PedalTables(speeds=SPEEDS, full_throttle=_accelerations(speeding_up), coasting=coasting,
                    braking=float(np.median(braking - coasting)) / LIGHT_BRAKE)
    for table in tables[:3]:
        table.flags.writeable = False  # many ADSs read them
    return tables


def _accelerations(speeds: list[float]) -> FloatArray:
    """Acceleration between each grid speed and the next, of a drive that gains speed [m/s^2].

    Beyond the speeds that the drive reaches its last value holds; zero for a drive at constant speed.
    """
    highest = np.maximum.accumulate(np.array(speeds))
    reached, first = np.unique(highest, return_index=True)
    inside = SPEEDS[(reached[0] <= SPEEDS) & (reached[-1] >= SPEEDS)]
    if len(inside) < 2:
        return np.zeros(len(SPEEDS))
    gains = np.diff(inside) / np.diff(np.interp(inside, reached, first * STEP))
    return np.asarray(gains[np.clip(np.arange(len(SPEEDS)) - round(inside[0] / SPEEDS[1]), 0, len(gains) - 1)])
