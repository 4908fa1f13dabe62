"""A changed vehicle beside the original, seen from above: when each begins to brake, is nearest and ends."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from typing import NamedTuple

import numpy as np

from safevar_sumo.api.simulation import changed_setting, load_and_assemble
from safevar_sumo.metrics import METRICS, RATING_POINTS, Measure
from safevar_sumo.questions.braking import brake_onset
from safevar_sumo.questions.words import OUTCOME_VERBS, change_texts
from safevar_sumo.records import Evaluations, FloatArray, JsonObject, Outcome, SimulationRuns
from safevar_sumo.results import UNKNOWN
from safevar_sumo.study import Study, StudyLike, unit_text
from safevar_sumo.sumo.batch import score
from safevar_sumo.sumo.bodies import Film
from safevar_sumo.sumo.matrix import simulate, system_at_worst_point
from safevar_sumo.sumo.network import Network, built_network, stage_network
from safevar_sumo.sumo.system import System
from safevar_sumo.sumo.verification import drive_again
from safevar_sumo.vehicles import CharacteristicSet


class LaneLine(NamedTuple):
    """A lane of SUMO: its middle line of P points, shape (P, 2), and width [m]; or the outline of an area, and 0.

    `kind` is road, path (only for persons), crossing or area (for persons, between paths).
    """

    kind: str
    line: FloatArray
    width: float


class Moments(NamedTuple):
    """Indices of a run's samples; None where there is no such moment.

    - `braking_start`: the vehicle begins to brake for the obstacle;
    - `nearest`: the obstacle is nearest (on a collision, the impact);
    - `end`: the last sample of the run.
    """

    braking_start: int | None
    nearest: int | None
    end: int

    @property
    def decided(self) -> int:
        """The sample from which on it is known how the run ends."""
        return self.end if self.nearest is None else self.nearest


ORIGINAL, CHANGED = 0, 1
"""Rows of a comparison."""
COLOURS = {ORIGINAL: "#0072b2", CHANGED: "#d55e00"}
"""Okabe and Ito's blue and vermillion."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Runs of the original vehicle (row 0) and of a changed one (row 1; missing if nothing is changed).

    `title` is the study's title and the `point` of its matrix, `network` the scenario's network with the lanes that the
    scenario's parameters define, `road` the lanes; `evaluations` and `runs` have one row for each vehicle. `tracks`
    holds the tracks of actors by name: their samples after the end of a run are meaningless, as SUMO continues with the
    other run. `objectives` are metrics that the study optimises besides the paper's metrics.
    """

    title: str
    characteristics: CharacteristicSet
    ttc_threshold: float
    network: Network
    road: tuple[LaneLine, ...]
    evaluations: Evaluations
    runs: SimulationRuns
    tracks: Mapping[str, Film]
    objectives: tuple[Measure, ...] = ()
    point: str = ""

    @property
    def rows(self) -> range:
        return range(len(self.evaluations))

    @cached_property
    def moments(self) -> list[Moments]:
        """The moments of each run."""
        return [
            Moments(
                braking_start=brake_onset(self.runs, row),
                nearest=self.runs.nearest(row),
                end=int(np.flatnonzero(self.runs.trace.active[:, row])[-1]),
            )
            for row in self.rows
        ]

    def name(self, row: int) -> str:
        return "original" if row == ORIGINAL else "changed"

    @property
    def changes(self) -> list[str]:
        """Every change in words, with its unit and share."""
        setting = self.evaluations.settings[-1].tolist()
        return change_texts(self.characteristics, dict(zip(self.characteristics.names, setting, strict=True)))

    def verdict(self, row: int) -> str:
        """The end of a run in words: "collides at 3.9 m/s", or "stops with 2.22 m to spare"."""
        runs = self.runs
        nearest = self.moments[row].nearest
        if not math.isnan(runs.closing_speed[row]):
            return f"collides at {runs.closing_speed[row]:.1f} m/s"
        ending = OUTCOME_VERBS[Outcome(str(runs.outcome[row]))]
        if nearest is not None and runs.outcome[row] == Outcome.STOPPED:
            ending = f"{ending} with {runs.trace.gap[nearest, row]:.2f} m to spare"
        values = [(metric, self.evaluations.metrics[metric.name][row]) for metric in self.objectives]
        texts = (
            f"{metric.title} {value:.1f}{unit_text(metric.unit)}" for metric, value in values if np.isfinite(value)
        )
        return ", ".join([ending, *texts])


def compare_with_original(
    study: StudyLike, changes: Mapping[str, float] | None = None, *, filtered: bool = True, beyond: bool = False
) -> Comparison:
    """Simulate one setting beside the original vehicle, in this process; in a matrix, at the setting's worst point.

    Parameters
    ----------
    study
        A study, or anything that `load_study` accepts.
    changes
        Values by characteristic, in their table units; all other characteristics keep the original's value.
    filtered
        Put changes that are smaller than their thresholds back to the original, as every search does.
    beyond
        Also accept values outside the domains, and a setting that violates the study's constraints.

    Raises
    ------
    InputError
        If the study or a change cannot be used.
    SimulationError
        If SUMO fails.
    """
    loaded_study, system = load_and_assemble(study)
    setting = changed_setting(system, changes, filtered, beyond)
    return compare_setting(loaded_study, system, system.characteristics.filter(setting) if filtered else setting)


def compare_setting(study: Study, system: System, setting: FloatArray) -> Comparison:
    """Simulate a filtered setting, shape (n,), beside the original vehicle; in a matrix, at the setting's worst point.

    Raises
    ------
    SimulationError, InputError
        If `simulate` raises it.
    """
    original = system.characteristics.with_original_vehicle(setting)
    settings = np.stack([original]) if np.array_equal(original, setting) else np.stack([original, setting])
    worst_system = system_at_worst_point(system, settings)
    worst = worst_system.scenario, worst_system.weather
    point = next((point.name for point in system.matrix if (point.scenario, point.weather) == worst), "")
    network = stage_network(worst_system.scenario)
    scoring = worst_system.measuring.scoring
    runs, tracks = _film(worst_system, settings)
    objectives = {objective.name for objective in scoring.objectives} - {*METRICS, RATING_POINTS.name}
    return Comparison(
        title=f"{study.title} ({point})" if point else study.title,
        point=point,
        characteristics=system.characteristics,
        ttc_threshold=system.metrics_table.ttc_threshold,
        network=network,
        road=read_road(network),
        evaluations=score(worst_system, settings, runs),
        runs=_with_pedals_before_impacts(runs),
        tracks=tracks,
        # The points of a rating belong to all cells together.
        objectives=tuple(metric for metric in scoring.metrics if metric.name in objectives),
    )


def _film(system: System, settings: FloatArray) -> tuple[SimulationRuns, dict[str, Film]]:
    """Simulate N settings, shape (N, n), and record in SUMO how all actors move, by name in alphabetical order."""
    runs = simulate(system, settings)
    tracks = dict[str, Film]()
    samples = count()
    length = len(runs.trace.time)
    drive_again(system, settings, runs, lambda world: world.film(tracks, next(samples), length))
    return runs, dict(sorted(tracks.items()))


def read_road(network: Network) -> tuple[LaneLine, ...]:
    """Read the lanes of one copy of a network, as netconvert built it."""
    lanes = []
    for edge in ElementTree.parse(built_network(network)).getroot().iter("edge"):
        for lane in edge.iter("lane"):
            # a point is x,y or x,y,z
            line = [[float(number) for number in point.split(",")[:2]] for point in lane.attrib["shape"].split()]
            kind = {"walkingarea": "area", "crossing": "crossing"}.get(edge.get("function", ""))
            for_persons = lane.get("allow", "").split() == ["pedestrian"]
            width = 0.0 if kind == "area" else float(lane.get("width", 3.2))  # SUMO's default width
            lanes.append(LaneLine(kind or ("path" if for_persons else "road"), np.array(line), width))
    return tuple(lanes)


def _with_pedals_before_impacts(runs: SimulationRuns) -> SimulationRuns:
    """Runs with the pedals of the sample before an impact also at the impact, where a command has no effect any
    more.
    """
    trace = runs.trace
    pedals = np.stack([trace.throttle, trace.brake])
    for row in np.flatnonzero(~np.isnan(runs.collision_speed)).tolist():
        end = int(np.flatnonzero(trace.active[:, row])[-1])
        pedals[:, end, row] = pedals[:, max(end - 1, 0), row]
    return replace(runs, trace=replace(trace, throttle=pedals[0], brake=pedals[1]))


def list_differences(replayed: Evaluations, recorded: JsonObject) -> list[str]:
    """List where the replay of a solution differs from its row of solutions.csv, with both values; rating points are
    left out, as the replay of one cell has none.
    """
    differences = []
    if recorded["outcome"] not in (replayed.outcome[0], UNKNOWN):
        differences.append(f"the outcome was {recorded['outcome']} and is {replayed.outcome[0]} now")
    for name, values in replayed.metrics.items():
        stored = recorded.get(name, values[0])
        if name != RATING_POINTS.name and not np.array_equal(stored, values[0], equal_nan=True):
            differences.append(f"{name} was {stored:.6g} and is {values[0]:.6g} now")
    return differences


def why_different(*, is_imported: bool) -> str:
    """Why replays of solutions may differ from the results."""
    if is_imported:
        return "the results are imported: another simulator made them"
    return "the driving system, another model or this program has changed since"
