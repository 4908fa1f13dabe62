"""The input of a report: results, replays and stored answers of a study; the table of the points at which a setting fails."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

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
from safevar_sumo.errors import InputError, SafevarError, warn
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.replay.comparison import Comparison, changes_in_words, compare_setting
from safevar_sumo.replay.page import player_data
from safevar_sumo.replay.scene import lay_out_scene
from safevar_sumo.results import ANSWERS, MANIFEST, RESULTS, SOLUTIONS, choose_handle, handles_of, read_manifest, write_whole
from safevar_sumo.scenarios import LOCATION_DIMENSION, SPEED_DIMENSION, Point
from safevar_sumo.shipped import PACKAGE
from safevar_sumo.study import SAFETY_DEGREE, refuse_other_than_file, user_code_names
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.matrix import evaluations_at_worst_points, simulate_all_points
from safevar_sumo.sumo.system import System, assemble


class FailingPointsTable(NamedTuple):
    """The failing points of a matrix: a sentence, the heads of the columns, and rows with a name and a text for each column."""

    summary: str
    heads: list[str]
    rows: list[tuple[str, list[str]]]


class ChangeRow(NamedTuple):
    """A change: both values in a text, and the characteristic's short name and description, empty if it has none."""

    text: str
    short_name: str
    description: str


AVOIDED_TEXT, FAILURE_TEXT = "–", "fails"  # noqa: RUF001


def tabulate_failing_points(matrix: Sequence[Point], failing: Collection[str]) -> FailingPointsTable:
    """Make a table of the points whose names are in `failing`: rows for tests and weathers, columns for speeds.

    A cell lists the impact locations that fail; a cell without a test is empty.
    """
    coordinates_of_points = [(point.name in failing, dict(point.parameters)) for point in matrix]
    speeds = sorted({coordinates[SPEED_DIMENSION] for _, coordinates in coordinates_of_points if SPEED_DIMENSION in coordinates})
    rows: dict[str, dict[Any, list[str]]] = {}
    for fails, coordinates in coordinates_of_points:
        speed, location = coordinates.pop(SPEED_DIMENSION, None), coordinates.pop(LOCATION_DIMENSION, None)
        test, weather = str(coordinates.pop("test", "")), str(coordinates.pop("weather", ""))
        name = ", ".join([test, weather, *(f"{key} {value}" for key, value in coordinates.items())])
        texts = rows.setdefault(name, {}).setdefault(speed, [])
        if fails:
            texts.append(FAILURE_TEXT if location is None else f"{location:g} %")
    speeds_or_none = [*speeds, *([None] if any(None in cells for cells in rows.values()) else [])]
    has_location = any(LOCATION_DIMENSION in dict(point.parameters) for point in matrix if point.name in failing)
    return FailingPointsTable(
        summary=f"Fails at {len(failing)} of {len(matrix)} points.{' Percentages are impact locations.' if has_location else ''}",
        heads=["" if speed is None else f"{speed:g} km/h" for speed in speeds_or_none],
        rows=[(name, [", ".join(cells[speed]) or AVOIDED_TEXT if speed in cells else "" for speed in speeds_or_none])
              for name, cells in rows.items() if any(cells.values())])


SAMPLED_VEHICLES = 4000
"""Number of vehicles sampled for the section on risk, and for the one on rules."""
EXPLAIN_SIMULATIONS = 30_000
"""Approximate number of simulations for the minimal causes of all failures, and for the search for a robust failure."""


class Resimulation(NamedTuple):
    """A new simulation of a recorded setting: its evaluation, and the points of the matrix at which the setting is unsafe."""

    evaluation: Evaluations
    unsafe_points: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class ReportInput:
    """One study of a report.

    `study_number` counts from 1, `directory` holds the results. `system` is None if the study cannot be simulated here; `problem`
    says why. `point` names the only point of the matrix that the page is about; it is empty for the whole study. `later_changes`
    names the files and versions that have changed since the results were computed.
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
    _resimulations: dict[bytes, Resimulation] = field(default_factory=dict)

    @cached_property
    def solutions(self) -> dict[str, dict[str, Any]]:
        """Rows of the solutions by handle; each row also holds its handle."""
        pairs = zip(handles_of(self.case.solutions), self.case.solutions.to_dict("records"), strict=True)
        return {str(handle): {**{str(name): value for name, value in row.items()}, "handle": str(handle)} for handle, row in pairs}

    @cached_property
    def unsafe_solutions(self) -> list[bool]:
        """Whether each solution is unsafe."""
        return [] if self.case.solutions.empty else list(self.case.unsafe.rows(self.case.solutions).tolist())

    def select_handle(self, choice: str) -> str:
        """The handle of the solution that a choice selects: fewest, smallest or most_severe."""
        return str(choose_handle(self.case.solutions, self.case.unsafe, choice, self.directory))

    def setting_of(self, handle: str) -> FloatArray:
        """A solution's setting, shape (n,)."""
        row = self.solutions[handle]
        return np.array([row[name] for name in self.case.characteristics.names], dtype=float)

    def setting_with(self, changes: Mapping[str, float]) -> FloatArray:
        """The original setting with some values changed, shape (n,)."""
        setting = self.case.characteristics.original.copy()
        for name, value in changes.items():
            setting[self.case.characteristics.names.index(name)] = value
        return setting

    def list_changes(self, setting: FloatArray) -> list[ChangeRow]:
        """A setting's changes from the original."""
        changed = [item for item, value in zip(self.case.characteristics, setting.tolist(), strict=True) if value != item.original]
        texts = changes_in_words(self.case.characteristics, setting)
        return [ChangeRow(text, item.short_name, item.words) for item, text in zip(changed, texts, strict=True)]

    def compare_with_original(self, setting: FloatArray) -> Comparison:
        """Simulate a setting, once, beside the original vehicle."""
        assert self.system is not None
        key = setting.tobytes()
        if key not in self._comparisons:
            self._comparisons[key] = compare_setting(self.case.study, self.system, setting)
        return self._comparisons[key]

    def simulate_again(self, settings: Sequence[FloatArray]) -> list[Resimulation]:
        """Simulate recorded settings again, in one batch and each only once; the page warns of results that differ."""
        assert self.system is not None
        batch = {setting.tobytes(): setting for setting in settings if setting.tobytes() not in self._resimulations}
        if batch:
            results_at_points = simulate_all_points(self.system, np.stack(list(batch.values())))
            evaluations = evaluations_at_worst_points(results_at_points)
            unsafe_points = unsafe_points_of(self.system, results_at_points, self.case.unsafe)
            for row, key in enumerate(batch):
                self._resimulations[key] = Resimulation(evaluations.take([row]), unsafe_points[row])
        return [self._resimulations[setting.tobytes()] for setting in settings]

    @cached_property
    def options(self) -> dict[str, Any]:
        """Each question's options on the page: one criterion for all questions, and smaller samples than the commands take."""
        unsafe = None if self.case.solutions.empty else str(self.case.unsafe)
        all_options: tuple[Options, ...] = (
            ExplainOptions(unsafe=unsafe, limit=EXPLAIN_SIMULATIONS), OpinionOptions(unsafe=unsafe), ToleranceOptions(unsafe=unsafe),
            RiskOptions(unsafe=unsafe, samples=SAMPLED_VEHICLES), RulesOptions(unsafe=unsafe, samples=SAMPLED_VEHICLES))
        return {options.question: options for options in all_options}

    @cached_property
    def no_verdict(self) -> str:
        """Why simulations tell nothing about the ADS, in a sentence; "" if they do, or if the study cannot be simulated."""
        return "" if self.system is None else why_no_verdict(self.system)

    @property
    def simulation_counts(self) -> dict[str, int]:
        """About how many simulations each section takes, at most."""
        n = len(self.case.characteristics)
        return {"causes": EXPLAIN_SIMULATIONS, "tolerance": 200 * n + 6000,
                "risk": SAMPLED_VEHICLES + (n + 2) * BASE_POINTS, "rules": SAMPLED_VEHICLES}

    @property
    def original_fails(self) -> bool:
        """Whether the original vehicle itself collides; if so, no change is a cause."""
        return self.case.original[SAFETY_DEGREE] < 0

    def failing_points(self, setting: FloatArray) -> FailingPointsTable | None:
        """The points of the matrix at which a setting fails; None without a matrix, or if the page is about one point."""
        if self.system is None or not self.system.matrix or self.point:
            return None
        return tabulate_failing_points(self.system.matrix, self.simulate_again([setting])[0].unsafe_points)

    def player_data_of(self, setting: FloatArray) -> dict[str, Any]:
        """A setting's animation, in the form that the template `player` takes."""
        return player_data(lay_out_scene(self.compare_with_original(setting)))

    def anchor(self, *parts: object) -> str:
        """The HTML anchor of an element of the page, in this study's section."""
        text = "-".join(str(part) for part in ("study", self.study_number, *parts))
        return "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in text)


def read_inputs(directories: Iterable[str | Path], point: str | None = None, *, as_it_is_now: bool = False) -> list[ReportInput]:
    """Read results directories; with `point`, simulate their solutions again at this point of the matrix.

    Raises
    ------
    InputError
        If a directory holds no results, is damaged or is given twice, a study has no such point, or files or versions have changed
        since the results were computed and `as_it_is_now` is false.
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
        inputs.append(ReportInput(study_number=study_number, directory=path, case=case, manifest=read_manifest(path), system=system,
                                  problem=problem, point=point or "", later_changes=later_changes))
    return inputs


def load_or_compute(data: ReportInput, name: str, compute: Callable[[], Any]) -> Any:
    """The result of `compute` as plain values: stored in the results directory, and read from there the next time.

    Nothing is stored if the directory cannot be written, or if inputs have changed since the study. Nothing is stored for imported results
    of a study with user code either, as they record no digest of this code.
    """
    if data.later_changes or ("imported" in data.manifest and user_code_names(data.case.study)):
        return json.loads(json.dumps(compute(), allow_nan=False))
    suffix = f"-{data.anchor(data.point)}" if data.point else ""
    file, identity = data.directory / ANSWERS / f"{name}{suffix}.json", _answer_digest(data, name)
    try:
        refuse_other_than_file(file)
        content = json.loads(file.read_text(encoding="utf-8"))
        if content["identity"] == identity:
            return content["value"]
    except (OSError, ValueError, KeyError, TypeError):
        pass  # not stored, or stored by another version of the package: compute it now
    text = json.dumps({"identity": identity, "value": compute()}, indent=1, allow_nan=False) + "\n"
    try:
        file.parent.mkdir(exist_ok=True)
        write_whole(file, text)
    except (OSError, SafevarError):
        pass  # results on a read-only disk get a report, too
    return json.loads(text)["value"]


def _answer_digest(data: ReportInput, name: str) -> str:
    """Digest of everything that an answer depends on: the results, the options, the package's code."""
    digest = sha256(_package_identity().encode())
    for file_name in (MANIFEST, SOLUTIONS):
        file = data.directory / file_name
        content = file.read_bytes() if file.is_file() else b""
        digest.update(len(content).to_bytes(8, "big") + content)
    inputs = [data.case.finished_runs, data.point, data.options.get(name, data.case.study.spread)]
    digest.update(repr(inputs).encode())
    return digest.hexdigest()


@cache
def _package_identity() -> str:
    """Identity of the code of the whole package: answers depend on more of it than results do."""
    files = sorted(PACKAGE.rglob("*.py"))
    return repr([version("safevar_sumo"), RESULTS, [(file.relative_to(PACKAGE).as_posix(), sha256(file.read_bytes()).hexdigest())
                                                    for file in files]])
