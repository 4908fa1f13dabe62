"""The input of a report: results, simulations of their settings, and the table of the points at which a setting
fails.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.explain.compute import unsafe_points_of
from safevar_sumo.analysis.opinion import OpinionOptions
from safevar_sumo.analysis.options import Options
from safevar_sumo.analysis.research_questions.case import Case, load_cases
from safevar_sumo.analysis.risk import RiskOptions
from safevar_sumo.analysis.risk.variation import BASE_POINTS
from safevar_sumo.analysis.rules import RulesOptions
from safevar_sumo.analysis.subject import at_point, changes_since
from safevar_sumo.analysis.tolerance import ToleranceOptions
from safevar_sumo.errors import InputError, warn
from safevar_sumo.records import FloatArray
from safevar_sumo.replay.comparison import Comparison, changes_in_words, compare_setting
from safevar_sumo.replay.page import player_data
from safevar_sumo.replay.scene import lay_out_scene
from safevar_sumo.results import choose_handle, handles_of, read_manifest
from safevar_sumo.scenarios import LOCATION_DIMENSION, SPEED_DIMENSION, Point
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import System, assemble

SAMPLED_VEHICLES = 4000
"""Number of vehicles sampled for the section on risk, and for the one on rules."""
EXPLAIN_SIMULATIONS = 30_000
"""Approximate number of simulations for the minimal causes of all failures, and for the search for a robust failure."""
AVOIDED_TEXT, FAILURE_TEXT = "–", "fails"  # noqa: RUF001


class FailingPoints(NamedTuple):
    """The failing points of a matrix: a sentence, and a frame of tests and weathers by speeds."""

    summary: str
    frame: pd.DataFrame


def tabulate_failing_points(matrix: Sequence[Point], failing: Collection[str]) -> FailingPoints:
    """Tabulate the points whose names are in `failing`: a cell lists impact locations; one without a test is empty."""
    rows: dict[str, dict[float | None, list[str]]] = {}
    has_location = False
    for point in matrix:
        coordinates = dict(point.parameters)
        speed, location = coordinates.pop(SPEED_DIMENSION, None), coordinates.pop(LOCATION_DIMENSION, None)
        test, weather = str(coordinates.pop("test", "")), str(coordinates.pop("weather", ""))
        name = ", ".join([test, weather, *(f"{key} {value}" for key, value in coordinates.items())])
        texts = rows.setdefault(name, {}).setdefault(speed, [])
        if point.name in failing:
            texts.append(FAILURE_TEXT if location is None else f"{location:g} %")
            has_location = has_location or location is not None
    speeds = sorted(
        {speed for cells in rows.values() for speed in cells}, key=lambda speed: (speed is None, speed or 0.0)
    )
    frame = pd.DataFrame(
        [
            [", ".join(cells[speed]) or AVOIDED_TEXT if speed in cells else "" for speed in speeds]
            for cells in rows.values()
        ],
        index=pd.Index(rows, name="test"),
        columns=["" if speed is None else f"{speed:g} km/h" for speed in speeds],
    )
    note = " Percentages are impact locations." if has_location else ""
    return FailingPoints(
        f"Fails at {len(failing)} of {len(matrix)} points.{note}",
        frame[[any(cells.values()) for cells in rows.values()]],
    )


@dataclass(frozen=True, kw_only=True)
class ReportInput:
    """One study of a report.

    `study_number` counts from 1, `directory` holds the results. `system` is None if the study cannot be simulated here;
    `problem` says why. `point` names the only point of the matrix that the page is about; it is empty for the whole
    study. `later_changes` names the files and versions that have changed since the results were computed.
    """

    study_number: int
    directory: Path
    case: Case
    manifest: Mapping[str, Any]
    system: System | None
    problem: str = ""
    point: str = ""
    later_changes: Sequence[str] = ()
    _comparisons: dict[bytes, Comparison] = field(default_factory=dict)
    _failing: dict[bytes, FailingPoints] = field(default_factory=dict)

    @cached_property
    def solutions(self) -> dict[str, dict[str, Any]]:
        """Rows of the solutions by handle; each row also holds its handle."""
        pairs = zip(handles_of(self.case.solutions), self.case.solutions.to_dict("records"), strict=True)
        return {
            str(handle): {**{str(name): value for name, value in row.items()}, "handle": str(handle)}
            for handle, row in pairs
        }

    @property
    def any_unsafe(self) -> bool:
        return bool(len(self.case.solutions)) and bool(self.case.unsafe.rows(self.case.solutions).any())

    def select_handles(self, *choices: str) -> list[str]:
        """The distinct handles of the solutions that choices select: the most severe one alone if none is unsafe."""
        if self.case.solutions.empty:
            return []
        possible = choices if self.any_unsafe else ("most_severe",)
        return list(
            dict.fromkeys(
                str(choose_handle(self.case.solutions, self.case.unsafe, choice, self.directory)) for choice in possible
            )
        )

    def setting_of(self, handle: str) -> FloatArray:
        """A solution's setting, shape (n,)."""
        return np.array([self.solutions[handle][name] for name in self.case.characteristics.names], dtype=float)

    def list_changes(self, setting: FloatArray) -> list[tuple[str, str, str]]:
        """A setting's changes from the original: both values in a text, the characteristic's short name and its
        description.
        """
        changed = [
            item
            for item, value in zip(self.case.characteristics, setting.tolist(), strict=True)
            if value != item.original
        ]
        texts = changes_in_words(self.case.characteristics, setting)
        return [(text, item.short_name, item.words) for item, text in zip(changed, texts, strict=True)]

    def compare_with_original(self, setting: FloatArray) -> Comparison:
        """Simulate a setting, once, beside the original vehicle; of a matrix, at the setting's worst point."""
        assert self.system is not None
        key = setting.tobytes()
        if key not in self._comparisons:
            self._comparisons[key] = compare_setting(self.case.study, self.system, setting)
        return self._comparisons[key]

    def player_data_of(self, setting: FloatArray) -> dict[str, Any]:
        """A setting's animation, in the form that the template `player` takes, with the point of the matrix that it
        shows.
        """
        comparison = self.compare_with_original(setting)
        return {**player_data(lay_out_scene(comparison)), "point": comparison.point}

    def failing_points(self, setting: FloatArray) -> FailingPoints | None:
        """The points of the matrix at which a setting fails; None without a matrix, or if the page is about one
        point.
        """
        if self.system is None or not self.system.matrix or self.point:
            return None
        key = setting.tobytes()
        if key not in self._failing:
            (points,) = unsafe_points_of(
                self.system, simulate_all_points(self.system, setting[np.newaxis]), self.case.unsafe
            )
            self._failing[key] = tabulate_failing_points(self.system.matrix, points)
        return self._failing[key]

    @cached_property
    def no_verdict(self) -> str:
        """Why simulations tell nothing about the ADS, in a sentence; "" if they do, or if the study cannot be
        simulated.
        """
        return "" if self.system is None else why_no_verdict(self.system)

    @property
    def simulation_counts(self) -> dict[str, int]:
        """About how many simulations each section takes, at most."""
        n = len(self.case.characteristics)
        return {
            "causes": EXPLAIN_SIMULATIONS,
            "tolerance": 200 * n + 6000,
            "risk": SAMPLED_VEHICLES + (n + 2) * BASE_POINTS,
            "rules": SAMPLED_VEHICLES,
        }

    @cached_property
    def options(self) -> dict[str, Any]:
        """Each question's options on the page: smaller samples than the commands take."""
        all_options: tuple[Options, ...] = (
            ExplainOptions(limit=EXPLAIN_SIMULATIONS),
            OpinionOptions(),
            ToleranceOptions(),
            RiskOptions(samples=SAMPLED_VEHICLES),
            RulesOptions(samples=SAMPLED_VEHICLES),
        )
        return {options.question: options for options in all_options}

    def anchor(self, *parts: object) -> str:
        """The HTML anchor of an element of the page, in this study's section."""
        text = "-".join(str(part) for part in ("study", self.study_number, *parts))
        return "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in text)


def read_inputs(
    directories: Iterable[str | Path], point: str | None = None, *, as_it_is_now: bool = False
) -> list[ReportInput]:
    """Read results directories; with `point`, simulate their solutions again at this point of the matrix.

    Raises
    ------
    InputError
        If a directory holds no results, is damaged or is given twice, a study has no such point, or files or versions
        have changed since the results were computed and `as_it_is_now` is false.
    """
    paths = [Path(directory) for directory in directories]
    inputs = []
    for study_number, (path, case) in enumerate(zip(paths, load_cases(paths), strict=True), 1):
        system, problem, later_changes = None, "", list[str]()
        try:
            system = assemble(case.study, str(path))
        except InputError as error:
            problem = f"This study cannot be simulated here: {error.source}: {error.problem}."
            warn(f"{path}: {problem}")
        else:
            later_changes = changes_since(path, case, as_it_is_now=as_it_is_now)
        if point is not None:
            case = at_point(case, point)
            system = assemble(case.study, str(path))
        inputs.append(
            ReportInput(
                study_number=study_number,
                directory=path,
                case=case,
                manifest=read_manifest(path),
                system=system,
                problem=problem,
                point=point or "",
                later_changes=later_changes,
            )
        )
    return inputs
