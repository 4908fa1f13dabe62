"""The input of a report: results, replays and stored answers of a study; and the table of the points at which a setting fails."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
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
from safevar_sumo.analysis.rules import RulesOptions
from safevar_sumo.analysis.subject import changes_since
from safevar_sumo.analysis.tolerance import ToleranceOptions
from safevar_sumo.errors import InputError, SafevarError, warn
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.replay.comparison import Comparison, changes_in_words, compare_setting
from safevar_sumo.replay.page import player_data
from safevar_sumo.replay.scene import flat_scene_of
from safevar_sumo.results import ANSWERS, MANIFEST, RESULTS, SOLUTIONS, chosen_handle, handles, read_manifest, write_whole
from safevar_sumo.scenarios import Point
from safevar_sumo.shipped import PACKAGE
from safevar_sumo.study import SAFETY_DEGREE, foreign_names, refuse_other_than_file
from safevar_sumo.sumo.matrix import aggregated, at_every_point, evaluate, study_at
from safevar_sumo.sumo.system import System, assemble


class FailingPoints(NamedTuple):
    """A table of the failing points: a sentence, the heads of the columns, and rows with a name and a cell for each head."""

    summary: str
    heads: list[str]
    rows: list[tuple[str, list[str]]]


class ChangeRow(NamedTuple):
    """A change from the original: both values in a text, and the short and the long description of the characteristic, or empty texts."""

    text: str
    short: str
    words: str


SPEED, LOCATION = "speed", "impact_location"
AVOIDED, FAILS = "–", "fails"  # noqa: RUF001


def failing_table(matrix: Sequence[Point], failing: Collection[str]) -> FailingPoints:
    """Make a table of the failing points: a row for each test and weather, a column for each speed, impact locations in the cells.

    Parameters
    ----------
    matrix
        All points of the matrix.
    failing
        Names of the failing points.

    Returns
    -------
    FailingPoints
        Cells without a test are empty.
    """
    points = [(point.name in failing, dict(point.place)) for point in matrix]
    speeds = sorted({coordinates[SPEED] for _, coordinates in points if SPEED in coordinates})
    rows: dict[str, dict[Any, list[str]]] = {}
    for fails, coordinates in points:
        speed, location = coordinates.pop(SPEED, None), coordinates.pop(LOCATION, None)
        test, weather = str(coordinates.pop("test", "")), str(coordinates.pop("weather", ""))
        name = ", ".join([test, weather, *(f"{key} {value}" for key, value in coordinates.items())])
        cell = rows.setdefault(name, {}).setdefault(speed, [])
        if fails:
            cell.append(FAILS if location is None else f"{location:g} %")
    columns = [*speeds, *([None] if any(None in cells for cells in rows.values()) else [])]
    has_location = any(LOCATION in dict(point.place) for point in matrix if point.name in failing)
    return FailingPoints(
        summary=f"Fails at {len(failing)} of {len(matrix)} points.{' Percentages are impact locations.' if has_location else ''}",
        heads=["" if speed is None else f"{speed:g} km/h" for speed in columns],
        rows=[(name, [", ".join(cells[speed]) or AVOIDED if speed in cells else "" for speed in columns])
              for name, cells in rows.items() if any(cells.values())])


SAMPLES = 4000
"""Number of samples in the sections on risk and rules."""


class Resimulation(NamedTuple):
    """A new simulation of a recorded setting: its evaluation, and the points of the matrix at which the setting is unsafe."""

    evaluation: Evaluations
    points: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class ReportInput:
    """One study of a report.

    `directory` holds the results, `number` counts studies from 1. `system` is None if the study cannot be simulated here; `problem`
    says why. `point` names the only point of the matrix that the page is about; it is empty for the whole study. `changed` lists the
    files and versions that have changed since the results were computed.
    """

    number: int
    directory: Path
    case: Case
    manifest: Mapping[str, Any]
    system: System | None
    problem: str = ""
    point: str = ""
    changed: Sequence[str] = ()
    _compared: dict[bytes, Comparison] = field(default_factory=dict)
    _simulated_again: dict[bytes, Resimulation] = field(default_factory=dict)

    @cached_property
    def solutions(self) -> dict[str, dict[str, Any]]:
        """Rows of the solutions by handle; each row also holds its handle."""
        pairs = zip(handles(self.case.solutions), self.case.solutions.to_dict("records"), strict=True)
        return {str(handle): {**{str(name): value for name, value in row.items()}, "handle": str(handle)} for handle, row in pairs}

    @cached_property
    def unsafe_solutions(self) -> list[bool]:
        """Whether each solution is unsafe."""
        return [] if self.case.solutions.empty else list(self.case.unsafe.rows(self.case.solutions).tolist())

    def chosen(self, choice: str) -> str:
        """The handle of the solution that a choice selects: fewest, smallest or most_severe."""
        return str(chosen_handle(self.case.solutions, self.case.unsafe, choice, self.directory))

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

    def changes(self, setting: FloatArray) -> list[ChangeRow]:
        """A setting's changes from the original."""
        members = [member for member, value in zip(self.case.characteristics, setting.tolist(), strict=True) if value != member.original]
        texts = changes_in_words(self.case.characteristics, setting)
        return [ChangeRow(text, member.short_name, member.words) for member, text in zip(members, texts, strict=True)]

    def compared(self, setting: FloatArray) -> Comparison:
        """Compare a setting with the original vehicle; simulates each setting once."""
        assert self.system is not None
        key = setting.tobytes()
        if key not in self._compared:
            self._compared[key] = compare_setting(self.case.study, self.system, setting)
        return self._compared[key]

    def simulate_again(self, settings: Sequence[FloatArray]) -> list[Resimulation]:
        """Simulate recorded settings again, each once and all in one batch; the page warns where results differ."""
        assert self.system is not None
        batch = {setting.tobytes(): setting for setting in settings if setting.tobytes() not in self._simulated_again}
        if batch:
            at_points = at_every_point(self.system, np.stack(list(batch.values())))
            evaluations, points = aggregated(at_points), unsafe_points_of(self.system, at_points, self.case.unsafe)
            for row, key in enumerate(batch):
                self._simulated_again[key] = Resimulation(evaluations.take([row]), points[row])
        return [self._simulated_again[setting.tobytes()] for setting in settings]

    @cached_property
    def options(self) -> dict[str, Any]:
        """Options of every question for the page: smaller samples than the commands' defaults, and one criterion for all questions."""
        unsafe = None if self.case.solutions.empty else str(self.case.unsafe)
        all_options: tuple[Options, ...] = (
            ExplainOptions(unsafe=unsafe, limit=12_000), OpinionOptions(unsafe=unsafe), ToleranceOptions(unsafe=unsafe),
            RiskOptions(unsafe=unsafe, samples=SAMPLES), RulesOptions(unsafe=unsafe, samples=SAMPLES))
        return {options.question: options for options in all_options}

    @property
    def original_fails(self) -> bool:
        """Whether the original vehicle itself collides; if so, no change is a cause."""
        return self.case.original[SAFETY_DEGREE] < 0

    def failing_points(self, setting: FloatArray) -> FailingPoints | None:
        """The points of the matrix at which a setting fails; None without a matrix, or if the page is about one point."""
        if self.system is None or not self.system.matrix or self.point:
            return None
        return failing_table(self.system.matrix, self.simulate_again([setting])[0].points)

    def replay(self, setting: FloatArray) -> dict[str, Any]:
        """A setting's animation, in the form that the template `player` takes."""
        return player_data(flat_scene_of(self.compared(setting)))

    def anchor(self, *parts: object) -> str:
        """The HTML anchor of a part of this study's section."""
        words = "-".join(str(part) for part in ("study", self.number, *parts))
        return "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in words)


def read_inputs(directories: Iterable[str | Path], point: str | None = None, *, as_it_is_now: bool = False) -> list[ReportInput]:
    """Read results directories; with `point`, their solutions are simulated again at this point of the matrix.

    Raises
    ------
    InputError
        If a directory holds no results, is damaged or is given twice, a study has no such point, or files or versions have changed
        since the results were computed and `as_it_is_now` is false.
    """
    paths = [Path(directory) for directory in directories]
    inputs = []
    for number, (path, case) in enumerate(zip(paths, load_cases(paths), strict=True), 1):
        system, problem, changed = None, "", list[str]()
        try:
            system = assemble(case.study, str(path))
        except InputError as error:
            problem = f"This study cannot be simulated here: {error.source}: {error.problem}."
            warn(f"{path}: {problem}")
        else:
            changed = changes_since(path, case, as_it_is_now=as_it_is_now)
        if point is not None:
            case = _at_point(case, point)
            system = assemble(case.study, str(path))
        inputs.append(ReportInput(number=number, directory=path, case=case, manifest=read_manifest(path), system=system, problem=problem,
                              point=point or "", changed=changed))
    return inputs


def _at_point(case: Case, point: str) -> Case:
    """The case with its solutions and original vehicle simulated again at one point of the study's matrix."""
    study = study_at(case.study, point, "--point")
    system = assemble(study)
    settings = np.concatenate([case.characteristics.original[np.newaxis], case.solutions[list(case.characteristics.names)].to_numpy(float)])
    evaluations = evaluate(system, settings)
    columns = {"f_safe": evaluations.f_safe, **evaluations.metrics, "outcome": evaluations.outcome}
    scoring = system.measuring.scoring
    solutions = case.solutions.drop(columns=[metric.name for metric in case.scoring.metrics if metric.name not in evaluations.metrics])
    original = {metric.name: float(evaluations.metrics[metric.name][0]) for metric in scoring.metrics}
    return replace(case, study=study, scoring=scoring, original=original,
                   solutions=solutions.assign(**{name: values[1:] for name, values in columns.items()}))


def stored_answer(data: ReportInput, name: str, compute: Callable[[], Any]) -> Any:
    """The result of `compute` as plain values; read from the results directory if it was computed before.

    The result is not stored if the directory cannot be written, or if the code that computes the result has no identity.
    """
    if data.changed or ("imported" in data.manifest and foreign_names(data.case.study)):
        return json.loads(json.dumps(compute(), allow_nan=False))
    suffix = f"-{data.anchor(data.point)}" if data.point else ""
    file, identity = data.directory / ANSWERS / f"{name}{suffix}.json", _digest(data, name)
    try:
        refuse_other_than_file(file)
        content = json.loads(file.read_text(encoding="utf-8"))
        if content["identity"] == identity:
            return content["value"]
    except (OSError, ValueError, KeyError, TypeError):
        pass  # never computed, or computed by another version of the package: compute it now
    text = json.dumps({"identity": identity, "value": compute()}, indent=1, allow_nan=False) + "\n"
    try:
        file.parent.mkdir(exist_ok=True)
        write_whole(file, text)
    except (OSError, SafevarError):
        pass  # results on a read-only disk get a report, too
    return json.loads(text)["value"]


def _digest(data: ReportInput, name: str) -> str:
    """Digest of everything that an answer depends on: the results, the options, the package's code."""
    digest = sha256(_package().encode())
    for file_name in (MANIFEST, SOLUTIONS):
        file = data.directory / file_name
        content = file.read_bytes() if file.is_file() else b""
        digest.update(len(content).to_bytes(8, "big") + content)
    parts = [data.case.finished_runs, data.point, data.options.get(name, data.case.study.spread)]
    digest.update(repr(parts).encode())
    return digest.hexdigest()


@cache
def _package() -> str:
    """Identity of the whole package's code, since answers depend on more code than results do."""
    files = sorted(PACKAGE.rglob("*.py"))
    return repr([version("safevar_sumo"), RESULTS, [(file.relative_to(PACKAGE).as_posix(), sha256(file.read_bytes()).hexdigest())
                                                    for file in files]])
