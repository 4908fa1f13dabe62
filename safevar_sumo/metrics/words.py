"""Words for what makes a vehicle unsafe: safety degrees, impacts, values near a limit, repeats."""

from __future__ import annotations

import numpy as np

from safevar_sumo.records import KMH_PER_MS, BoolArray

ALLOWED_ROUNDING = 0.01
"""Allowed speed of an impact below which none is allowed [km/h]."""


def runs_in_words(fails: BoolArray) -> str:
    """In how many runs of a setting it is unsafe, shape (R,), with the exact interval (Clopper and
    Pearson) of their share; "" if there is a single run.
    """
    # This module takes a second to load.
    import scipy

    if len(fails) < 2:
        return ""
    count = int(fails.sum())
    low, high = scipy.stats.binomtest(count, len(fails)).proportion_ci(method="exact")
    interval = f"95 % confidence interval {100 * low:.0f} to {100 * high:.0f} %"
    return f" in {count} of {len(fails)} runs ({interval})"


def impact_in_words(speed: float, excess: float) -> str:
    """An impact [m/s] and its excess, such as `impact at 12 km/h where 15 is allowed`."""
    allowed_speed = KMH_PER_MS * (speed - excess)
    words = "none"
    if allowed_speed >= ALLOWED_ROUNDING:
        words = f"{allowed_speed:.3g}"
    return f"impact at {KMH_PER_MS * speed:.3g} km/h where {words} is allowed"


def unit_of_degree(degree: float) -> str:
    """The unit of a safety degree, which is minus a speed on a collision."""
    if degree >= 0:
        return "m"
    return "m/s"


def degree_in_words(degree: float) -> str:
    """A safety degree with its unit."""
    return f"{degree:.3g} {unit_of_degree(degree)}"


def value_on_side(value: float, limit: float, kind: str, digits: int) -> str:
    """A value with so many digits, or as few more as keep it on its side of a limit."""
    side = np.sign(value - limit)
    for number in range(digits, 17):
        text = f"{value:.{number}{kind}}"
        if np.sign(float(text) - limit) == side:
            return text
    return repr(value)
