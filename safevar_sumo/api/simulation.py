"""Simulate one setting beside the original vehicle, and record a trace of every step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from safevar_sumo.errors import about
from safevar_sumo.metrics import IMPACT_EXCESS, IMPACT_SPEED, Scoring, impact_in_words
from safevar_sumo.metrics.words import runs_in_words
from safevar_sumo.questions.arguments import checked
from safevar_sumo.questions.between import with_set_axes
from safevar_sumo.questions.words import OUTCOME_VERBS, collision_in_words
from safevar_sumo.records import (
    STANDSTILL,
    TIME_DECIMALS,
    Evaluations,
    FloatArray,
    JsonObject,
    NamedValues,
    Observation,
    Outcome,
    SimulationRuns,
    finite_or_none,
    significant,
)
from safevar_sumo.results import record
from safevar_sumo.scenarios import Point, distance_in_words
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.study import SAFETY_DEGREE, Study, StudyLike
from safevar_sumo.sumo.batch import drive_all, score
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.encounters import where_met
from safevar_sumo.sumo.matrix import worst_point
from safevar_sumo.sumo.models import create_shipped_models
from safevar_sumo.sumo.system import System, assemble

if TYPE_CHECKING:
    import pandas as pd


OBSERVATION_HEADS = {
    "speed": "seen speed [m/s]",
    "gap": "seen gap [m]",
    "closing_speed": "seen closing speed [m/s]",
    "lateral": "seen lateral [m]",
    "lateral_speed": "seen lateral speed [m/s]",
}


class Pair(NamedTuple):
    """The original vehicle (row 0) and the changed vehicle (row 1), driven together at one point.
    If the setting equals the original, the pair has row 0 only.

    `system` drove both vehicles. `observations` hold what the driving systems observed at every
    sample, in arrays of shape (1,) or (2,).
    """

    point: Point
    system: System
    runs: SimulationRuns
    evaluations: Evaluations
    observations: Sequence[Observation]


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """One simulated setting, beside the original vehicle.

    Attributes
    ----------
    study
        The study in which the setting was simulated.
    pair
        The original vehicle and the changed vehicle, simulated together.
    row
        The row of this setting's vehicle in the pair: 0 is the original vehicle.
    no_verdict
        The reason why simulations of the study say nothing about its ADS, in a sentence; "" if they
        do.
    reset_values
        Requested values that the filter resets to the original, by name. If the simulation is
        `filtered`, the original's values were simulated. Otherwise only f_diff and f_num_diff use
        them.
    """

    study: Study
    pair: Pair
    row: int
    no_verdict: str
    reset_values: Mapping[str, float]

    @cached_property
    def original(self) -> Simulation:
        """The simulation of the original vehicle in the same encounter, at the same point of a
        matrix. For the original vehicle: the simulation itself.
        """
        if self.row == 0:
            return self
        return replace(self, row=0, reset_values={})

    @property
    def setting(self) -> NamedValues:
        """The simulated value of every characteristic in its table unit."""
        return self.pair.system.characteristics.named(self.evaluation.settings[0])

    @cached_property
    def evaluation(self) -> Evaluations:
        """Outcome, metrics and objectives, as arrays with one row."""
        return self.pair.evaluations.take([self.row])

    @cached_property
    def runs(self) -> SimulationRuns:
        """The trajectory and the outcome of this vehicle alone."""
        return self.pair.runs.of(slice(self.row, self.row + 1))

    @property
    def scoring(self) -> Scoring:
        """The metrics, and the objectives that a search of the study minimises."""
        return self.pair.system.measuring.scoring

    @property
    def outcome(self) -> Outcome:
        """How the simulation ended."""
        return Outcome(self.evaluation.outcome[0])

    @property
    def collision_speed(self) -> float:
        """The vehicle's own speed at the collision [m/s]; NaN without a collision."""
        return float(self.evaluation.collision_speed[0])

    @property
    def metrics(self) -> NamedValues:
        """Safety metrics by name, in the units that `list` prints; NaN where undefined."""
        return self.evaluation.first_metrics

    @property
    def objectives(self) -> NamedValues:
        """The objectives, which a search minimises: f_safe [m, or -m/s after a collision], f_diff
        [fraction] and f_num_diff [characteristics]. f_diff and f_num_diff are those of the filtered
        setting.
        """
        return {
            name: float(self.evaluation.column(name)[0])
            for name in ("f_safe", "f_diff", "f_num_diff")
        }

    @property
    def units(self) -> dict[str, str]:
        """The unit of every number of `to_dict`, by its name."""
        # Objectives may be metrics, too: the dictionary has their names once.
        measures = (*self.scoring.metrics, *self.scoring.objectives)
        return {
            "collision_speed": "m/s",
            **{
                measure.name: measure.unit
                for measure in measures
                if measure.name in self.metrics
            },
            "gap": "m",
            "f_safe": "m, or -m/s",
            "f_diff": "fraction",
            "f_num_diff": "characteristics",
        }

    @cached_property
    def trace(self) -> pd.DataFrame:
        """The trace: one row for each step until the simulation ends. The names of columns have the
        units; NaN for a value that does not exist.

        The columns `gap` (along the vehicle's path) and `lateral` (from the middle of its lane)
        hold the obstacle's true position. The columns that begin with "seen" hold what the ADS
        observed. `ttc` is empty while no gap closes or the vehicle stands. `gap` is empty while no
        obstacle is ahead.
        """
        # Loading pandas takes longer than the simulation.
        import pandas as pd

        trace = self.runs.trace
        ttc = np.where(trace.speed > STANDSTILL, self.runs.time_to_collision, np.inf)
        columns = {
            "position [m]": trace.position,
            "speed [m/s]": trace.speed,
            "acceleration [m/s^2]": np.diff(
                trace.speed, axis=0, prepend=trace.speed[:1]
            )
            / trace.step,
            "gap [m]": trace.gap,
            "ttc [s]": ttc,
            "throttle [-]": trace.throttle,
            "brake [-]": trace.brake,
            "gear [-]": trace.gear,
            "lateral [m]": trace.lateral,
            "lateral speed [m/s]": trace.lateral_speed,
        }

        active = trace.active[:, 0]
        frame = pd.DataFrame({"time [s]": trace.time[active]})
        for name, column in columns.items():
            frame[name] = column[active, 0]

        observations = self.pair.observations
        # A simulator of the user's own has the driving system inside, and returns no observations.
        if not observations:
            return frame.replace([np.inf, -np.inf], np.nan).dropna(
                axis="columns", how="all"
            )
        times = [
            round(float(observation.time), TIME_DECIMALS)
            for observation in observations
        ]
        observed = pd.DataFrame({"time [s]": times})
        for name, head in OBSERVATION_HEADS.items():
            observed[head] = [
                float(getattr(observation, name)[self.row])
                for observation in observations
            ]
        return frame.merge(observed, how="left", on="time [s]").replace(
            [np.inf, -np.inf], np.nan
        )

    @property
    def gap(self) -> float:
        """The least clearance between bodies in the encounter [m]: 0 on a collision, NaN without
        encounter.
        """
        return float(self.evaluation.gaps(self.runs.middles_apart)[0])

    @property
    def numbers(self) -> JsonObject:
        """Outcome, metrics, objectives and gap as plain values; None means undefined. `driven` is
        false if simulations of the study say nothing about its ADS.
        """
        return {
            "driven": not self.no_verdict,
            **record(self.evaluation),
            "gap": finite_or_none(self.gap),
        }

    @property
    def verdict(self) -> str:
        """How the simulation ended, in words. With repeats, the text says how many runs are
        unsafe.
        """
        criterion = self.pair.system.criterion
        runs = runs_in_words(criterion.failing_runs(self.evaluation)[:, 0])
        if runs:
            return f"{self._ending} and {runs}"
        return self._ending

    @property
    def _ending(self) -> str:
        """How the simulation ended: with its impact, its speed or its smallest distance."""
        safety_degree = self.metrics[SAFETY_DEGREE]
        if self.outcome is Outcome.COLLISION and IMPACT_EXCESS.name in self.metrics:
            impact = impact_in_words(
                self.metrics[IMPACT_SPEED.name], self.metrics[IMPACT_EXCESS.name]
            )
            return f"has an {impact}"
        if self.outcome is Outcome.COLLISION:
            return collision_in_words(
                -safety_degree, self.collision_speed, self._digits
            )
        distance = distance_in_words(
            safety_degree, self.runs.middles_apart, self._digits
        )
        ending = OUTCOME_VERBS[self.outcome]
        if np.isnan(safety_degree):
            return ending
        return f"{ending}, with a safety degree (smallest distance) of {distance}"

    @property
    def _digits(self) -> int:
        """Decimals of a safety degree: 2, or as many as it takes until the two vehicles of the pair
        differ.
        """
        difference = np.ptp(self.pair.evaluations.column(SAFETY_DEGREE))
        if difference > 0:
            return max(2, math.ceil(-math.log10(difference)))
        return 2

    def to_dict(self) -> JsonObject:
        """Study, setting (`vcs`: vehicle characteristics), outcome and all numbers, as plain
        values.
        """
        return {"study": self.study.name, "vcs": self.setting, **self.numbers}

    def _repr_html_(self) -> str:
        """A table of the original and the simulated vehicle, for notebooks."""
        import pandas as pd

        rows = [
            {**vehicle.setting, **vehicle.metrics, **vehicle.objectives}
            for vehicle in (self.original, self)
        ]
        table = pd.DataFrame(rows, ["original", "simulated"]).T
        return f"<p>{escape(repr(self))}</p>\n{table.to_html()}"

    def __repr__(self) -> str:
        metrics = ", ".join(
            f"{name}={significant(value, 4)}" for name, value in self.metrics.items()
        )
        return f"<Simulation of {self.study.name}: {self.outcome}, {metrics}>"


@checked
def simulate(
    study: StudyLike,
    changes: Mapping[str, float] | None = None,
    *,
    filtered: bool = False,
    beyond: bool = False,
) -> Simulation:
    """Simulate one setting in this process, and the original vehicle for comparison.

    Parameters
    ----------
    study
        A study, or anything that `load_study` accepts.
    changes
        Values by characteristic, in their table units; all other characteristics keep the
        original's value.
    filtered
        Put changes that do not exceed their thresholds back to the original first, as every search
        does.
    beyond
        Also accept values outside the domains, and settings that violate the study's constraints.

    Raises
    ------
    InputError
        If the study or a change cannot be used.
    UserCodeError
        If user code fails.
    SimulationError
        If SUMO fails.
    """
    if changes is None:
        changes = {}
    loaded_study, system = load_and_assemble(study)
    with about("changes"):
        loaded_study, system = with_set_axes(loaded_study, system, changes.keys())
        setting = system.characteristics.setting(changes, beyond=beyond)
        if not beyond:
            simulated = system.characteristics.filter(setting) if filtered else setting
            system.region.check(
                simulated[np.newaxis], otherwise=", or any with beyond=True"
            )
    return simulate_with_original(
        loaded_study, where_met(system, setting), setting, filtered=filtered
    )


@checked
def load_study(study: StudyLike, **changes: Any) -> Study:
    """Read a study strictly, and check the parameters of its shipped models.

    Parameters
    ----------
    study
        The study's name, the path of its file, its tables as in a file, or a study to change.
    changes
        Keys that override keys of the study, table by table, as in a file that extends the study:
        `weather="fog"`, `search={"runs": 2}`.

    Raises
    ------
    InputError
        If the study cannot be used; the error names file, key, value and expected values.
    """
    loaded_study = read_study(study, **changes)
    create_shipped_models(loaded_study)
    return loaded_study


def simulate_with_original(
    study: Study, system: System, requested: FloatArray, *, filtered: bool
) -> Simulation:
    """Simulate a setting, shape (n,), beside the original vehicle. In a matrix, both vehicles drive
    at the setting's worst point. If `filtered`, the filter first resets small changes.
    """
    characteristics = system.characteristics
    filtered_setting = characteristics.filter(requested)

    setting = filtered_setting if filtered else requested
    original = characteristics.with_original_vehicle(setting)
    is_original = np.array_equal(original, setting)
    settings = np.stack([original] if is_original else [original, setting])
    point = worst_point(system, setting)
    point_system = system.at(point)
    observations = []
    runs = drive_all(
        replace(point_system, in_sumo=True),
        settings,
        lambda values: observations.append(
            Observation._make(np.copy(value) for value in values)
        ),
    )
    pair = Pair(
        point, point_system, runs, score(point_system, settings, runs), observations
    )

    values = zip(
        characteristics.names,
        requested.tolist(),
        filtered_setting.tolist(),
        strict=True,
    )
    return Simulation(
        study=study,
        pair=pair,
        row=len(pair.evaluations) - 1,
        no_verdict=why_no_verdict(system),
        reset_values={name: value for name, value, result in values if value != result},
    )


def load_and_assemble(study: StudyLike) -> tuple[Study, System]:
    """Load a study and assemble its system."""
    loaded_study = read_study(study)
    return loaded_study, assemble(loaded_study)
