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

from safevar_sumo.analysis.words import OUTCOME_VERBS, join_phrases
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
    time, gap, speed
        Time, gap and speed when the brake was commanded (`brake_onset`) [s, m, m/s].
    delay
        Time from the command until the brake pedal has followed it [s].
    speed_deficit
        Speed at the command minus the mean speed during the delay [m/s].
    speed_lost
        Speed at the command minus the speed at the end of the delay [m/s].
    deceleration
        Mean deceleration after the delay [m/s^2], averaged over the distance, as in UN R13-H.
    gears
        Gear at the command and at the end of the delay.
    obstacle_speed
        Mean speed of the obstacle along the vehicle's path from the command on [m/s]; `deceleration` is relative to it.
    """

    time: float
    gap: float
    speed: float
    delay: float
    speed_deficit: float
    speed_lost: float
    deceleration: float
    gears: tuple[float, float] = (0, 0)
    obstacle_speed: float = 0.0

    @property
    def closing_speed(self) -> float:
        """Speed towards the obstacle when the brake was commanded [m/s]."""
        return self.speed - self.obstacle_speed

    @property
    def stopping_distance(self) -> float:
        """Distance by which the gap shrinks from the command on [m], if the mean deceleration continues after the
        run.
        """
        speed_after_delay = self.closing_speed - self.speed_lost
        return (self.closing_speed - self.speed_deficit) * self.delay + speed_after_delay**2 / (2 * self.deceleration)

    @property
    def margin(self) -> float:
        """Gap at the command minus the distance needed [m]."""
        return self.gap - self.stopping_distance


class RunSummary(NamedTuple):
    """Summary of one run; `braking` is None if the vehicle did not brake for the obstacle.

    `safety_degree` is a distance [m] or, on a collision, minus its speed [m/s]; NaN if undefined. `least_gap` is the
    gap when the obstacle is nearest [m], NaN on a collision.
    """

    outcome: str
    safety_degree: float
    braking: Braking | None
    least_gap: float
    collision_speed: float


class BrakingComparison(NamedTuple):
    """Runs of the original and of the changed vehicle, and the parts of the margin that the changed vehicle lost [m].

    One of the `parts` is the remainder, which no difference explains; `parts` is empty if one of the vehicles never
    braked. `point` is the name of a test point.
    """

    original: RunSummary
    changed: RunSummary
    parts: dict[str, float]
    point: str = ""

    @property
    def lost_margin(self) -> float:
        """Sum of the parts [m]; below 0 if the changed vehicle gained margin."""
        return sum(self.parts.values())


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
    collision_speed, nearest, onset = (
        float(runs.collision_speed[column]),
        runs.nearest(column),
        brake_onset(runs, column),
    )
    least_gap, braking = np.nan, None
    if nearest is not None and np.isnan(collision_speed):
        least_gap = float(runs.trace.gap[nearest, column])
    if onset is not None:
        last = int(np.flatnonzero(runs.trace.active[:, column])[-1]) if nearest is None else nearest
        braking = _measure_braking(runs, column, onset, last)
    return RunSummary(str(runs.outcome[column]), safety_degree, braking, least_gap, collision_speed)


def _measure_braking(runs: SimulationRuns, column: int, first: int, last: int) -> Braking | None:
    """The braking from sample `first` to `last`; None if the vehicle only coasts after the pedal has followed."""
    trace = runs.trace
    speed, position = trace.speed[: last + 1, column], trace.position[: last + 1, column]
    elapsed = trace.time[last] - trace.time[first]
    shift = position[last] + trace.gap[last, column] - position[first] - trace.gap[first, column]  # of the obstacle
    obstacle_speed = round(float(shift / elapsed), OBSTACLE_DECIMALS) if last > first and np.isfinite(shift) else 0.0
    speed, position = speed - obstacle_speed, position - obstacle_speed * trace.time[: last + 1]  # relative to it
    has_followed = trace.pedal[first : last + 1, column] >= PEDAL_SHARE * trace.brake[first : last + 1, column]
    end_of_delay = first + int(np.argmax(has_followed))
    distance = float(position[last] - position[end_of_delay])
    specific_energy = float(speed[end_of_delay] ** 2 - speed[last] ** 2) / 2  # energy that the brake takes, per mass
    if not has_followed.any() or distance <= 0 or specific_energy <= COAST_DECELERATION * distance:
        return None
    initial_speed, delay = float(speed[first]), (end_of_delay - first) * trace.step
    return Braking(
        time=float(trace.time[first]),
        gap=float(trace.gap[first, column]),
        speed=initial_speed + obstacle_speed,
        delay=delay,
        speed_deficit=initial_speed - float(position[end_of_delay] - position[first]) / delay
        if end_of_delay > first
        else 0.0,
        speed_lost=initial_speed - float(speed[end_of_delay]),
        deceleration=specific_energy / distance,
        gears=(float(trace.gear[first, column]), float(trace.gear[end_of_delay, column])),
        obstacle_speed=obstacle_speed,
    )


def compare_braking(original: RunSummary, changed: RunSummary, point: str = "") -> BrakingComparison:
    """Compare a changed vehicle's run with the original vehicle's run at the same test point, whose name is `point`."""
    original_braking, changed_braking = original.braking, _braking_to_compare(changed, original)
    if original_braking is None or changed_braking is None:
        return BrakingComparison(original, changed, {}, point)
    parts = _split_lost_margin(original_braking, changed_braking)
    gap_errors = original.least_gap - original_braking.margin, changed.least_gap - changed_braking.margin
    remainders = [0.0 if np.isnan(error) else error for error in gap_errors]
    return BrakingComparison(original, changed, {**parts, "remainder": remainders[0] - remainders[1]}, point)


def _braking_to_compare(changed: RunSummary, original: RunSummary) -> Braking | None:
    """The braking of a changed vehicle; if it collides without braking, the original vehicle's braking at the changed
    vehicle's speed.
    """
    if changed.braking is not None or original.braking is None or not np.isfinite(changed.collision_speed):
        return changed.braking
    least = original.braking.speed_lost + original.braking.obstacle_speed  # so that no speed is negative
    speed = max(changed.collision_speed, least)
    return original.braking._replace(time=np.nan, gap=0.0, speed=speed)


def _split_lost_margin(original: Braking, changed: Braking) -> dict[str, float]:
    """Parts of the lost margin by cause [m].

    With the two runs' means of t, of v - d and of 1 / a, a vehicle saves e t + d (v - d) / a.
    """
    mean_delay, mean_inverse_deceleration = (
        (original.delay + changed.delay) / 2,
        (1 / original.deceleration + 1 / changed.deceleration) / 2,
    )
    speeds_after_delay = [braking.closing_speed - braking.speed_lost for braking in (original, changed)]
    mean_speed_after_delay = sum(speeds_after_delay) / 2
    mean_delay_speeds = [braking.closing_speed - braking.speed_deficit for braking in (original, changed)]
    savings = [
        braking.speed_deficit * mean_delay + braking.speed_lost * mean_speed_after_delay * mean_inverse_deceleration
        for braking in (original, changed)
    ]
    return {
        "gap": original.gap - changed.gap,
        "speed": (
            (changed.closing_speed - original.closing_speed)
            * (mean_delay + mean_speed_after_delay * mean_inverse_deceleration)
        ),
        "delay": (changed.delay - original.delay) * sum(mean_delay_speeds) / 2,
        "slowing": savings[0] - savings[1],
        "deceleration": (
            (1 / changed.deceleration - 1 / original.deceleration)
            * (speeds_after_delay[0] ** 2 + speeds_after_delay[1] ** 2)
            / 4
        ),
    }


MIN_PART = 0.005
"""Smallest part of a distance that a sentence mentions [m]: half a centimetre."""
PART_PHRASES = {
    "gap": ("it begins to brake at a smaller gap", "it begins to brake at a larger gap"),
    "speed": ("it is faster", "it is slower"),
    "delay": ("its brake pedal follows later", "its brake pedal follows sooner"),
    "slowing": ("it slows less while the pedal moves", "it slows more while the pedal moves"),
    "deceleration": ("it decelerates less with the pedal down", "it decelerates more with the pedal down"),
}
"""Phrases for each part: if it costs distance, and if it gains distance."""


def ending_in_words(run: RunSummary) -> str:
    """How a run ended, in words."""
    if run.outcome == Outcome.COLLISION:
        return f"collides at {run.collision_speed:.2f} m/s"
    end = OUTCOME_VERBS.get(Outcome(run.outcome), run.outcome)
    return end if np.isnan(run.safety_degree) else f"{end}, safety degree {run.safety_degree:.2f} m"


def sentence(comparison: BrakingComparison, *, full: bool = False) -> str:
    """Why the changed vehicle is less safe than the original, in one sentence or two; `full` explains what the lost
    margin is.
    """
    subject = f"At {comparison.point}: the" if comparison.point else "The"
    endings = (
        f"{subject} original {ending_in_words(comparison.original)}; this one {ending_in_words(comparison.changed)}."
    )
    original_braking, changed_braking = comparison.original.braking, comparison.changed.braking
    if original_braking is None and changed_braking is None:
        return f"{endings} Neither of them brakes."
    if not comparison.parts:
        return f"{endings} {'The original' if original_braking is None else 'It'} never slows down by braking."
    no_effect = "" if changed_braking is not None else " Its brake has no effect."
    parts, is_lost = comparison.parts, comparison.lost_margin >= 0
    loss_prefix, gain_prefix = ("", "gained ") if is_lost else ("lost ", "")
    phrases = [
        f"{abs(parts[name]):.2f} m {loss_prefix if parts[name] > 0 else gain_prefix}because "
        f"{_phrase_of(comparison, name)}"
        f"{_quantities_in_words(comparison, name)}"
        for name in sorted(PART_PHRASES, key=lambda name: -parts[name])
        if abs(parts[name]) >= MIN_PART
    ]
    if abs(parts["remainder"]) > MAX_OMITTED_REMAINDER:
        phrases.append(f"{parts['remainder']:+.2f} m unexplained")
    if not phrases:
        return f"{endings} They brake alike."
    margin = f"{abs(comparison.lost_margin):.2f} m"
    introduction = (
        f"Of the {margin} {'lost' if is_lost else 'gained'}"
        if not full
        else (
            f"Its margin, the gap at the brake command less the distance needed to stop, is {margin} "
            f"{'smaller' if is_lost else 'larger'}"
        )
    )
    return f"{endings}{no_effect} {introduction}: {join_phrases(phrases)}."


def _phrase_of(comparison: BrakingComparison, part: str) -> str:
    """The phrase for a part; a vehicle that speeds up while its pedal moves does not slow less."""
    gains, changed, original = comparison.parts[part] < 0, comparison.changed.braking, comparison.original.braking
    if (
        part == "slowing"
        and changed is not None
        and original is not None
        and min(changed.speed_lost, original.speed_lost) < 0
    ):
        if changed.speed_lost >= 0:
            return "it does not speed up while the pedal moves"
        before, after = changed.gears
        gear = "" if before == after else f" and the gear changes from {before:g} to {after:g}"
        return (
            f"it speeds up {'' if original.speed_lost >= 0 else 'less ' if gains else 'more '}while the pedal "
            f"moves{gear}"
        )
    return PART_PHRASES[part][gains]


def _quantities_in_words(comparison: BrakingComparison, part: str) -> str:
    """The quantity that explains a part, for the changed vehicle and for the original vehicle."""
    original_braking, changed_braking = comparison.original.braking, comparison.changed.braking
    if original_braking is None or changed_braking is None:
        return ""
    if part == "slowing":
        changes = [
            f"from {one.speed:.2f} to {one.speed - one.speed_lost:.2f}" for one in (changed_braking, original_braking)
        ]
        return f" ({' instead of '.join(changes)} m/s)"
    quantities = {
        "gap": (changed_braking.gap, original_braking.gap, "m"),
        "speed": (changed_braking.speed, original_braking.speed, "m/s at the command"),
        "delay": (changed_braking.delay, original_braking.delay, "s after the command"),
        "deceleration": (changed_braking.deceleration, original_braking.deceleration, "m/s^2"),
    }
    changed, original, unit = quantities[part]
    decimals = next((digits for digits in range(2, 9) if f"{changed:.{digits}f}" != f"{original:.{digits}f}"), 2)
    return f" ({changed:.{decimals}f} instead of {original:.{decimals}f} {unit})"
