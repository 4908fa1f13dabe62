"""Why a setting is less safe than the original: compares two runs, and splits the lost margin into parts.

The brake is commanded with a gap G ahead, at a speed v. The brake pedal follows within a time t. During t the mean
speed is v - e, and the speed falls by d. After t the mean deceleration is a. The stopping distance is

    D = (v - e) t + (v - d)^2 / (2 a),

and the margin is G - D. A difference of products is split exactly between the two factors,
x2 y2 - x1 y1 = (x2 - x1) (y1 + y2) / 2 + (y2 - y1) (x1 + x2) / 2. So the lost margin, the original's margin minus the
changed vehicle's, is a sum of parts, each with the sign of one difference: gap (G smaller), speed (v larger), delay (t
larger), slowing (e and d: less speed lost while the pedal moves) and deceleration (a smaller). If the obstacle moves
on, v is the speed and a the deceleration relative to it, at its mean speed while the vehicle brakes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.words import OUTCOME_VERBS
from safevar_sumo.records import STANDSTILL, Outcome, SimulationRuns

PEDAL_SHARE = 0.9
"""Share of the brake command at which the brake pedal counts as having followed the command [-]."""
COAST_DECELERATION = 0.1
"""Deceleration of a vehicle that rolls without a brake [m/s^2]: a rolling resistance of 1 % of its weight."""
MAX_OMITTED_REMAINDER = 0.05
"""A sentence leaves out the unexplained part of the lost margin if it is at most this long [m]."""
OBSTACLE_DECIMALS = 6
"""Decimals of an obstacle's speed, so that one that stands still has none."""
CRUISE_SHARE = 0.9
"""A vehicle cruises at this share of its highest speed or more [-]."""
REGULATION_SHARE = 0.05
"""With less than this share of its largest brake command, a vehicle only regulates its speed [-]."""


class Braking(NamedTuple):
    """How a vehicle braked for the obstacle.

    Attributes
    ----------
    gap, speed
        Gap and speed when the brake was commanded (`brake_onset`) [m, m/s].
    delay
        Time from the command until the brake pedal has followed it [s].
    speed_deficit
        Speed at the command minus the mean speed during the delay [m/s].
    speed_lost
        Speed at the command minus the speed at the end of the delay [m/s].
    deceleration
        Mean deceleration after the delay [m/s^2], averaged over the distance, as in UN R13-H.
    obstacle_speed
        Mean speed of the obstacle along the vehicle's path from the command on [m/s]; `deceleration` is relative to it.
    """

    gap: float
    speed: float
    delay: float
    speed_deficit: float
    speed_lost: float
    deceleration: float
    obstacle_speed: float = 0.0

    @property
    def closing_speed(self) -> float:
        """Speed towards the obstacle when the brake was commanded [m/s]."""
        return self.speed - self.obstacle_speed

    @property
    def margin(self) -> float:
        """Gap at the command minus the distance by which it shrinks [m], if the mean deceleration continues after the
        run.
        """
        speed_after_delay = self.closing_speed - self.speed_lost
        while_pedal_moves = (self.closing_speed - self.speed_deficit) * self.delay
        return self.gap - while_pedal_moves - speed_after_delay**2 / (2 * self.deceleration)


class RunSummary(NamedTuple):
    """Summary of one run; `braking` is None if the vehicle did not brake for the obstacle.

    `safety_degree` is a distance [m] or, on a collision, minus its speed [m/s]; NaN if undefined. `remainder` is the
    part of the gap when the obstacle is nearest that the margin does not explain [m], 0 on a collision.
    """

    outcome: str
    safety_degree: float
    braking: Braking | None
    remainder: float = 0.0


class BrakingComparison(NamedTuple):
    """Runs of the original and of the changed vehicle, and the parts of the margin that the changed vehicle lost [m].

    One of the `parts` is the remainder, which no difference explains; `parts` is empty if one of the vehicles never
    braked. `point` is the name of a test point.
    """

    original: RunSummary
    changed: RunSummary
    parts: dict[str, float]
    point: str = ""

    def __str__(self) -> str:
        return sentence(self)


def brake_onset(runs: SimulationRuns, column: int) -> int | None:
    """The sample at which vehicle `column` begins to brake for the obstacle, before the obstacle is nearest; None if it
    does not brake.

    A braking manoeuvre begins where the brake command starts to rise to at least `REGULATION_SHARE` times the largest
    command; it ends where the throttle or a smaller brake command regulates the speed again. The manoeuvre that counts
    is

    1. the one under way when the vehicle last cruises (at `CRUISE_SHARE` of its highest speed or more), as earlier
       manoeuvres, such as those of a cruise control after an overshoot, did not slow the vehicle down;
    2. otherwise the first one after that;
    3. otherwise none if the vehicle collides, and its last one if it does not.
    """
    trace, nearest = runs.trace, runs.nearest(column)
    active = trace.active[: None if nearest is None else nearest + 1, column]
    speed = np.where(active, trace.speed[: len(active), column], 0.0)
    brake = np.where(speed > STANDSTILL, trace.brake[: len(active), column], 0.0)
    is_braking = (brake > 0) & (brake >= REGULATION_SHARE * brake.max())
    braking_samples, last_cruise = np.flatnonzero(is_braking), np.flatnonzero(speed >= CRUISE_SHARE * speed.max())[-1]
    later_samples = braking_samples[braking_samples >= last_cruise]
    if not braking_samples.size or (not later_samples.size and np.isfinite(runs.collision_speed[column])):
        return None
    sample = later_samples[0] if later_samples.size else braking_samples[-1]  # a sample of the manoeuvre that counts
    regulation = np.flatnonzero(((trace.throttle[:sample, column] > 0) | (brake[:sample] > 0)) & ~is_braking[:sample])
    onset = int(braking_samples[braking_samples >= (regulation[-1] if regulation.size else 0)][0])
    while onset > 0 and brake[onset - 1] > (brake[onset - 2] if onset > 1 else 0):
        onset -= 1
    return onset


def summarise_run(runs: SimulationRuns, column: int, safety_degree: float) -> RunSummary:
    """Summary of the run of vehicle `column`."""
    outcome, nearest, onset = str(runs.outcome[column]), runs.nearest(column), brake_onset(runs, column)
    last = int(np.flatnonzero(runs.trace.active[:, column])[-1]) if nearest is None else nearest
    braking = None if onset is None else _measure_braking(runs, column, onset, last)
    if braking is None or nearest is None or np.isfinite(runs.collision_speed[column]):
        return RunSummary(outcome, safety_degree, braking)
    return RunSummary(outcome, safety_degree, braking, float(runs.trace.gap[nearest, column]) - braking.margin)


def _measure_braking(runs: SimulationRuns, column: int, first: int, last: int) -> Braking | None:
    """The braking from sample `first` to `last`; None if the vehicle only coasts after the pedal has followed."""
    trace = runs.trace
    speed, position = trace.speed[: last + 1, column], trace.position[: last + 1, column]
    elapsed = trace.time[last] - trace.time[first]
    shift = position[last] + trace.gap[last, column] - position[first] - trace.gap[first, column]  # of the obstacle
    obstacle_speed = round(float(shift / elapsed), OBSTACLE_DECIMALS) if last > first and np.isfinite(shift) else 0.0
    speed, position = speed - obstacle_speed, position - obstacle_speed * trace.time[: last + 1]  # relative to it
    has_followed = trace.pedal[first : last + 1, column] >= PEDAL_SHARE * trace.brake[first : last + 1, column]
    followed = first + int(np.argmax(has_followed))
    distance = float(position[last] - position[followed])
    specific_energy = float(speed[followed] ** 2 - speed[last] ** 2) / 2  # energy that the brake takes, per mass
    if not has_followed.any() or distance <= 0 or specific_energy <= COAST_DECELERATION * distance:
        return None
    initial_speed, delay = float(speed[first]), (followed - first) * trace.step
    mean_speed = float(position[followed] - position[first]) / delay if delay else initial_speed
    return Braking(
        gap=float(trace.gap[first, column]),
        speed=initial_speed + obstacle_speed,
        delay=delay,
        speed_deficit=initial_speed - mean_speed,
        speed_lost=initial_speed - float(speed[followed]),
        deceleration=specific_energy / distance,
        obstacle_speed=obstacle_speed,
    )


def compare_braking(original: RunSummary, changed: RunSummary, point: str = "") -> BrakingComparison:
    """Compare a changed vehicle's run with the original vehicle's run at the same test point, whose name is `point`."""
    brakings = [run.braking for run in (original, changed) if run.braking is not None]
    if len(brakings) < 2:
        return BrakingComparison(original, changed, {}, point)
    gap, *quantities = np.array(
        [
            [one.gap, one.closing_speed, one.delay, one.speed_deficit, one.speed_lost, 1 / one.deceleration]
            for one in brakings
        ]
    ).T
    speed, delay, deficit, lost, softness = (values.mean() for values in quantities)
    more_speed, more_delay, more_deficit, more_lost, more_softness = (float(np.diff(one)[0]) for one in quantities)
    per_speed_after_delay = (speed - lost) * softness
    speeds_after_delay = quantities[0] - quantities[3]
    parts = {
        "gap": gap[0] - gap[1],
        "speed": more_speed * (delay + per_speed_after_delay),
        "delay": more_delay * (speed - deficit),
        "slowing": -more_deficit * delay - more_lost * per_speed_after_delay,
        "deceleration": more_softness * np.mean(speeds_after_delay**2) / 2,
        "remainder": original.remainder - changed.remainder,
    }
    return BrakingComparison(original, changed, {name: float(part) for name, part in parts.items()}, point)


MIN_PART = 0.005
"""Smallest part of a distance that a sentence mentions [m]: half a centimetre."""
PART_PHRASES = {
    "gap": ("gap", "m", "it begins to brake at a smaller gap", "it begins to brake at a larger gap"),
    "speed": ("speed", "m/s at the command", "it is faster", "it is slower"),
    "delay": ("delay", "s after the command", "its brake pedal follows later", "its brake pedal follows sooner"),
    "slowing": (
        "speed_lost",
        "m/s",
        "it loses less speed while the pedal moves",
        "it loses more speed while the pedal moves",
    ),
    "deceleration": (
        "deceleration",
        "m/s^2",
        "it decelerates less with the pedal down",
        "it decelerates more with the pedal down",
    ),
}
"""For each part the attribute of `Braking` that explains it, its unit, and phrases: if it costs distance, and if it
gains distance.
"""


def ending_in_words(run: RunSummary) -> str:
    """How a run ended, in words."""
    if run.outcome == Outcome.COLLISION:
        return f"collides at {-run.safety_degree:.2f} m/s"
    end = OUTCOME_VERBS[Outcome(run.outcome)]
    return end if np.isnan(run.safety_degree) else f"{end}, safety degree {run.safety_degree:.2f} m"


def sentence(comparison: BrakingComparison) -> str:
    """Why the changed vehicle is less safe than the original; a part below 0 is gained."""
    original, changed = comparison.original, comparison.changed
    subject = f"At {comparison.point}: the" if comparison.point else "The"
    endings = f"{subject} original {ending_in_words(original)}; this one {ending_in_words(changed)}."
    if not comparison.parts:
        return f"{endings} {'It' if changed.braking is None else 'The original'} never slows down by braking."
    phrases = []
    for name, part in sorted(comparison.parts.items(), key=lambda item: -item[1]):
        if name in PART_PHRASES and abs(part) >= MIN_PART:
            attribute, unit, costs, gains = PART_PHRASES[name]
            here, there = (getattr(run.braking, attribute) for run in (changed, original))
            phrase = costs if part > 0 else gains
            phrases.append(f"{part:.2f} m because {phrase} ({here:.2f} instead of {there:.2f} {unit})")
    if abs(comparison.parts["remainder"]) > MAX_OMITTED_REMAINDER:
        phrases.append(f"{comparison.parts['remainder']:.2f} m unexplained")
    lost = f"{endings} Its margin, the gap at the brake command less the distance needed to stop, is "
    return f"{lost}{sum(comparison.parts.values()):.2f} m smaller: {', '.join(phrases) or 'they brake alike'}."
