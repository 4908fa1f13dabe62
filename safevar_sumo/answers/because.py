"""Why a setting is less safe than the original: two drives side by side, and what the lost distance is made of.

A vehicle that begins to brake with a gap G before it needs a way D to stand; its margin is G - D. With t the time until
it brakes in full, m its mean speed until then, v its speed there and a its mean deceleration from there on,

    D = m t + v^2 / (2 a),

so the margin lost between two drives is a sum of four parts: braking nearer (G), faster (m, v), later in full (t) and
weaker (a). Each product's difference is shared among its factors at their means, d(x y) = dx (y1 + y2) / 2 + dy (x1 + x2) / 2,
which is exact: the parts add up, whatever the sizes of the differences.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.records import STANDSTILL, Drives

FULL = 0.9
"""Share of the largest deceleration from which it counts as full."""
REMAINDER = 0.05
"""A part of the lost distance up to which it is not worth a word [m]."""


class Braking(NamedTuple):
    """How a vehicle braked for what is before it.

    Attributes
    ----------
    time, gap, speed
        When it first commanded the brake, with how much distance there, how fast [s, m, m/s].
    delay, delay_speed
        Until it decelerated in full, and its mean speed meanwhile [s, m/s].
    full_speed, deceleration
        Its speed then, and its mean deceleration from there on [m/s, m/s^2].
    needed
        The way that it needs from the first command until it stands [m]; where the drive ends before, it is gone on with
        at that deceleration.
    """

    time: float
    gap: float
    speed: float
    delay: float
    delay_speed: float
    full_speed: float
    deceleration: float

    @property
    def needed(self) -> float:
        return self.delay_speed * self.delay + self.full_speed**2 / (2 * self.deceleration)

    @property
    def margin(self) -> float:
        return self.gap - self.needed


class Course(NamedTuple):
    """One drive as far as it matters: how it ended, its braking (None without any), and the distance left at its closest.

    `safety_degree` is in m, or -m/s; NaN if undefined. `closest` is the gap at the closest place [m], NaN on a collision.
    """

    outcome: str
    safety_degree: float
    braking: Braking | None
    closest: float
    collision_speed: float


class Because(NamedTuple):
    """Original and changed vehicle side by side; `parts` [m] add up to the distance lost, the remainder included.

    `parts` is empty where one of the two never braked and there is nothing to compare; `place` names the point of a matrix.
    """

    original: Course
    changed: Course
    parts: dict[str, float]
    place: str = ""

    @property
    def lost(self) -> float:
        """Distance lost [m]."""
        return sum(self.parts.values())


def course(drives: Drives, column: int, safety_degree: float) -> Course:
    """What there is to tell of one of N drives."""
    trace, encounter = drives.trace, drives.encounter
    active = np.flatnonzero(trace.active[:, column])
    counted = trace.active[:, column] & encounter.in_conflict[:, column]
    speed_then, collided = float(drives.collision_speed[column]), bool(np.isfinite(drives.collision_speed[column]))
    if not active.size:
        return Course(str(drives.outcome[column]), safety_degree, None, np.nan, speed_then)
    last, closest = int(active[-1]), np.nan
    if counted.any() and not collided:
        last = int(np.argmin(np.where(counted, encounter.separation[:, column], np.inf)))
        closest = float(trace.gap[last, column])
    braked = (trace.brake[:last + 1, column] > 0) & (trace.speed[:last + 1, column] > STANDSTILL) & trace.active[:last + 1, column]
    braking = _braking(drives, column, int(np.argmax(braked)), last) if braked.any() else None
    return Course(str(drives.outcome[column]), safety_degree, braking, closest, speed_then)


def _braking(drives: Drives, column: int, first: int, last: int) -> Braking | None:
    """The braking from sample `first` to `last`; None where it does not slow the vehicle down."""
    trace = drives.trace
    speed, place = trace.speed[:last + 1, column], trace.position[:last + 1, column]
    losses = -np.diff(speed[first:]) / trace.step
    if not losses.size or losses.max() <= 0:
        return None
    full = first + int(np.argmax(losses >= FULL * losses.max()))
    way, lost = float(place[last] - place[full]), float(speed[full]**2 - speed[last]**2) / 2
    delay = (full - first) * trace.step
    return Braking(
        time=float(trace.time[first]), gap=float(trace.gap[first, column]), speed=float(speed[first]), delay=delay,
        delay_speed=float(place[full] - place[first]) / delay if full > first else float(speed[first]),
        full_speed=float(speed[full]), deceleration=lost / way if way > 0 and lost > 0 else float(losses.max()))


def because(original: Course, changed: Course, place: str = "") -> Because:
    """Compare a changed vehicle's drive with the original's at the same place."""
    one, other = original.braking, _as_the_original_would(changed, original)
    if one is None or other is None:
        return Because(original, changed, {}, place)
    parts = _parts(one, other)
    left = original.closest - one.margin, changed.closest - other.margin
    rest = [0.0 if np.isnan(value) else value for value in left]
    return Because(original, changed, {**parts, "remainder": rest[0] - rest[1]}, place)


def _as_the_original_would(changed: Course, original: Course) -> Braking | None:
    """A vehicle that hits without braking needs the way that the original would need from there, at its speed."""
    if changed.braking is not None or original.braking is None or not np.isfinite(changed.collision_speed):
        return changed.braking
    speed = changed.collision_speed
    return original.braking._replace(time=np.nan, gap=0.0, speed=speed, delay_speed=speed, full_speed=speed)


def _parts(one: Braking, other: Braking) -> dict[str, float]:
    """What of the margin lost from one braking to the other comes from what [m]."""
    energies, weakness = (one.full_speed**2 / 2, other.full_speed**2 / 2), (1 / one.deceleration, 1 / other.deceleration)
    mean_energy, mean_weakness = sum(energies) / 2, sum(weakness) / 2
    mean_delay, mean_speed = (one.delay + other.delay) / 2, (one.delay_speed + other.delay_speed) / 2
    return {
        "place": one.gap - other.gap,
        "speed": (other.delay_speed - one.delay_speed) * mean_delay + (energies[1] - energies[0]) * mean_weakness,
        "delay": (other.delay - one.delay) * mean_speed,
        "deceleration": (weakness[1] - weakness[0]) * mean_energy}
