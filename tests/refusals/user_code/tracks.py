"""Scenarios of a user: bodies whose tracks are impossible, and parameters that a study searches."""

from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.scenarios import Track
from safevar_sumo.study import searched


class Stand:
    """Bodies of which the study states where they stand, and how fast they are."""

    speed, duration = 50.0, 3.0

    def __init__(self, bodies=()):
        self.bodies = bodies

    def tracks(self, times):
        return [Track.of(**body) for body in self.bodies]


class Car(Stand):
    """A car that stands 60 m ahead, and says so."""

    stated_speed = 0.0

    def positions(self, times):
        return 60.0

    def tracks(self, times):
        return [Track.of("car", "car", self.positions(times), 0.0, self.stated_speed)]


class SaysThatItStands(Car):
    def positions(self, times):
        return 60 + 5.0 * times


class SaysThatItComes(SaysThatItStands):
    stated_speed = -5.0


class Jumps(Car):
    def positions(self, times):
        return 60 + np.where(times > 1, 30.0, 0.0)


class Vanishes(Car):
    def positions(self, times):
        return np.where(times > 1, np.nan, 50.0)


class EndsTooEarly(Car):
    def positions(self, times):
        return 60.0 + times[:20]


class HasNoAxisForVehicles(Car):
    def positions(self, times):
        return 60.0 + times[:, 0]


class FacesTwoWays(Stand):
    def tracks(self, times):
        return [Track("car", "car", 4.0, 2.0, 50.0, 0.0, 1.0, 1.0, 0.0)]


class Scooter(Struct):
    """A scenario with parameters, of which no study here is simulated."""

    speed: float = 40.0
    scooter: Annotated[float, Meta(ge=5, le=30, extra={"unit": "km/h"})] = 15.0
    gap: Annotated[float, searched(20.0, 60.0, "m", "gap to the scooter")] = 30.0
    duration: float = 9.0

    def tracks(self, times): ...
