"""What happened in one simulation, step by step, and what the ADS saw of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from safevar_sumo.ads import Ads
from safevar_sumo.metrics import Scoring, time_to_collision
from safevar_sumo.records import STANDSTILL, TIME_DECIMALS, Command, Evaluations, FloatArray, Nominal, Observation, Outcome, SimulationRuns
from safevar_sumo.results import record
from safevar_sumo.study import SAFETY_DEGREE, Study, StudyLike, load_study
from safevar_sumo.sumo.batch import score
from safevar_sumo.sumo.engine import Engine
from safevar_sumo.sumo.matrix import simulate as drive
from safevar_sumo.sumo.system import System, assemble

if TYPE_CHECKING:
    import pandas as pd


SEEN = {"speed": "seen speed [m/s]", "gap": "seen gap [m]", "closing_speed": "seen closing speed [m/s]", "lateral": "seen lateral [m]",
        "lateral_speed": "seen lateral speed [m/s]"}


class RecordingAds:
    """An ADS whose observations of its only vehicle are kept."""

    def __init__(self, ads: Ads) -> None:
        self._ads = ads
        self.observations: list[Observation] = []

    def start(self, n: int, nominal: Nominal, step: float) -> Any:
        self.observations.clear()
        return self._ads.start(n, nominal, step)

    def drive(self, seen: Observation, memory: Any) -> tuple[Command, Any]:
        self.observations.append(Observation(*(np.copy(value) for value in seen)))  # type: ignore[arg-type]
        return self._ads.drive(seen, memory)


def trace_frame(drives: SimulationRuns, witness: RecordingAds) -> pd.DataFrame:
    """One row per step of the only vehicle while its simulation counts.

    Where the obstacle was (`gap` along the vehicle's path, `lateral` from the middle of its lane) and what the ADS saw of
    it; `ttc` is empty while nothing is closing, as a standing vehicle is not, a gap while there is no obstacle ahead.
    """
    import pandas as pd  # takes longer to load than the simulation

    trace = drives.trace
    shown = trace.active[:, 0]
    closing = np.where(trace.speed > STANDSTILL, time_to_collision(drives), np.inf)
    columns = {
        "time [s]": trace.time, "position [m]": trace.position[:, 0], "speed [m/s]": trace.speed[:, 0],
        "acceleration [m/s^2]": np.diff(trace.speed[:, 0], prepend=trace.speed[:1, 0]) / trace.step, "gap [m]": trace.gap[:, 0],
        "ttc [s]": closing[:, 0], "throttle [-]": trace.throttle[:, 0], "brake [-]": trace.brake[:, 0],
        "gear [-]": trace.gear[:, 0], "lateral [m]": trace.lateral[:, 0], "lateral speed [m/s]": trace.lateral_speed[:, 0]}
    frame = pd.DataFrame({name: values[shown] for name, values in columns.items()})
    seen = pd.DataFrame([{"time [s]": round(float(one.time), TIME_DECIMALS),
                          **{head: float(getattr(one, name)[0]) for name, head in SEEN.items()}} for one in witness.observations])
    return frame.merge(seen, how="left", on="time [s]").replace([np.inf, -np.inf], np.nan)


WORDS = {
    Outcome.STOPPED: "stops", Outcome.PASSED: "passes", Outcome.TIMEOUT: "is under way when the time is up",
    Outcome.NEVER_MOVED: "never moves", Outcome.INVALID_TEST: "leaves the tolerance of the test's speed before the system acts"}


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """One simulated setting.

    Attributes
    ----------
    study
        That it was simulated in.
    setting
        What was simulated: every characteristic in its table unit, after the filter.
    put_back
        What was asked for and is too small a change for the filter: the value asked for, by name.
    evaluation
        Its outcome, metrics and objectives as arrays of one row.
    drives
        The simulation as it went, of one vehicle.
    scoring
        What was measured, and what a search would minimise.
    original
        The original vehicle in the same study; of the original vehicle, itself.
    """

    study: Study
    setting: Mapping[str, float]
    put_back: Mapping[str, float]
    evaluation: Evaluations
    drives: SimulationRuns
    scoring: Scoring
    _seen: RecordingAds
    _original: Simulation | None = None

    @property
    def original(self) -> Simulation:
        return self._original or self

    @property
    def outcome(self) -> Outcome:
        """How it ended."""
        return Outcome(str(self.evaluation.outcome[0]))

    @property
    def collision_speed(self) -> float:
        """Speed at which it collided [m/s]; NaN without a collision."""
        return float(self.evaluation.collision_speed[0])

    @property
    def metrics(self) -> dict[str, float]:
        """Safety metrics by name, in the units that `list` tells; NaN where undefined."""
        return {name: float(values[0]) for name, values in self.evaluation.metrics.items()}

    @property
    def objectives(self) -> dict[str, float]:
        """f_safe [m, or -m/s on a collision], f_diff [fraction], f_num_diff [characteristics]; all are minimised."""
        told = self.record()
        return {name: float(told[name]) if told[name] is not None else np.nan for name in told if name.startswith("f_")}

    @property
    def units(self) -> dict[str, str]:
        """The unit of every number of `record`, by its name."""
        measured = {metric.name: metric.unit for metric in self.scoring.metrics}
        measured |= {one.name: one.unit for one in self.scoring.objectives if one.name in self.metrics}
        return {"collision_speed": "m/s", **measured, "f_safe": "m, or -m/s", "f_diff": "fraction", "f_num_diff": "characteristics"}

    @cached_property
    def trace(self) -> pd.DataFrame:
        """Step by step, one row each, units in the columns' names; empty (NaN) is what there is nothing to tell of."""
        return trace_frame(self.drives, self._seen)

    @property
    def verdict(self) -> str:
        """How it ended, in words."""
        if self.outcome is Outcome.COLLISION:
            return f"collides at {self.collision_speed:.2f} m/s"
        least = self.metrics[SAFETY_DEGREE]
        return WORDS[self.outcome] + ("" if np.isnan(least) else f", with a safety degree of {least:.2f} m")

    def record(self) -> dict[str, Any]:
        """As plain values, as `simulate --json` prints it; undefined is None."""
        return {"study": self.study.name, "vcs": dict(self.setting), **record(self.evaluation, 0)}

    def __repr__(self) -> str:
        told = ", ".join(f"{name}={value:.4g}" for name, value in self.metrics.items())
        return f"<Simulation of {self.study.name}: {self.outcome}, {told}>"


def simulate(study: StudyLike, changes: Mapping[str, float] | None = None, *, filtered: bool = True, beyond: bool = False,
             gui: bool = False) -> Simulation:
    """Simulate one setting in this process, and the original vehicle for comparison.

    Parameters
    ----------
    study
        A study, or what `load_study` makes one of.
    changes
        Values by characteristic, in their table units; all others are the original's.
    filtered
        Put changes that are smaller than their thresholds back to the original, as every search does.
    beyond
        Take values outside the domains too.
    gui
        Show the setting in sumo-gui.

    Raises
    ------
    InputError
        If the study or a change cannot be used.
    SimulationError
        If SUMO fails.
    """
    chosen, system = assembled(study)
    asked = system.characteristics.setting(changes or {}, "changes", beyond=beyond)
    return beside_the_original(chosen, system, asked, filtered=filtered, gui=gui)


def beside_the_original(chosen: Study, system: System, asked: FloatArray, *, filtered: bool = True, gui: bool = False) -> Simulation:
    """Simulate a setting that is asked for, shape (n,), and the original vehicle."""
    characteristics = system.characteristics
    setting = characteristics.filter(asked) if filtered else asked
    original = _simulated(chosen, system, characteristics.original, characteristics.original)
    if np.array_equal(setting, characteristics.original) and not gui:
        return replace(original, put_back=_put_back(system, asked, setting))
    return replace(_simulated(chosen, system, asked, setting, Engine.GUI if gui else Engine.LIBSUMO), _original=original)


def assembled(study: StudyLike, source: str = "") -> tuple[Study, System]:
    """A study, and what its simulations are made of; errors call it `source`, or as it was given."""
    chosen = load_study(study)
    return chosen, assemble(chosen, source or (str(study) if isinstance(study, str | Path) else ""))


def _simulated(study: Study, system: System, asked: FloatArray, setting: FloatArray, engine: Engine = Engine.LIBSUMO) -> Simulation:
    seen = RecordingAds(system.ads)
    rows = setting[np.newaxis]
    drives = drive(replace(system, ads=seen), rows, engine)
    return Simulation(
        study=study, setting=dict(zip(system.characteristics.names, setting.tolist(), strict=True)),
        put_back=_put_back(system, asked, setting), evaluation=score(system, rows, drives), drives=drives,
        scoring=system.measuring.scoring, _seen=seen)


def _put_back(system: System, asked: FloatArray, setting: FloatArray) -> dict[str, float]:
    return {name: float(value) for name, value, used in zip(system.characteristics.names, asked, setting, strict=True) if value != used}
