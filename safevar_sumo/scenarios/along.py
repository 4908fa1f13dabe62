"""Euro NCAP's pedestrian who walks along the lane, CPLA."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from safevar_sumo.scenarios.base import Actors, PreCrash, Roads
from safevar_sumo.scenarios.euro_ncap import BODIES, KMH, Ahead, BehindSomebody, Body, Range, Walk, lateral_of

PROTOCOL = Range(10, 60, (50, 10, 25, 75, 90))


class Along(BehindSomebody, frozen=True, kw_only=True):
    """A pedestrian walks ahead in the vehicle's lane, away from it, and does not look round.

    Parameters
    ----------
    speed
        The vehicle's at the start [km/h].
    impact_location
        Where on the vehicle's front the pedestrian would be hit, from its left corner [% of the width].
    target, target_speed, acceleration_distance
        `adult` or `child`; its speed, and the way within which it reaches that from the start on [km/h, m].
    time_to_impact, time_after
        Time from the start to the impact if nobody brakes, and on from there to the end of the run [s].
    vut_length, vut_width
        The vehicle under test [m].
    grade
        By how much the road rises over the way, negative where it falls [%].
    """

    speed: Annotated[float, Meta(gt=0, le=250)] = 40.0
    impact_location: Annotated[float, Meta(ge=0, le=100)] = 50.0
    target: Literal["adult", "child"] = "adult"
    target_speed: Annotated[float, Meta(gt=0, le=18)] = 5.0
    acceleration_distance: Annotated[float, Meta(ge=0, le=100)] = 1.0
    time_to_impact: Annotated[float, Meta(gt=0, le=60)] = 6.0
    time_after: Annotated[float, Meta(gt=0, le=60)] = 4.0
    network: str = "along"
    pre_crash = PreCrash.PEDESTRIAN

    @property
    def test_speed(self) -> float:
        """Speed that the vehicle holds until it brakes [m/s]."""
        return self.speed * KMH

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return self.time_to_impact + self.time_after

    def remarks(self) -> list[str]:
        """Remarks on parameters outside the protocol."""
        return PROTOCOL.remarks("CPLA", self.speed, self.impact_location, self.grade)

    def actors(self, roads: Roads) -> Actors:
        return self._ahead.actors(self.target, Body(self.vut_length, self.vut_width), self.speed * KMH)

    @property
    def _ahead(self) -> Ahead:
        walk = Walk(0.0, self.target_speed * KMH, self.acceleration_distance)
        gap = self.speed * KMH * self.time_to_impact - walk.travelled(self.time_to_impact)
        return Ahead(BODIES[self.target], gap, lateral_of(self.impact_location, self.vut_width), walk.pace)
