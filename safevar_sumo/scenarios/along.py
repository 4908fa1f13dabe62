"""Euro NCAP's targets that move along the lane: a pedestrian who walks, CPLA, and a cyclist who rides, CBLA."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

from msgspec import Meta

from safevar_sumo.scenarios.ahead import Ahead, BehindSomebody
from safevar_sumo.scenarios.base import PreCrash
from safevar_sumo.scenarios.euro_ncap import KMH, Range, Walk

LOCATIONS = (50.0, 10.0, 25.0, 75.0, 90.0)


class _Test(NamedTuple):
    """A row of the protocol's table: km/h, m, and the range of the tests."""

    target: str
    target_speed: float
    acceleration_distance: float
    range: Range
    pre_crash: PreCrash


TESTS = {
    "CPLA": _Test("adult", 5.0, 1.0, Range(10, 80, LOCATIONS), PreCrash.PEDESTRIAN),
    "CBLA": _Test("cyclist", 15.0, 0.0, Range(20, 80, LOCATIONS), PreCrash.CYCLIST),
}


class Along(BehindSomebody, frozen=True, kw_only=True):
    """Somebody moves ahead in the vehicle's lane, away from it, and does not look round.

    Parameters
    ----------
    test
        Row of the protocol that gives what is not given here: CPLA or CBLA.
    speed
        The vehicle's at the start [km/h].
    impact_location
        Where on the vehicle's front the target would be hit, from its left corner [% of the width].
    target, target_speed, acceleration_distance
        `adult`, `child` or `cyclist`; its speed, and the way within which it reaches that from the start on [km/h, m].
    time_to_impact, time_after
        Time from the start to the impact if nobody brakes, and on from there to the end of the run [s].
    vut_length, vut_width
        The vehicle under test [m].
    grade
        By how much the road rises over the way, negative where it falls [%].

    Notes
    -----
    The cyclist rides 15 km/h, in the protocol's rows that are judged by the warning 20 km/h, from the start on.
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
        """NHTSA's type."""
        return TESTS[self.test].pre_crash

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return self.time_to_impact + self.time_after

    def remarks(self) -> list[str]:
        """Remarks on parameters outside the protocol."""
        return TESTS[self.test].range.remarks(self.test, self.speed, self.impact_location, self.grade)

    @property
    def _ahead(self) -> Ahead:
        walk = Walk(0.0, self._of("target_speed") * KMH, self._of("acceleration_distance"))
        gap = self.speed * KMH * self.time_to_impact - walk.travelled(self.time_to_impact)
        return self._ahead_of(self._of("target"), gap, walk.pace)

    def _of(self, name: str) -> Any:
        """A parameter, or what the protocol has for it."""
        given = getattr(self, name)
        return getattr(TESTS[self.test], name) if given is None else given
