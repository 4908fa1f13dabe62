"""Scenarios of a user in SUMO's world: a method of each fails, or returns what is impossible."""

import numpy as np

from safevar_sumo.scenarios import PedestrianCrossing


class Crossing(PedestrianCrossing):
    """A correct scenario. A study says whether anybody reacts, and other classes see it wrongly."""

    duration: float = 2.0
    reactive_actors: bool = False

    def see(self, scene):
        return scene

    def observe(self, world, step, memory):
        scene, memory = super().observe(world, step, memory)
        return self.see(scene), memory


class SeesAnUndefinedGap(Crossing):
    def see(self, scene):
        return scene._replace(gap=scene.gap * np.nan)


class SeesATextAsGap(Crossing):
    def see(self, scene):
        return scene._replace(gap="near")


class IsOverByMetres(Crossing):
    def see(self, scene):
        return scene._replace(over=scene.gap)


class RaisesWhileItObserves(Crossing):
    def observe(self, world, step, memory):
        raise ValueError("boom")


class RaisesAtTheBeginning(Crossing):
    def begin(self, world):
        raise ValueError("boom")


class MovesTheVehicle(Crossing):
    def begin(self, world):
        world.vehicle_positions("vut")[:] = 0


class ReturnsNoActors(Crossing):
    def actors(self, roads):
        return None


class SeparatesAtOneTime(Crossing):
    def encounter(self, trace):
        whole = super().encounter(trace)
        return whole._replace(separation=whole.separation[0])


class HasNoDistanceInConflict(Crossing):
    def encounter(self, trace):
        whole = super().encounter(trace)
        always = whole.in_conflict | True
        return whole._replace(in_conflict=always, distance=whole.distance * np.nan)
