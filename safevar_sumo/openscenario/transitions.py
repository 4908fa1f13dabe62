"""How a speed or an offset changes (class TransitionDynamics)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from safevar_sumo.openscenario.actors import Array
from safevar_sumo.openscenario.document import Element, attribute, number


class Transition(NamedTuple):
    """How long a change takes [s], or with `over_distance` how far the actor drives meanwhile [m];
    and its share, 0 to 1, after so much of either.
    """

    duration: float
    share: Callable[[Array], Array]
    over_distance: bool = False


SHAPES: dict[str, tuple[float, Callable[[Array], Array]]] = {
    "linear": (1.0, lambda x: x),
    "sinusoidal": (math.pi / 2, lambda x: (1 - np.cos(math.pi * x)) / 2),
    "cubic": (1.5, lambda x: x * x * (3 - 2 * x)),
}
"""Shapes of a change by their names (class DynamicsShape): largest slope, and the share done at a
share of the time.
"""


def transition_of(dynamics: Element, change: float, speed: float | None = None) -> Transition:
    """Class TransitionDynamics for a change. A rate is the largest one.

    A distance is driven at a speed [m/s], or without one at whatever speed the actor has.
    """
    shape = attribute(dynamics, "dynamicsShape")
    dimension = attribute(dynamics, "dynamicsDimension")
    duration = number(dynamics, "value")
    if shape == "step" or not change or (not duration and dimension != "rate"):
        return Transition(0.0, np.ones_like)
    steepest, share = SHAPES[shape]
    if dimension == "rate":
        duration = steepest * abs(change / duration) if duration else math.inf
    elif dimension == "distance" and speed is not None:
        duration = duration / speed if speed else math.inf
    over_distance = dimension == "distance" and speed is None
    return Transition(
        duration, lambda since: share(np.minimum(since / duration, 1.0)), over_distance
    )
