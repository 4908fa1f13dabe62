"""What Euro NCAP's tests of frontal crash avoidance say of their targets (protocol CA-FC, v1.1 of October 2025).

Speeds here are in km/h and impact locations in per cent of the vehicle's width, as the protocol has them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray

KMH = 1 / 3.6
"""m/s per km/h."""
VUT_LENGTH, VUT_WIDTH = 4.9016, 2.1284
"""The bounding box of CARLA's vehicle.lincoln.mkz2017 [m]."""


class Body(NamedTuple):
    """A pedestrian: length in the direction that it walks, width across [m]."""

    length: float
    width: float


BODIES = {"adult": Body(0.6, 0.5), "child": Body(0.711, 0.298)}


class Range(NamedTuple):
    """What a test of the protocol varies: lowest and highest speed [km/h], impact locations [%]."""

    slowest: float
    fastest: float
    locations: tuple[float, ...]

    def remarks(self, test: str, speed: float, location: float, grade: float) -> list[str]:
        """What is outside the protocol's standard and extended ranges, and its level road."""
        found = []
        if not self.slowest <= speed <= self.fastest:
            found.append(f"{test}: speed = {speed:g} km/h is outside the protocol's {self.slowest:g} to {self.fastest:g} km/h")
        if location not in self.locations:
            legal = ", ".join(f"{one:g}" for one in self.locations)
            found.append(f"{test}: impact_location = {location:g} % is none of the protocol's {legal} %")
        if grade:
            found.append(f"{test}: grade = {grade:g} %, and the protocol's road is level")
        return found


class Walk(NamedTuple):
    """Somebody who stands, sets off at `begin` [s], reaches `speed` [m/s] with constant acceleration within `run_up` [m], and walks on."""

    begin: float
    speed: float
    run_up: float

    @classmethod
    def reaching(cls, way: float, time: float, speed: float, run_up: float) -> Walk:
        """The walk that has covered `way` [m] at `time` [s]: way = speed t - run_up once the run-up is over."""
        if way < run_up:
            raise InputError("scenario.parameters", f"acceleration_distance = {run_up:g} m is longer than the way of {way:g} m")
        begin = time - (way + run_up) / speed
        if begin < 0:
            raise InputError("scenario.parameters", f"the target needs {(way + run_up) / speed:.2f} s to the impact and has {time:g} s",
                             "a faster target, a shorter way or a longer time_to_impact")
        return cls(begin, speed, run_up)

    def travelled(self, time: float) -> float:
        """Way covered [m] at a time [s]."""
        since = max(time - self.begin, 0.0)
        if not self.run_up or since >= 2 * self.run_up / self.speed:
            return self.speed * since - self.run_up
        return self.speed * self.speed / (4 * self.run_up) * since * since

    def pace(self, time: float) -> float:
        """Speed [m/s] at a time [s]."""
        since = max(time - self.begin, 0.0)
        if not self.run_up or since >= 2 * self.run_up / self.speed:
            return self.speed
        return self.speed * self.speed / (2 * self.run_up) * since


def lateral_of(location: float, width: float) -> float:
    """Offset from the middle of a vehicle's front of an impact location, 0 to 100 % of its width [m]."""
    return (location / 100 - 0.5) * width


def beside(distance: FloatArray, half_widths: float) -> FloatArray:
    """Free room between two bodies that lie `distance` apart, from middle to middle; 0 where they overlap [m]."""
    return np.maximum(np.abs(distance) - half_widths, 0.0)
