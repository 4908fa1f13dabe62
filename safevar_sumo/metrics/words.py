"""Words for unsafe vehicles: safety degrees, impacts, values near a limit, and numbers of unsafe
runs.
"""

from __future__ import annotations

import numpy as np

from safevar_sumo.records import KMH_PER_MS, BoolArray, significant

ALLOWED_ROUNDING = 0.01
"""An impact is not allowed at all if its allowed speed is below this number [km/h]."""

LEAST_WITHOUT_DECIMALS = 9.95
"""A percentage from this number on is printed without decimals, others with two digits."""
MOST_DIGITS = 16
"""Largest number of digits of a rounded number. With more digits, the number is printed exactly."""


def runs_in_words(fails: BoolArray) -> str:
    """The number of unsafe runs of a setting, with the exact interval of their share (Clopper and
    Pearson), such as `fails in 3 of 5 repeated runs (95 %: 15 to 95 %)`. `fails` says which runs
    are unsafe, shape (R,). "" for a single run.
    """
    # The import takes a second.
    import scipy

    if len(fails) < 2:
        return ""
    count = fails.sum()
    low, high = scipy.stats.binomtest(count, len(fails)).proportion_ci(method="exact")
    interval = f"95 %: {_percentage(low)} to {_percentage(high)} %"
    return f"fails in {count} of {len(fails)} repeated runs ({interval})"


def _percentage(share: float) -> str:
    """A share as a number of percent."""
    percent = 100 * share
    if percent >= LEAST_WITHOUT_DECIMALS:
        return f"{percent:.0f}"
    return f"{percent:.2g}"


def impact_in_words(speed: float, excess: float) -> str:
    """The speed of an impact, and the allowed speed, such as `impact at 12 km/h where 15 is
    allowed`. The excess is the speed minus the allowed speed [m/s].
    """
    allowed_speed = KMH_PER_MS * (speed - excess)
    words = "none"
    if allowed_speed >= ALLOWED_ROUNDING:
        words = significant(allowed_speed, 3)
    return (
        f"impact at {significant(KMH_PER_MS * speed, 3)} km/h where {words} is allowed"
    )


def unit_of_degree(degree: float) -> str:
    """The unit of a safety degree. After a collision, a safety degree is minus a speed."""
    if degree >= 0:
        return "m"
    return "m/s"


def degree_in_words(degree: float) -> str:
    """A safety degree with its unit."""
    return f"{significant(degree, 3)} {unit_of_degree(degree)}"


def value_on_side(value: float, limit: float, kind: str, digits: int) -> str:
    """A value with this number of digits, or with as few more digits as keep the text on the
    value's side of the limit. Otherwise a text could read "0.30 m, less than 0.3 m".

    `kind` says which digits count, as in a format: "f" for those after the decimal point, "g" for
    all significant ones.
    """
    side = np.sign(value - limit)
    for number in range(digits, MOST_DIGITS + 1):
        text = significant(value, number)
        if kind == "f":
            text = f"{value:.{number}f}"
        if np.sign(float(text) - limit) == side:
            return text
    return repr(value)
