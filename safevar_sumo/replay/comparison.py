"""The runs of a changed vehicle and of the original vehicle, to be drawn side by side: the moments
at which each begins to brake, is nearest to the obstacle, and ends, and the roads and actors.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from typing import NamedTuple

import numpy as np

from safevar_sumo.api.simulation import Simulation
from safevar_sumo.metrics import METRICS, Measure
from safevar_sumo.questions.arguments import checked
from safevar_sumo.questions.braking import brake_onset
from safevar_sumo.questions.words import OUTCOME_VERBS, change_texts, collision_in_words
from safevar_sumo.records import (
    Evaluations,
    FloatArray,
    JsonObject,
    Outcome,
    SimulationRuns,
    Trace,
)
from safevar_sumo.results import UNKNOWN
from safevar_sumo.scenarios import VUT, Point
from safevar_sumo.scenarios.ahead import LANE_WIDTH
from safevar_sumo.study import unit_text
from safevar_sumo.sumo.bodies import Film
from safevar_sumo.sumo.network import NetworkFiles, built_network, network_for
from safevar_sumo.sumo.system import System
from safevar_sumo.sumo.verification import drive_again


class DrawnLane(NamedTuple):
    """A lane of SUMO: the P points of its middle line, shape (P, 2), and its width [m]. Of an area,
    the points of its outline, and width 0.

    `kind` is road, path (only for persons), crossing, or area (for persons, between paths).
    """

    kind: str
    line: FloatArray
    width: float


class Moments(NamedTuple):
    """The samples of a run's moments, as indices; None if the run has no such moment.

    - `braking_start`: the vehicle begins to brake for the obstacle.
    - `nearest`: the obstacle is nearest (in a collision, the impact).
    - `end`: the last sample of the run.
    """

    braking_start: int | None
    nearest: int | None
    end: int

    @property
    def decided(self) -> int:
        """The sample from which on pictures say how the run ends: the nearest moment, or the end of
        the run without such a moment.
        """
        if self.nearest is None:
            return self.end
        return self.nearest


# Rows of a comparison.
ORIGINAL = 0
CHANGED = 1
COLOURS = {ORIGINAL: "#0072b2", CHANGED: "#d55e00"}
"""Colours of the vehicles by row: blue and vermillion of the palette by Okabe and Ito, which
colour-blind people can tell apart.
"""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Runs of the original vehicle (row 0) and of a changed vehicle (row 1; this row is missing if
    nothing is changed).

    `title` is the title of the study, with the name of the `point` of a matrix. `system` drove the
    vehicles at this point. `evaluations` and `runs` have a row for each vehicle. `objectives` are
    the metrics that the study optimises besides the metrics that every study has.
    """

    title: str
    system: System
    point: Point
    evaluations: Evaluations
    runs: SimulationRuns
    objectives: tuple[Measure, ...]

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
                end=int(self.runs.trace.last_active[row]),
            )
            for row in self.rows
        ]

    @property
    def last_sample(self) -> int:
        """The last sample of the longer run."""
        return max(moments.end for moments in self.moments)

    @property
    def has_position(self) -> bool:
        """Whether the runs have the vehicles' positions: a user's simulator need not state them."""
        return not self.runs.lacking("position").any()

    def refuse_without_position(self) -> None:
        """Raise an InputError if the runs have no positions: then there is nothing to draw."""
        if not self.has_position:
            self.system.require("a picture", "--plot or --animate")

    @property
    def network(self) -> NetworkFiles:
        """The scenario's network, with the lanes that the scenario's parameters define."""
        return network_for(self.point.scenario)

    @cached_property
    def road(self) -> list[DrawnLane]:
        """The lanes of the network; for a user's simulator, a single straight lane."""
        if not self.system.mover.has("roads"):
            return [lane_below(self.runs.trace)]
        return read_road(self.network)

    @cached_property
    def tracks(self) -> dict[str, Film]:
        """The motion of all actors in SUMO at the samples of `runs`, by name in alphabetical order.

        Samples after the end of a run are meaningless: SUMO continues with the other run. With a
        user's simulator, vehicle and obstacle move along a straight line.
        """
        if not self.system.mover.has("roads"):
            return films_along(self.runs.trace)
        tracks = dict[str, Film]()
        samples = count()
        length = len(self.runs.trace.time)
        drive_again(
            self.system,
            self.evaluations.settings,
            self.runs,
            lambda world: world.film(tracks, next(samples), length),
        )
        return dict(sorted(tracks.items()))

    def name(self, row: int) -> str:
        if row == ORIGINAL:
            return "original"
        return "changed"

    @property
    def changes(self) -> list[str]:
        """The changes of the changed vehicle in words, each with its unit and its share."""
        characteristics = self.system.characteristics
        # The last row is the changed vehicle or, if nothing is changed, the original.
        return change_texts(
            characteristics, characteristics.named(self.evaluations.settings[-1])
        )

    def verdict(self, row: int) -> str:
        """The end of a run in words: "collides at 3.9 m/s", or "stops with 2.22 m to spare"."""
        runs = self.runs
        nearest = self.moments[row].nearest

        if not math.isnan(runs.closing_speed[row]):
            return collision_in_words(
                runs.closing_speed[row], runs.collision_speed[row], digits=1
            )
        ending = OUTCOME_VERBS[runs.outcome[row]]
        if nearest is not None and runs.outcome[row] == Outcome.STOPPED:
            has_gap = self.system.mover.has("roads")
            distance = runs.trace.gap if has_gap else runs.encounter.separation
            ending = f"{ending} with {distance[nearest, row]:.2f} m to spare"

        texts = [ending]
        for metric in self.objectives:
            value = self.evaluations.metrics[metric.name][row]
            if np.isfinite(value):
                texts.append(f"{metric.title} {value:.1f}{unit_text(metric.unit)}")
        return ", ".join(texts)


# A simulator of the user's own states no sizes: these sizes are drawn [m].
BODY_LENGTH = 4.5
BODY_WIDTH = 1.8
ROAD_BEHIND = 20.0
"""How far the lane is drawn behind the vehicle of such a simulator [m]."""
ROAD_AHEAD = 100.0
"""How far the lane is drawn ahead of the vehicle of such a simulator [m]."""


def films_along(trace: Trace) -> dict[str, Film]:
    """The motion of the vehicles and of the obstacles ahead of them, along a straight line."""

    def film(front: FloatArray, speed: FloatArray) -> Film:
        nothing = np.zeros(front.shape)
        motion = np.stack([front, nothing, nothing + 1, nothing, speed], axis=-1)
        return Film(motion, False, BODY_LENGTH, BODY_WIDTH)

    gap = np.where(np.isfinite(trace.gap), trace.gap, np.nan)
    obstacle = film(trace.position + gap + BODY_LENGTH, trace.obstacle_speed)
    return {"obstacle": obstacle, VUT: film(trace.position, trace.speed)}


def lane_below(trace: Trace) -> DrawnLane:
    """The straight lane below the vehicles of `films_along`."""
    rear = trace.position.min() - ROAD_BEHIND
    front = trace.position.max() + ROAD_AHEAD
    return DrawnLane("road", np.array([[rear, 0.0], [front, 0.0]]), LANE_WIDTH)


@checked
def comparison_of(simulation: Simulation) -> Comparison:
    """The comparison of a simulation with the simulation of the original vehicle, at the same point
    of a matrix.
    """
    pair = simulation.pair
    scoring = simulation.scoring
    title = simulation.study.title
    if pair.point.name:
        title += f" ({pair.point.name})"
    names = {objective.name for objective in scoring.objectives} - {*METRICS}

    # A command at the impact has no effect any more: pictures show the pedals of the sample before.
    trace = pair.runs.trace
    pedals = np.stack([trace.throttle, trace.brake])
    has_collided = ~np.isnan(pair.runs.collision_speed) & trace.active.any(axis=0)
    for row in np.flatnonzero(has_collided).tolist():
        end = trace.last_active[row]
        pedals[:, end, row] = pedals[:, max(end - 1, 0), row]
    return Comparison(
        title=title,
        system=pair.system,
        point=pair.point,
        evaluations=pair.evaluations,
        runs=replace(
            pair.runs, trace=replace(trace, throttle=pedals[0], brake=pedals[1])
        ),
        objectives=tuple(metric for metric in scoring.metrics if metric.name in names),
    )


def read_road(network: NetworkFiles) -> list[DrawnLane]:
    """Read the lanes of one copy of a network, as netconvert built it."""
    lanes = []
    for edge in ElementTree.parse(built_network(network)).getroot().iter("edge"):
        for lane in edge.iter("lane"):
            # A point is x,y or x,y,z.
            line = [point.split(",")[:2] for point in lane.attrib["shape"].split()]
            usual = (
                "path" if lane.get("allow", "").split() == ["pedestrian"] else "road"
            )
            kinds = {"walkingarea": "area", "crossing": "crossing"}
            kind = kinds.get(edge.get("function", ""), usual)
            # SUMO's lanes are 3.2 m wide by default.
            width = 0.0
            if kind != "area":
                width = float(lane.get("width", 3.2))
            lanes.append(DrawnLane(kind, np.array(line, float), width))
    return lanes


def list_differences(replayed: Evaluations, recorded: JsonObject) -> list[str]:
    """Sentences on differences between the replay of a solution and its row of solutions.csv, with
    the old and the new value.
    """
    differences = []
    if recorded["outcome"] not in (replayed.outcome[0], UNKNOWN):
        differences.append(
            f"the outcome was {recorded['outcome']} and is {replayed.outcome[0]} now"
        )
    for name, values in replayed.metrics.items():
        stored = recorded.get(name, values[0])
        if not np.array_equal(stored, values[0], equal_nan=True):
            differences.append(f"{name} was {stored:.6g} and is {values[0]:.6g} now")
    return differences


def why_different(*, is_imported: bool) -> str:
    """The reason why replays of solutions may differ from the results."""
    if is_imported:
        return "the results are imported: another simulator made them"
    return "the driving system, another model or this program has changed since"
