"""Why a setting is less safe than the original: compares two runs, and splits the lost margin into parts.

The brake is commanded with a gap G ahead, at a speed v. The brake pedal follows within a time t. During t the mean
speed is v - e, and the speed falls by d. After t the mean deceleration is a. The stopping distance is

    D = (v - e) t + (v - d)^2 / (2 a),

and the margin is G - D. A difference of products is split exactly between the two factors,
x2 y2 - x1 y1 = (x2 - x1) (y1 + y2) / 2 + (y2 - y1) (x1 + x2) / 2. So the lost margin, the original's margin minus the
changed vehicle's, is a sum of parts, each with the sign of one difference: gap (G smaller), speed (v larger), delay (t
larger), slowing (e and d: less speed lost while the pedal moves) and deceleration (a smaller). If the obstacle moves,
v and a are relative to it; it counts as moving at its mean speed during the braking.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.words import ending_in_words
from safevar_sumo.records import STANDSTILL, FloatArray, SimulationRuns

PEDAL_SHARE = 0.9
"""Share of the brake command at which the brake pedal counts as having followed the command [-]."""
COAST_DECELERATION = 0.1
"""Deceleration of a vehicle that rolls without a brake [m/s^2]: a rolling resistance of 1 % of its weight."""
MAX_OMITTED_REMAINDER = 0.05
"""A sentence leaves out the unexplained part of the lost margin if it is at most this long [m]."""
OBSTACLE_DECIMALS = 6
"""Decimals of an obstacle's speed, so that rounding errors do not move one that stands."""
CRUISE_SHARE = 0.9
"""A vehicle cruises at this share of its highest speed or more [-]."""
REGULATION_SHARE = 0.05
"""With less than this share of its largest brake command, a vehicle only regulates its speed [-]."""
MIN_PART = 0.005
"""Smallest part of a distance that a sentence mentions [m]: half a centimetre."""
PART_PHRASES = {
    "gap": ("gap", "m", "it begins to brake at a {} gap", "smaller", "larger"),
    "speed": ("closing_speed", "m/s at the command", "it is {}", "faster", "slower"),
    "delay": ("delay", "s after the command", "its brake pedal follows {}", "later", "sooner"),
    "slowing": ("speed_lost", "m/s", "it loses {} speed while the pedal moves", "less", "more"),
    "deceleration": ("deceleration", "m/s^2", "it decelerates {} with the pedal down", "less", "more"),
}
"""For each part of the lost margin: the attribute of `Braking` that explains it, its unit, and a phrase with a word if
distance is lost and another one if it is gained.
"""


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
    nearest_gap
        The gap when the obstacle is nearest, without a collision [m]; None on a collision.
    """

    gap: float
    speed: float
    delay: float
    speed_deficit: float
    speed_lost: float
    deceleration: float
    obstacle_speed: float
    nearest_gap: float | None

    @property
    def closing_speed(self) -> float:
        return self.speed - self.obstacle_speed

    @property
    def quantities(self) -> list[float]:
        """The quantities whose differences explain a lost margin."""
        return [self.gap, self.closing_speed, self.delay, self.speed_deficit, self.speed_lost, 1 / self.deceleration]

    @property
    def remainder(self) -> float:
        """The part of the nearest gap that the margin does not explain [m], 0 on a collision.

        The margin is the gap at the command minus the distance in which it is closed, as if the vehicle went on braking
        after the end of the run.
        """
        if self.nearest_gap is None:
            return 0.0
        gap, speed, delay, deficit, lost, inverse_deceleration = self.quantities
        return self.nearest_gap - (gap - (speed - deficit) * delay - (speed - lost) ** 2 * inverse_deceleration / 2)


class BrakingComparison(NamedTuple):
    """How the original and the changed vehicle brake, and the parts of the margin that the changed vehicle lost [m].

    Attributes
    ----------
    original, changed
        How each vehicle brakes; None if it does not brake for the obstacle.
    parts
        The parts by name; one is the remainder, which no difference explains. Empty if one of the vehicles does not
        brake.
    endings
        How the runs of the original and of the changed vehicle end, in words.
    point
        Name of the test point; empty without a test matrix.
    """

    original: Braking | None
    changed: Braking | None
    parts: dict[str, float]
    endings: tuple[str, str]
    point: str = ""

    def __str__(self) -> str:
        """Why the changed vehicle is less safe than the original; a part below 0 is gained."""
        subject = f"At {self.point}: the" if self.point else "The"
        endings = f"{subject} original {self.endings[0]}; this one {self.endings[1]}."
        if not self.parts:
            return f"{endings} {'It' if self.changed is None else 'The original'} never slows down by braking."
        phrases = []
        for name, part in sorted(self.parts.items(), key=lambda item: -item[1]):
            if name in PART_PHRASES and abs(part) >= MIN_PART:
                attribute, unit, phrase, word_if_lost, word_if_gained = PART_PHRASES[name]
                value, original_value = (getattr(braking, attribute) for braking in (self.changed, self.original))
                reason = phrase.format(word_if_lost if part > 0 else word_if_gained)
                phrases.append(f"{part:.2f} m because {reason} ({value:.2f} instead of {original_value:.2f} {unit})")
        if abs(self.parts["remainder"]) > MAX_OMITTED_REMAINDER:
            phrases.append(f"{self.parts['remainder']:.2f} m unexplained")
        return (
            f"{endings} Its margin, the gap at the brake command less the distance needed to stop, is "
            f"{sum(self.parts.values()):.2f} m smaller: {', '.join(phrases) or 'they brake alike'}."
        )


def brake_onset(runs: SimulationRuns, column: int) -> int | None:
    """The sample at which vehicle `column` begins to brake for the obstacle, before the obstacle is nearest; None if it
    does not brake.

    A braking manoeuvre has brake commands of at least `REGULATION_SHARE` times the largest one. It begins where the
    command starts to rise towards that, and ends where the throttle or a smaller brake command regulates the speed
    again. The manoeuvre that counts is

    1. the one in which the speed falls below `CRUISE_SHARE` of the highest speed for the last time, as earlier
       manoeuvres, such as those of a cruise control after an overshoot, did not slow the vehicle down;
    2. otherwise the first one after that;
    3. otherwise none if the vehicle collides, and its last one if it does not.
    """
    trace, nearest_sample = runs.trace, runs.nearest(column)
    active = trace.active[: None if nearest_sample is None else nearest_sample + 1, column]
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
    while onset > 0 and brake[onset - 1] > (brake[onset - 2] if onset > 1 else 0):  # the command already rises
        onset -= 1
    return onset


def measure_braking(runs: SimulationRuns, column: int) -> Braking | None:
    """The braking of vehicle `column`; None if it does not brake, or only coasts after the pedal has followed."""
    onset, nearest_sample, trace = brake_onset(runs, column), runs.nearest(column), runs.trace
    if onset is None:
        return None
    last = int(np.flatnonzero(trace.active[:, column])[-1]) if nearest_sample is None else nearest_sample
    position = trace.position[: last + 1, column]
    elapsed = trace.time[last] - trace.time[onset]
    obstacle_shift = position[last] + trace.gap[last, column] - position[onset] - trace.gap[onset, column]
    obstacle_speed = 0.0
    if last > onset and np.isfinite(obstacle_shift):
        obstacle_speed = round(float(obstacle_shift / elapsed), OBSTACLE_DECIMALS)
    relative_speed = trace.speed[: last + 1, column] - obstacle_speed
    relative_position = position - obstacle_speed * trace.time[: last + 1]
    has_followed = trace.pedal[onset : last + 1, column] >= PEDAL_SHARE * trace.brake[onset : last + 1, column]
    followed = onset + int(np.argmax(has_followed))
    distance = relative_position[last] - relative_position[followed]
    specific_energy = (relative_speed[followed] ** 2 - relative_speed[last] ** 2) / 2  # which the brake takes, per mass
    if not has_followed.any() or distance <= 0 or specific_energy <= COAST_DECELERATION * distance:
        return None
    initial_speed, delay = float(relative_speed[onset]), (followed - onset) * trace.step
    has_collided = nearest_sample is None or np.isfinite(runs.collision_speed[column])
    mean_speed = float(relative_position[followed] - relative_position[onset]) / delay if delay else initial_speed
    return Braking(
        gap=float(trace.gap[onset, column]),
        speed=initial_speed + obstacle_speed,
        delay=delay,
        speed_deficit=initial_speed - mean_speed,
        speed_lost=initial_speed - float(relative_speed[followed]),
        deceleration=specific_energy / distance,
        obstacle_speed=obstacle_speed,
        nearest_gap=None if has_collided else float(trace.gap[last, column]),
    )


def compare_braking(runs: SimulationRuns, column: int, degrees: FloatArray, point: str = "") -> BrakingComparison:
    """Compare vehicle `column` with the original vehicle, which is vehicle 0, at the same test point.

    `degrees` are the safety degrees of all vehicles, `point` is the name of the point.
    """
    original, changed = measure_braking(runs, 0), measure_braking(runs, column)
    endings = ending_in_words(runs.outcome[0], degrees[0]), ending_in_words(runs.outcome[column], degrees[column])
    if original is None or changed is None:
        return BrakingComparison(original, changed, {}, endings, point)
    quantities = np.array([original.quantities, changed.quantities])
    _, speed, delay, deficit, lost, inverse_deceleration = quantities.mean(axis=0)
    more_gap, more_speed, more_delay, more_deficit, more_lost, more_inverse = np.diff(quantities, axis=0)[0]
    distance_per_speed_after_delay = (speed - lost) * inverse_deceleration
    speeds_after_delay = quantities[:, 1] - quantities[:, 4]  # closing speed - speed lost
    parts = {
        "gap": -more_gap,
        "speed": more_speed * (delay + distance_per_speed_after_delay),
        "delay": more_delay * (speed - deficit),
        "slowing": -more_deficit * delay - more_lost * distance_per_speed_after_delay,
        "deceleration": more_inverse * np.mean(speeds_after_delay**2) / 2,
        "remainder": original.remainder - changed.remainder,
    }
    return BrakingComparison(original, changed, {name: float(part) for name, part in parts.items()}, endings, point)
