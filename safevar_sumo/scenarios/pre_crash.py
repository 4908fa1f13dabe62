"""Pre-crash types, the vocabulary in which scenarios are told apart: those of NHTSA's typology that are here."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from typing import Any

from safevar_sumo.scenarios.base import Point


class PreCrash(StrEnum):
    """NHTSA's names (Najm, Smith, Yanagisawa: Pre-Crash Scenario Typology for Crash Avoidance Research, 2007)."""

    PEDESTRIAN_AFTER_MANOEUVRE = "pedestrian crash with prior vehicle manoeuvre"
    PEDESTRIAN = "pedestrian crash without prior vehicle manoeuvre"
    LEAD_STOPPED = "lead vehicle stopped"
    LEAD_SLOWER = "lead vehicle moving at lower constant speed"
    LEAD_DECELERATING = "lead vehicle decelerating"


def pre_crash_of(scenario: Any) -> str:
    """A scenario's pre-crash type, "" of one that tells none."""
    return str(getattr(scenario, "pre_crash", ""))


def tags(points: Iterable[Point]) -> str:
    """What types the scenarios of some points are of, and whether it is day or night, in a sentence."""
    points = tuple(points)
    types = dict.fromkeys(filter(None, (pre_crash_of(point.scenario) for point in points)))
    light = " and ".join(dict.fromkeys(f"by {point.weather.light}" for point in points))
    return f"NHTSA's pre-crash types: {'; '.join(types)}; {light}." if types else f"It is {light}; the scenario tells no pre-crash type."
