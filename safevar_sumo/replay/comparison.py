"""A changed vehicle beside the original: braking, nearest moment and end of each run, and when their speeds part."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.analysis.words import ENDS
from safevar_sumo.api.simulation import changed_setting, load_and_assemble
from safevar_sumo.metrics import METRICS, RATING_POINTS, MetricFacts
from safevar_sumo.records import Evaluations, FloatArray, Outcome, SimulationRuns
from safevar_sumo.replay.film import Film, film
from safevar_sumo.results import UNKNOWN
from safevar_sumo.study import Study, StudyLike
from safevar_sumo.sumo.batch import score
from safevar_sumo.sumo.matrix import at_worst
from safevar_sumo.sumo.staging import staged
from safevar_sumo.sumo.system import Measuring, System
from safevar_sumo.vehicles import CharacteristicSet

APART = 0.1
"""Two vehicles have parted when their speeds differ by more [m/s]."""


class Moments(NamedTuple):
    """Numbers of a run's samples; None where there is no such moment.

    `brake`: it begins to brake for the obstacle; `nearest`: the obstacle is nearest (the impact, on a collision); `end`: the
    run's last sample.
    """

    brake: int | None
    nearest: int | None
    end: int


def moments(drives: SimulationRuns, row: int) -> Moments:
    """The moments of one of N runs."""
    return Moments(drives.brake_onset(row), drives.nearest(row), int(np.flatnonzero(drives.trace.active[:, row])[-1]))


def divergence(drives: SimulationRuns, one: int = 0, other: int = 1) -> int | None:
    """The first sample at which the speeds of two of N runs have parted, None if they never do."""
    trace = drives.trace
    both = trace.active[:, one] & trace.active[:, other]
    apart = np.flatnonzero(both & (np.abs(trace.speed[:, one] - trace.speed[:, other]) > APART))
    return int(apart[0]) if apart.size else None


ORIGINAL, CHANGED = 0, 1
"""Rows of a comparison."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Runs of the original vehicle (row 0) and of a changed one (row 1; missing if nothing is changed).

    `title` is the study's, `network` the scenario's, with the lanes that its parameters make; `evaluations` and `film` have one row for
    each vehicle. `objectives` are metrics beyond the paper's that the study searches.
    """

    title: str
    characteristics: CharacteristicSet
    ttc_threshold: float
    network: str
    evaluations: Evaluations
    film: Film
    objectives: tuple[MetricFacts, ...] = ()

    @property
    def rows(self) -> range:
        return range(len(self.evaluations))

    def name(self, row: int) -> str:
        return "original" if row == ORIGINAL else "changed"

    @property
    def changes(self) -> list[str]:
        """Every change in words, with its unit and share."""
        if len(self.evaluations) == 1:
            return []
        return changes_in_words(self.characteristics, self.evaluations.settings[CHANGED])

    def verdict(self, row: int) -> str:
        """How a run ended, in words: hits at 3.9 m/s, or stops with 2.22 m to spare."""
        drives = self.film.drives
        if not math.isnan(drives.collision_speed[row]):
            return f"hits at {drives.collision_speed[row]:.1f} m/s"
        nearest = moments(drives, row).nearest
        word = ENDS[Outcome(str(drives.outcome[row]))]
        if nearest is not None and drives.outcome[row] == Outcome.STOPPED:
            word = f"{word} with {drives.trace.gap[nearest, row]:.2f} m to spare"
        values = [(metric, self.evaluations.metrics[metric.name][row]) for metric in self.objectives]
        return ", ".join([word, *(f"{metric.title} {value:.1f} {metric.unit}" for metric, value in values if np.isfinite(value))])


def changes_in_words(characteristics: CharacteristicSet, setting: FloatArray) -> list[str]:
    """What differs from the original: `tireFric 3.5 → 1.1 (-69 %)`."""
    return [f"{member.name} {number(member.original)} → {number(value)}{spaced(member.unit)} "
            f"({(value - member.original) / abs(member.original) * 100:+.0f}\N{NO-BREAK SPACE}%)"
            for member, value in zip(characteristics, setting.tolist(), strict=True) if value != member.original]


def number(value: float) -> str:
    """A number with four significant digits; a larger one with all digits before the point."""
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e15 else f"{value:.4g}"


def spaced(unit: str) -> str:
    """A unit as it follows a number, its powers raised; nothing for a pure number."""
    return "" if unit == "-" else " " + raised(unit)


def raised(text: str) -> str:
    """A text with units such as m/s^2 as they are printed: m/s²."""
    return text.replace("^2", "²").replace("^3", "³")


def compare(study: StudyLike, changes: Mapping[str, float] | None = None, *, filtered: bool = True, beyond: bool = False) -> Comparison:
    """Simulate one setting beside the original vehicle, in this process; in a matrix, at the point where the setting comes off worst.

    Parameters
    ----------
    study
        A study, or what `load_study` makes one of.
    changes
        Values by characteristic, in their table units; all others are the original's.
    filtered
        Put changes that are smaller than their thresholds back to the original, as every search does.
    beyond
        Take values outside the domains, and a setting that violates the study's constraints, too.

    Raises
    ------
    InputError
        If the study or a change cannot be used.
    SimulationError
        If SUMO fails.
    """
    chosen, system = load_and_assemble(study)
    setting = changed_setting(system, changes, filtered, beyond)
    return compare_setting(chosen, system, system.characteristics.filter(setting) if filtered else setting)


def compare_setting(study: Study, system: System, setting: FloatArray) -> Comparison:
    """Simulate a filtered setting, shape (n,), beside the original vehicle; in a matrix, where the setting comes off worst.

    Raises
    ------
    SimulationError, InputError
        As `simulate`.
    """
    original = system.characteristics.original
    settings = np.stack([original]) if np.array_equal(original, setting) else np.stack([original, setting])
    there = at_worst(system, settings)
    where = [f" ({point.name})" for point in system.matrix if (point.scenario, point.weather) == (there.scenario, there.weather)]
    recording = film(there, settings)
    return Comparison(title=study.title + "".join(where[:1]), characteristics=system.characteristics,
                      ttc_threshold=system.metrics.ttc_threshold, network=staged(there.scenario).folder,
                      evaluations=score(there, settings, recording.drives),
                      film=replace(recording, drives=_up_to_impacts(recording.drives)), objectives=_further_objectives(there.measuring))


def _further_objectives(measuring: Measuring) -> tuple[MetricFacts, ...]:
    """Metrics of one run beyond the paper's; the points of a rating are those of all its cells."""
    searched = {objective.name for objective in measuring.scoring.objectives}
    return tuple(metric for metric in measuring.scoring.metrics if metric.name in searched - {*METRICS, RATING_POINTS.name})


def _up_to_impacts(drives: SimulationRuns) -> SimulationRuns:
    """Runs with the pedals in force at an impact: those of the sample before; a command after it moves nothing any more."""
    trace = drives.trace
    throttle, brake = trace.throttle.copy(), trace.brake.copy()
    for row in np.flatnonzero(~np.isnan(drives.collision_speed)).tolist():
        end = moments(drives, row).end
        for pedal in (throttle, brake):
            pedal[end, row] = pedal[max(end - 1, 0), row]
    return replace(drives, trace=replace(trace, throttle=throttle, brake=brake))


def differences(replayed: Evaluations, recorded: Mapping[str, Any]) -> list[str]:
    """Where the only row of a replay differs from its row of solutions.csv: each with both values."""
    problems = [f"{name} is {recorded[name]:.6g} there and {replayed.metrics[name][0]:.6g} here" for name in replayed.metrics
            if name in recorded and not np.array_equal(float(recorded[name]), float(replayed.metrics[name][0]), equal_nan=True)]
    if recorded["outcome"] not in (replayed.outcome[0], UNKNOWN):
        problems.insert(0, f"the outcome is {recorded['outcome']} there and {replayed.outcome[0]} here")
    return problems
