"""Vehicles of a user: a method of each returns what no vehicle can have, or its plausible ranges
are wrong.
"""

import numpy as np

from safevar_sumo.vehicles.sensing import SumoVehicle, WornVehicle


class DrivesBackwards(SumoVehicle):
    def advance(self, prepared, state, command):
        return state._replace(speed=-1 - state.speed)


class HasSevenSpeeds(SumoVehicle):
    def advance(self, prepared, state, command):
        return state._replace(speed=np.zeros(7))


class MovesAtRest(SumoVehicle):
    def at_rest(self, prepared):
        state = super().at_rest(prepared)
        return state._replace(speed=state.speed + 9)


class SensesWithoutState(SumoVehicle):
    def sense(self, prepared, state, seen):
        return seen


class SensesAnUndefinedGap(SumoVehicle):
    def sense(self, prepared, state, seen):
        return seen._replace(gap=seen.gap * np.nan), state


class CannotBrake(SumoVehicle):
    def sumo_type(self, prepared):
        whole = super().sumo_type(prepared)
        return whole._replace(decel=0 * whole.decel)


class TakesAHeavyCar(WornVehicle):
    PLAUSIBLE = {"kerb_mass": (500, 5000, "kg")}


class TakesDeepTreads(WornVehicle):
    PLAUSIBLE = {"treadDepth": (2, 9)}


class MisspellsAParameter(WornVehicle):
    PLAUSIBLE = {"kerbmass": (500, 5000)}


class HasANumberAsRange(WornVehicle):
    PLAUSIBLE = {"kerb_mass": 500}
