"""Why a setting is less safe than the original: compares two runs, and splits the lost distance into parts.

The brake is commanded with a gap G ahead, at a speed v. The brake pedal follows within a time t. During t the mean speed
is v - e, and the speed falls by d. After t the mean deceleration is a. The stopping distance is

    D = (v - e) t + (v - d)^2 / (2 a),

and the margin is G - D. A difference of products is split exactly between the two factors,
x2 y2 - x1 y1 = (x2 - x1) (y1 + y2) / 2 + (y2 - y1) (x1 + x2) / 2. So the margin lost between two runs is a sum of parts,
each with the sign of one difference: gap (G smaller), speed (v larger), delay (t larger), slowing (e and d: less speed
lost while the pedal moves) and deceleration (a smaller).
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
"""A sentence leaves out the unexplained part of the lost distance if it is at most this long [m]."""
CRUISE_SHARE, REGULATION_SHARE = 0.9, 0.05
"""A vehicle cruises from this share of its highest speed; below this share of its largest brake command it only regulates its speed [-]."""


class Braking(NamedTuple):
    """How a vehicle braked for the obstacle.

    Attributes
    ----------
    time, gap, speed
        Time, gap and speed when the brake was commanded (`brake_onset`) [s, m, m/s].
    delay
        Time from the command until the brake pedal has followed it [s].
    mean_speed_lost, speed_lost
        Speed at the command minus the mean speed during the delay, and minus the speed at the end of the delay [m/s].
    deceleration
        Mean deceleration after the delay [m/s^2], averaged over the distance, as in UN R13-H.
    """

    time: float
    gap: float
    speed: float
    delay: float
    mean_speed_lost: float
    speed_lost: float
    deceleration: float

    @property
    def stopping_distance(self) -> float:
        """Distance from the command to standstill [m]; the mean deceleration is assumed to continue after the run."""
        return (self.speed - self.mean_speed_lost) * self.delay + (self.speed - self.speed_lost)**2 / (2 * self.deceleration)

    @property
    def margin(self) -> float:
        """Gap at the command minus the distance needed [m]."""
        return self.gap - self.stopping_distance


class RunSummary(NamedTuple):
    """Summary of one run; `braking` is None if the vehicle did not brake for the obstacle.

    `safety_degree` is in m, or -m/s; NaN if undefined. `least_gap` is the gap when the obstacle is nearest [m], NaN on a collision.
    """

    outcome: str
    safety_degree: float
    braking: Braking | None
    least_gap: float
    collision_speed: float


class BrakingComparison(NamedTuple):
    """Runs of the original and of the changed vehicle; the `parts` [m], with the remainder, add up to the lost distance.

    `parts` is empty if one of the vehicles never braked. `point` names the point of a matrix. `saved_distances` are the distances that the
    two vehicles save by slowing down while the pedal moves [m].
    """

    original: RunSummary
    changed: RunSummary
    parts: dict[str, float]
    point: str = ""
    saved_distances: tuple[float, float] = (0.0, 0.0)

    @property
    def lost_distance(self) -> float:
        """Lost distance, below 0 if distance is gained [m]."""
        return sum(self.parts.values())


def brake_onset(runs: SimulationRuns, column: int) -> int | None:
    """The sample at which vehicle `column` begins to brake for the obstacle, before the obstacle is nearest; None if it does not brake.

    A braking manoeuvre begins where the brake command starts to rise to at least `REGULATION_SHARE` times the largest command; it ends
    where the throttle or a smaller brake command regulates the speed again. The manoeuvre that counts is under way when the vehicle
    last cruises (at `CRUISE_SHARE` of its highest speed or more), or is the first manoeuvre after that: earlier manoeuvres, such as
    those of a cruise control after an overshoot, did not slow the vehicle down. If there is no such manoeuvre, a vehicle that collides has
    not braked for the obstacle; if the vehicle does not collide, its last manoeuvre counts.
    """
    trace, nearest = runs.trace, runs.nearest(column)
    active = trace.active[:None if nearest is None else nearest + 1, column]
    speed = np.where(active, trace.speed[:len(active), column], 0.0)
    brake = np.where(speed > STANDSTILL, trace.brake[:len(active), column], 0.0)
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
    collision_speed, nearest, onset = float(runs.collision_speed[column]), runs.nearest(column), brake_onset(runs, column)
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
    speed, position = trace.speed[:last + 1, column], trace.position[:last + 1, column]
    has_followed = trace.pedal[first:last + 1, column] >= PEDAL_SHARE * trace.brake[first:last + 1, column]
    end_of_delay = first + int(np.argmax(has_followed))
    distance, energy = float(position[last] - position[end_of_delay]), float(speed[end_of_delay]**2 - speed[last]**2) / 2
    if not has_followed.any() or distance <= 0 or energy <= COAST_DECELERATION * distance:
        return None
    initial_speed, delay = float(speed[first]), (end_of_delay - first) * trace.step
    return Braking(
        time=float(trace.time[first]), gap=float(trace.gap[first, column]), speed=initial_speed, delay=delay,
        mean_speed_lost=initial_speed - float(position[end_of_delay] - position[first]) / delay if end_of_delay > first else 0.0,
        speed_lost=initial_speed - float(speed[end_of_delay]), deceleration=energy / distance)


def compare_braking(original: RunSummary, changed: RunSummary, point: str = "") -> BrakingComparison:
    """Compare a changed vehicle's run with the original vehicle's run at the same point; `point` names the point of a matrix."""
    original_braking, changed_braking = original.braking, _braking_to_compare(changed, original)
    if original_braking is None or changed_braking is None:
        return BrakingComparison(original, changed, {}, point)
    parts, saved_distances = _split_lost_margin(original_braking, changed_braking)
    gap_errors = original.least_gap - original_braking.margin, changed.least_gap - changed_braking.margin
    remainders = [0.0 if np.isnan(error) else error for error in gap_errors]
    return BrakingComparison(original, changed, {**parts, "remainder": remainders[0] - remainders[1]}, point, saved_distances)


def _braking_to_compare(changed: RunSummary, original: RunSummary) -> Braking | None:
    """The braking of a changed vehicle; if it collides without braking, the original vehicle's braking at the changed vehicle's speed."""
    if changed.braking is not None or original.braking is None or not np.isfinite(changed.collision_speed):
        return changed.braking
    return original.braking._replace(time=np.nan, gap=0.0, speed=max(changed.collision_speed, original.braking.speed_lost))


def _split_lost_margin(original: Braking, changed: Braking) -> tuple[dict[str, float], tuple[float, float]]:
    """Parts of the lost margin by cause [m], and the distances that the two vehicles save while the pedal moves [m]."""
    mean_delay, mean_inverse = (original.delay + changed.delay) / 2, (1 / original.deceleration + 1 / changed.deceleration) / 2
    later_speeds = [braking.speed - braking.speed_lost for braking in (original, changed)]
    mean_speed = sum(later_speeds) / 2
    delay_speeds = [braking.speed - braking.mean_speed_lost for braking in (original, changed)]
    savings = [braking.mean_speed_lost * mean_delay + braking.speed_lost * mean_speed * mean_inverse for braking in (original, changed)]
    return {
        "gap": original.gap - changed.gap,
        "speed": (changed.speed - original.speed) * (mean_delay + mean_speed * mean_inverse),
        "delay": (changed.delay - original.delay) * sum(delay_speeds) / 2,
        "slowing": savings[0] - savings[1],
        "deceleration": (1 / changed.deceleration - 1 / original.deceleration) * (later_speeds[0]**2 + later_speeds[1]**2) / 4
    }, (savings[0], savings[1])


MIN_PART = 0.005
"""Smallest part of a distance that a sentence mentions [m]: half a centimetre."""
PART_PHRASES = {
    "gap": ("it begins to brake nearer", "it begins to brake farther away"), "speed": ("it is faster", "it is slower"),
    "delay": ("its brake pedal follows later", "its brake pedal follows sooner"),
    "slowing": ("it slows less while the pedal moves", "it slows more while the pedal moves"),
    "deceleration": ("it brakes more weakly", "it brakes harder")}
"""Phrases for each part: if it costs distance, and if it gains distance."""


def ending_in_words(run: RunSummary) -> str:
    """How a run ended, in words."""
    if run.outcome == Outcome.COLLISION:
        return f"collides at {run.collision_speed:.2f} m/s"
    end = OUTCOME_VERBS.get(Outcome(run.outcome), run.outcome)
    return end if run.safety_degree != run.safety_degree else f"{end}, safety degree {run.safety_degree:.2f} m"


def sentence(comparison: BrakingComparison, *, full: bool = False) -> str:
    """Why the changed vehicle is less safe than the original, in one sentence or two; `full` explains what the lost distance is."""
    subject = f"At {comparison.point}: the" if comparison.point else "The"
    endings = f"{subject} original {ending_in_words(comparison.original)}; this one {ending_in_words(comparison.changed)}."
    original_braking, changed_braking = comparison.original.braking, comparison.changed.braking
    if original_braking is None and changed_braking is None:
        return f"{endings} Neither of them brakes."
    if not comparison.parts:
        return f"{endings} {'The original' if original_braking is None else 'It'} does not slow down by its brake."
    without_brake = "" if changed_braking is not None else ", without any effect of its brake"
    parts, is_lost = comparison.parts, comparison.lost_distance >= 0
    loss_word, gain_word = ("", "gained ") if is_lost else ("lost ", "")
    phrases = [f"{abs(parts[name]):.2f} m {loss_word if parts[name] > 0 else gain_word}because {PART_PHRASES[name][parts[name] < 0]}"
               f"{_quantities_in_words(comparison, name)}"
               for name in sorted(PART_PHRASES, key=lambda name: -parts[name]) if abs(parts[name]) >= MIN_PART]
    if abs(parts["remainder"]) > MAX_OMITTED_REMAINDER:
        phrases.append(f"{parts['remainder']:+.2f} m that this does not explain")
    if not phrases:
        return f"{endings} They brake alike."
    distance = f"{abs(comparison.lost_distance):.2f} m"
    introduction = f"Of the {distance} {'lost' if is_lost else 'gained'}" if not full else (
        f"Its margin, the gap at the brake command less the distance needed to stop, is {distance} {'smaller' if is_lost else 'larger'}")
    return f"{endings} {introduction}{without_brake}: {join_phrases(phrases)}."


def _quantities_in_words(comparison: BrakingComparison, part: str) -> str:
    """The quantity that explains a part, for the changed vehicle and for the original vehicle."""
    original_braking, changed_braking = comparison.original.braking, comparison.changed.braking
    if original_braking is None or changed_braking is None:
        return ""
    quantities = {"gap": (changed_braking.gap, original_braking.gap, "m before"),
                  "speed": (changed_braking.speed, original_braking.speed, "m/s at the command"),
                  "delay": (changed_braking.delay, original_braking.delay, "s after the command"),
                  "slowing": (comparison.saved_distances[1], comparison.saved_distances[0], "m saved"),
                  "deceleration": (changed_braking.deceleration, original_braking.deceleration, "m/s^2")}
    changed, original, unit = quantities[part]
    decimals = next((digits for digits in range(2, 9) if f"{changed:.{digits}f}" != f"{original:.{digits}f}"), 2)
    return f" ({changed:.{decimals}f} instead of {original:.{decimals}f} {unit})"
