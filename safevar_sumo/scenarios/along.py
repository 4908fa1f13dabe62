"""Euro NCAP's tests with a target that moves along the lane: a pedestrian (CPLA) or a cyclist (CBLA)."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

from msgspec import Meta

from safevar_sumo.scenarios.ahead import TargetAhead, TargetAheadTest
from safevar_sumo.scenarios.base import PreCrash
from safevar_sumo.scenarios.euro_ncap import KMH, ProtocolRange, SpeedProfile

IMPACT_LOCATIONS = (50.0, 10.0, 25.0, 75.0, 90.0)
"""Impact locations [% of the width]."""


class _TestRow(NamedTuple):
    """A row of the protocol's table: target, its speed [km/h] and acceleration distance [m], tested range, pre-crash
    type.
    """

    target: str
    target_speed: float
    acceleration_distance: float
    protocol_range: ProtocolRange
    pre_crash: PreCrash


TESTS = {  # target, its speed, acceleration distance, range (slowest, fastest, impact locations), pre-crash type
    "CPLA": _TestRow("adult", 5.0, 1.0, ProtocolRange(10, 80, IMPACT_LOCATIONS), PreCrash.PEDESTRIAN),
    "CBLA": _TestRow("cyclist", 15.0, 0.0, ProtocolRange(20, 80, IMPACT_LOCATIONS), PreCrash.CYCLIST),
}


class Along(TargetAheadTest, frozen=True, kw_only=True):
    """A pedestrian or cyclist moves ahead in the vehicle's lane in its direction, and does not react to it.

    Parameters
    ----------
    test
        Row of the protocol, CPLA or CBLA: the source of parameters that are not set here.
    speed
        Speed of the vehicle under test at the start [km/h].
    impact_location
        Point of the vehicle's front that would hit the target, from the left corner [% of the width].
    target, target_speed, acceleration_distance
        `adult`, `child` or `cyclist`; the target's speed [km/h], and the distance within which the target reaches that
        speed [m].
    time_to_impact, time_after
        Time from the start to the impact if nobody brakes, and time from the impact to the end of the run [s].
    vut_length, vut_width
        Size of the vehicle under test [m].
    grade
        Rise of the road over its length, negative downhill [%].

    Notes
    -----
    By default the cyclist rides at 15 km/h from the start; the protocol has 20 km/h in its rows that are rated by the
    warning.
    """

    test: Literal["CPLA", "CBLA"] = "CPLA"
    speed: Annotated[float, Meta(gt=0, le=250)] = 40.0
    target: Literal["adult", "child", "cyclist"] | None = None
    target_speed: Annotated[float, Meta(gt=0, le=60)] | None = None
    acceleration_distance: Annotated[float, Meta(ge=0, le=100)] | None = None
    time_to_impact: Annotated[float, Meta(gt=0, le=60)] = 6.0
    time_after: Annotated[float, Meta(gt=0, le=60)] = 4.0
    network: str = "along"

    @property
    def pre_crash(self) -> PreCrash:
        """NHTSA's pre-crash type."""
        return TESTS[self.test].pre_crash

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return self.time_to_impact + self.time_after

    def remarks(self) -> list[str]:
        """Remarks on parameters outside the protocol."""
        return TESTS[self.test].protocol_range.remarks(self.test, self.speed, self.impact_location, self.grade)

    @property
    def _target_ahead(self) -> TargetAhead:
        profile = SpeedProfile(
            begin=0.0, speed=self._parameter("target_speed") * KMH, run_up=self._parameter("acceleration_distance")
        )
        gap = self.speed * KMH * self.time_to_impact - profile.travelled(self.time_to_impact)
        return self._target_at_impact_location(self._parameter("target"), gap, profile.speed_at)

    def _parameter(self, name: str) -> Any:
        """A parameter as the study sets it, by default as the protocol does."""
        value = getattr(self, name)
        return getattr(TESTS[self.test], name) if value is None else value
