"""A point: a scenario in a weather, with the ranges of the scenario's parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from safevar_sumo.records import Quantity
from safevar_sumo.scenarios.base import Scenario
from safevar_sumo.study import Constraint, Domain, Weather

SPEED_DIMENSION = "speed"
"""The parameter by which `permit` asks by default, and that the scope of an answer names first."""


class Point(NamedTuple):
    """A scenario in a weather.

    Attributes
    ----------
    name
        Name of the point in the study.
    parameters
        Parameters that distinguish the point from other points of the study.
    allowed_impact_speed
        Relative speed up to which an impact is allowed [m/s].
    phase
        Number of steps by which the whole encounter begins later, a number or shape (N,).
    ranges
        The parameters of the point of which settings have values, with their ranges; None if the
        point uses all values of a setting.
    constraints
        Constraints that the encounters of the point satisfy.
    """

    scenario: Scenario
    weather: Weather
    name: str = ""
    parameters: Mapping[str, Any] = {}
    allowed_impact_speed: float = 0.0
    phase: Quantity = 0.0
    ranges: Mapping[str, Domain] | None = None
    constraints: tuple[Constraint, ...] = ()

    def own(self, values: Mapping[str, Quantity]) -> dict[str, Quantity]:
        """The values that belong to parameters of this point."""
        if self.ranges is None:
            return dict(values)
        return {name: value for name, value in values.items() if name in self.ranges}

    def meets(self, values: Mapping[str, Quantity]) -> Quantity:
        """Return whether encounters with these values belong to this point: an array of shape (N,),
        or a single truth value for all encounters.
        """
        holds = True
        for name, domain in (self.ranges or {}).items():
            if name in values:
                holds &= (values[name] >= domain.lower) & (values[name] <= domain.upper)
        for constraint in self.constraints:
            holds &= constraint.allows(values)
        return holds
