"""Why a setting is less safe than the original: two runs side by side, and the parts of the distance lost.

The brake is commanded with a gap G ahead, at a speed v. The brake pedal has followed a time t later; meanwhile the mean speed
is v - e, and the vehicle slows by d. From then on the mean deceleration is a. The stopping distance is

    D = (v - e) t + (v - d)^2 / (2 a),

and the margin is G - D. Differences of products are shared among their factors at the factors' means,
D(x y) = Dx (y1 + y2) / 2 + Dy (x1 + x2) / 2, which is exact. So the margin lost between two runs is a sum of parts,
each with the sign of one difference: place (G smaller), speed (v larger), delay (t larger), slowing (e and d: less speed
lost while the pedal moves) and deceleration (a smaller).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.words import ENDS, joined
from safevar_sumo.records import STANDSTILL, Outcome, SimulationRuns

FULL = 0.9
"""Share of the command at which the brake pedal counts as having followed it [-]: 0.9 where full braking is commanded."""
COASTING = 0.1
"""Deceleration of a vehicle that rolls without a brake [m/s^2]: a rolling resistance of 1 % of its weight."""
REMAINDER = 0.05
"""Largest unexplained part of the distance lost that a sentence leaves out [m]."""
CRUISING, REGULATING = 0.9, 0.05
"""Share of its highest speed from which a vehicle cruises, and of its largest brake command below which it only regulates its speed [-]."""


class Braking(NamedTuple):
    """How a vehicle braked for the obstacle.

    Attributes
    ----------
    time, gap, speed
        Time, gap and speed when the brake was commanded (`brake_onset`) [s, m, m/s].
    delay
        Time from the command until the brake pedal has followed it [s].
    mean_speed_lost, speed_lost
        Speed at the command less the mean speed during the delay, and less the speed at its end [m/s].
    deceleration
        Mean deceleration over the distance after the delay [m/s^2], as UN R13-H averages fully developed braking.
    """

    time: float
    gap: float
    speed: float
    delay: float
    mean_speed_lost: float
    speed_lost: float
    deceleration: float

    @property
    def needed(self) -> float:
        """Distance from the command to standstill [m], at the mean deceleration beyond the end of the run."""
        return (self.speed - self.mean_speed_lost) * self.delay + (self.speed - self.speed_lost)**2 / (2 * self.deceleration)

    @property
    def margin(self) -> float:
        """Gap at the command less the distance needed [m]."""
        return self.gap - self.needed


class RunSummary(NamedTuple):
    """Summary of one run: its outcome, its braking (None without any), and the least gap.

    `safety_degree` is in m, or -m/s; NaN if undefined. `closest` is the gap where the obstacle is nearest [m], NaN on a collision.
    """

    outcome: str
    safety_degree: float
    braking: Braking | None
    closest: float
    collision_speed: float


class BrakingComparison(NamedTuple):
    """Original and changed vehicle side by side; `parts` [m] add up to the distance lost, the remainder included.

    `parts` is empty where one of the two never braked and there is nothing to compare; `place` names the point of a matrix.
    `slowing` are the distances that the two save by slowing down while the pedal moves [m].
    """

    original: RunSummary
    changed: RunSummary
    parts: dict[str, float]
    place: str = ""
    slowing: tuple[float, float] = (0.0, 0.0)

    @property
    def lost(self) -> float:
        """Distance lost [m]."""
        return sum(self.parts.values())


def brake_onset(runs: SimulationRuns, column: int) -> int | None:
    """The sample at which one of N vehicles begins to brake for the obstacle, before this is nearest; None if it does not brake for it.

    A braking manoeuvre begins where the brake command starts to rise to at least `REGULATING` times the largest command; it ends
    where speed is regulated again, by the throttle or by a smaller command. The manoeuvre that counts is under way when the vehicle
    last cruises (at `CRUISING` of its highest speed or more), or is the first one after that: earlier manoeuvres, such as those of
    a cruise control after an overshoot, did not slow the vehicle down. If there is no such manoeuvre, a vehicle that collides has
    not braked for the obstacle; of a vehicle that does not collide, the last manoeuvre counts.
    """
    trace, nearest = runs.trace, runs.nearest(column)
    active = trace.active[:None if nearest is None else nearest + 1, column]
    speed = np.where(active, trace.speed[:len(active), column], 0.0)
    brake = np.where(speed > STANDSTILL, trace.brake[:len(active), column], 0.0)
    braked = (brake > 0) & (brake >= REGULATING * brake.max())
    brakes, cruises = np.flatnonzero(braked), np.flatnonzero(speed >= CRUISING * speed.max())[-1]
    after = brakes[brakes >= cruises]
    if not brakes.size or (not after.size and np.isfinite(runs.collision_speed[column])):
        return None
    within = after[0] if after.size else brakes[-1]  # a sample of the manoeuvre that counts
    regulated = np.flatnonzero(((trace.throttle[:within, column] > 0) | (brake[:within] > 0)) & ~braked[:within])
    first = int(brakes[brakes >= (regulated[-1] if regulated.size else 0)][0])
    while first > 0 and brake[first - 1] > (brake[first - 2] if first > 1 else 0):
        first -= 1
    return first


def summary_of(runs: SimulationRuns, column: int, safety_degree: float) -> RunSummary:
    """Summary of one of N runs."""
    impact_speed, nearest, onset = float(runs.collision_speed[column]), runs.nearest(column), brake_onset(runs, column)
    closest, braking = np.nan, None
    if nearest is not None and np.isnan(impact_speed):
        closest = float(runs.trace.gap[nearest, column])
    if onset is not None:
        braking = _braking(runs, column, onset, int(np.flatnonzero(runs.trace.active[:, column])[-1]) if nearest is None else nearest)
    return RunSummary(str(runs.outcome[column]), safety_degree, braking, closest, impact_speed)


def _braking(runs: SimulationRuns, column: int, first: int, last: int) -> Braking | None:
    """The braking from sample `first` to `last`; None for a vehicle that only coasts after the pedal was `pressed`."""
    trace = runs.trace
    speed, place = trace.speed[:last + 1, column], trace.position[:last + 1, column]
    followed = trace.pedal[first:last + 1, column] >= FULL * trace.brake[first:last + 1, column]
    pressed = first + int(np.argmax(followed))
    distance, energy = float(place[last] - place[pressed]), float(speed[pressed]**2 - speed[last]**2) / 2
    if not followed.any() or distance <= 0 or energy <= COASTING * distance:
        return None
    initial, delay = float(speed[first]), (pressed - first) * trace.step
    return Braking(
        time=float(trace.time[first]), gap=float(trace.gap[first, column]), speed=initial, delay=delay,
        mean_speed_lost=initial - float(place[pressed] - place[first]) / delay if pressed > first else 0.0,
        speed_lost=initial - float(speed[pressed]), deceleration=energy / distance)


def compare_braking(original: RunSummary, changed: RunSummary, place: str = "") -> BrakingComparison:
    """Compare a changed vehicle's run with the original's at the same place."""
    before, after = original.braking, _braking_or_the_originals(changed, original)
    if before is None or after is None:
        return BrakingComparison(original, changed, {}, place)
    parts, slowing = _parts(before, after)
    unexplained = original.closest - before.margin, changed.closest - after.margin
    remainders = [0.0 if np.isnan(value) else value for value in unexplained]
    return BrakingComparison(original, changed, {**parts, "remainder": remainders[0] - remainders[1]}, place, slowing)


def _braking_or_the_originals(changed: RunSummary, original: RunSummary) -> Braking | None:
    """The braking of a changed vehicle; one that collides without braking is given the original's braking, at its own speed."""
    if changed.braking is not None or original.braking is None or not np.isfinite(changed.collision_speed):
        return changed.braking
    return original.braking._replace(time=np.nan, gap=0.0, speed=max(changed.collision_speed, original.braking.speed_lost))


def _parts(before: Braking, after: Braking) -> tuple[dict[str, float], tuple[float, float]]:
    """Parts by cause of the margin lost from one braking to another [m], and the distance that each saves while its pedal moves [m]."""
    mean_delay, mean_weakness = (before.delay + after.delay) / 2, (1 / before.deceleration + 1 / after.deceleration) / 2
    speeds = [braking.speed - braking.speed_lost for braking in (before, after)]
    mean_speed = sum(speeds) / 2
    driven = [braking.speed - braking.mean_speed_lost for braking in (before, after)]
    saved = [braking.mean_speed_lost * mean_delay + braking.speed_lost * mean_speed * mean_weakness for braking in (before, after)]
    return {
        "place": before.gap - after.gap,
        "speed": (after.speed - before.speed) * (mean_delay + mean_speed * mean_weakness),
        "delay": (after.delay - before.delay) * sum(driven) / 2,
        "slowing": saved[0] - saved[1],
        "deceleration": (1 / after.deceleration - 1 / before.deceleration) * (speeds[0]**2 + speeds[1]**2) / 4}, (saved[0], saved[1])


LEAST_MENTIONED = 0.005
"""Smallest part of a distance that a sentence mentions [m]: half a centimetre."""
PARTS = {
    "place": ("it begins to brake nearer", "it begins to brake farther away"), "speed": ("it is faster", "it is slower"),
    "delay": ("its brake pedal follows later", "its brake pedal follows sooner"),
    "slowing": ("it slows less while the pedal moves", "it slows more while the pedal moves"),
    "deceleration": ("it brakes more weakly", "it brakes harder")}
"""Words for a part that costs distance, and for the same part where it gains distance."""


def ending(run: RunSummary) -> str:
    """How a run ended, in words."""
    if run.outcome == Outcome.COLLISION:
        return f"collides at {run.collision_speed:.2f} m/s"
    end = ENDS.get(Outcome(run.outcome), run.outcome)
    return end if run.safety_degree != run.safety_degree else f"{end}, safety degree {run.safety_degree:.2f} m"


def sentence(comparison: BrakingComparison, *, full: bool = False) -> str:
    """Why the changed vehicle is less safe than the original, in one sentence or two; `full` explains the distance lost."""
    at = f"At {comparison.place}: the" if comparison.place else "The"
    ends = f"{at} original {ending(comparison.original)}; this one {ending(comparison.changed)}."
    before, after = comparison.original.braking, comparison.changed.braking
    if before is None and after is None:
        return f"{ends} Neither of them brakes."
    if not comparison.parts:
        return f"{ends} {'The original' if before is None else 'It'} does not slow down by its brake."
    unbraked = "" if after is not None else ", without any effect of its brake"
    costs, gains = ("", "gained ") if comparison.lost >= 0 else ("lost ", "")
    parts, is_lost = comparison.parts, comparison.lost >= 0
    pieces = [f"{abs(parts[name]):.2f} m {costs if parts[name] > 0 else gains}because {PARTS[name][parts[name] < 0]}"
              f"{_numbers(comparison, name)}"
              for name in sorted(PARTS, key=lambda name: -parts[name]) if abs(parts[name]) >= LEAST_MENTIONED]
    if abs(parts["remainder"]) > REMAINDER:
        pieces.append(f"{parts['remainder']:+.2f} m that this does not explain")
    if not pieces:
        return f"{ends} They brake alike."
    lost = f"{abs(comparison.lost):.2f} m"
    lead = f"Of the {lost} {'lost' if is_lost else 'gained'}" if not full else (
        f"Its margin, the gap at the brake command less the distance needed to stop, is {lost} {'smaller' if is_lost else 'larger'}")
    return f"{ends} {lead}{unbraked}: {joined(pieces)}."


def _numbers(comparison: BrakingComparison, part: str) -> str:
    """The quantity behind a part, of the changed vehicle and of the original."""
    before, after = comparison.original.braking, comparison.changed.braking
    if before is None or after is None:
        return ""
    pairs = {"place": (after.gap, before.gap, "m before"), "speed": (after.speed, before.speed, "m/s at the command"),
             "delay": (after.delay, before.delay, "s after the command"),
             "slowing": (comparison.slowing[1], comparison.slowing[0], "m saved"),
             "deceleration": (after.deceleration, before.deceleration, "m/s^2")}
    changed, original, unit = pairs[part]
    decimals = next((digits for digits in range(2, 9) if f"{changed:.{digits}f}" != f"{original:.{digits}f}"), 2)
    return f" ({changed:.{decimals}f} instead of {original:.{decimals}f} {unit})"
