"""A point: a scenario in a weather, and the ranges of its parameters."""

from __future__ import annotations

from typing import Any, NamedTuple

from safevar_sumo.records import Quantity
from safevar_sumo.scenarios.base import Quantities, Scenario
from safevar_sumo.study import Constraint, Domains, Weather

SPEED_DIMENSION = "speed"
"""The parameter by which `permit` asks, and that a scope names first."""


class Point(NamedTuple):
    """A scenario in a weather; `name` is its name in the study, `parameters` distinguish it from
    the study's others. An impact is allowed up to the relative speed `allowed_impact_speed` [m/s].
    All of it begins `phase` steps later, a number or of shape (N,). `ranges` are those of its
    parameters of which settings have values, by name; None if it takes all of them. Its encounters
    satisfy the `constraints`.
    """

    scenario: Scenario
    weather: Weather
    name: str = ""
    parameters: tuple[tuple[str, Any], ...] = ()
    allowed_impact_speed: float = 0.0
    phase: Quantity = 0.0
    ranges: Domains | None = None
    constraints: tuple[Constraint, ...] = ()

    def own(self, values: Quantities) -> dict[str, Quantity]:
        """Those of the values that are of parameters of this point."""
        if self.ranges is None:
            return dict(values)
        return {name: value for name, value in values.items() if name in self.ranges}

    def meets(self, values: Quantities) -> Quantity:
        """Whether the encounters with these values are some of this point's, of shape (N,), or one
        truth for all.
        """
        holds = True
        for name, domain in (self.ranges or {}).items():
            if name in values:
                holds &= (values[name] >= domain.lower) & (values[name] <= domain.upper)
        for constraint in self.constraints:
            holds &= constraint.allows(values)
        return holds


Points = tuple[Point, ...]
"""The points of a matrix, or the only one of a study without a matrix."""
