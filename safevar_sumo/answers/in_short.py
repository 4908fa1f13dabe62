"""What a study comes to in one paragraph: conditions, original vehicle, what suffices for what, how robust, avoidable by whom."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from safevar_sumo.answers.preventability import Preventability, PreventableBy
from safevar_sumo.answers.robustness import Robustness
from safevar_sumo.answers.words import ENDS, joined
from safevar_sumo.records import Evaluations, Outcome
from safevar_sumo.scenarios import Point
from safevar_sumo.scenarios.pre_crash import pre_crash_of
from safevar_sumo.simulation import System
from safevar_sumo.vehicles import CharacteristicSet

KMH = 3.6
"""km/h per m/s."""
NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
NAMED = 4
"""Changes that are listed; of more the largest ones."""
CONDITIONS = {"clear": "In clear weather", "wet": "On a wet road", "fog": "In fog", "night": "At night"}
"""How a sentence tells of a weather; of others by name."""


class Finding(NamedTuple):
    """A failure as the paragraph tells of it.

    Attributes
    ----------
    name
        What it is called, such as a solution's handle.
    changes
        All of its changes, values by name in their units.
    outcome, safety_degree
        What they come to [m, or -m/s].
    robustness
        Of the failure.
    needed
        How many of the changes are unsafe by themselves: the size of its minimal causes.
    """

    name: str
    changes: Mapping[str, float]
    outcome: str
    safety_degree: float | None
    robustness: Robustness
    needed: int


def in_short(system: System, original: Evaluations, smallest: Finding | None, robust: Finding | None, preventable: Preventability) -> str:
    """The paragraph.

    Parameters
    ----------
    system
        Of the study; of a study with a matrix at the point, or all points, that the evaluations are of.
    original
        The original vehicle's evaluation.
    smallest
        The failure with the fewest changes; None if nothing is unsafe.
    robust
        The smallest robust failure, None if there is none among those that were tried.
    preventable
        Who avoids the collisions found.
    """
    parts = [f"{_conditions(system)} the original vehicle {_end(system, original)}."]
    if smallest is None:
        return " ".join([*parts, "Nothing unsafe was found."])
    members = CharacteristicSet(system.characteristics.members)
    if not smallest.needed:
        return " ".join([*parts, "No change is needed for it to be unsafe."])
    parts.append(f"{_suffice(members, smallest)} ({_how_robust(smallest)}).")
    if smallest.robustness.borderline:
        parts.append("No robust failure was found among the smallest ones." if robust is None else
                     f"The smallest robust failure ({robust.name}): {_lower(_suffice(members, robust))} ({_how_robust(robust)}).")
    return " ".join([*parts, *_avoided(preventable)])


def _conditions(system: System) -> str:
    points = system.points
    if len(points) > 1:
        return f"At the worst of {len(points)} test points"
    return f"At {points[0].name}," if system.matrix else f"{_weather(points[0])},"


def _weather(point: Point) -> str:
    name = point.weather.name.removeprefix("carla_").replace("_", " ")
    return CONDITIONS.get(name, f"In {name}")


def _end(system: System, original: Evaluations) -> str:
    """How the original vehicle fares; short of whom, where the safety degree is the distance to a pedestrian's path."""
    degree, outcome = float(original.f_safe[0]), Outcome(str(original.outcome[0]))
    if outcome == Outcome.COLLISION:
        return f"itself collides, at {_speed(degree)}"
    is_pedestrian = all(pre_crash_of(point.scenario).startswith("pedestrian") for point in system.points)
    if outcome == Outcome.STOPPED and is_pedestrian:
        return f"stops {degree:.2f} m short of the pedestrian"
    return f"{ENDS.get(outcome, outcome)}" + ("" if degree != degree else f" with a safety degree of {degree:.2f} m")


def _suffice(members: CharacteristicSet, found: Finding) -> str:
    number = len(found.changes)
    suffice = "change suffices" if number == 1 else "changes suffice"
    return f"{_count(number).capitalize()} {suffice} for {_outcome(found)}: {_changes(members, found.changes)}"


def _count(number: int) -> str:
    return NUMBERS[number] if number < len(NUMBERS) else str(number)


def _outcome(found: Finding) -> str:
    if found.safety_degree is None:
        return found.outcome
    if found.outcome == Outcome.COLLISION:
        return f"a collision at {_speed(found.safety_degree)}"
    return f"a safety degree of only {found.safety_degree:.2f} m"


def _speed(degree: float) -> str:
    """A collision's speed as one says it: whole km/h, below 3 km/h with a decimal."""
    speed = -degree * KMH
    return f"{speed:.{int(speed < 3)}f} km/h"


def _changes(members: CharacteristicSet, values: Mapping[str, float]) -> str:
    """Short names and changes relative to the original, the largest first."""
    shares = {member.short_name: (values[member.name] - member.original) / abs(member.original) for member in members
              if member.name in values}
    largest = sorted(shares, key=lambda name: -abs(shares[name]))
    parts = [f"{name} {100 * shares[name]:+.0f} %" for name in largest[:NAMED]]
    return ", ".join(parts) + (f" and {len(shares) - NAMED} more" if len(shares) > NAMED else "")


def _how_robust(found: Finding) -> str:
    share = f"{100 * found.robustness.share:.0f} % of its neighbours are unsafe too"
    alone = f"; {_count(found.needed)} of the changes would do" if found.needed < len(found.changes) else ""
    return f"{'borderline: only ' if found.robustness.borderline else 'robust: '}{share}{alone}"


def _avoided(preventable: Preventability) -> list[str]:
    """Who avoids the collisions found, in a sentence; none without a collision."""
    if not preventable.looked_at:
        return []
    words = {PreventableBy.COMPETENT_DRIVER: "a competent driver avoids {}", PreventableBy.FULL_BRAKING:
             "full braking at the first possible moment {}", PreventableBy.NOBODY: "{} are physically unavoidable"}
    parts = [text.format(f"{100 * (preventable.share(by) or 0.0):.0f} %") for by, text in words.items() if preventable.numbers.get(by)]
    sample = "" if preventable.looked_at == preventable.collisions else f"{preventable.looked_at} drawn at random from "
    return [f"In the same vehicle, of {sample}{preventable.collisions} collisions, {joined(parts)}."]


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:]
