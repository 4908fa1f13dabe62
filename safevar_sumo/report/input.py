"""The input of a report: one study's results, replays and stored answers; and the table of the points at which a setting fails."""

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
from safevar_sumo.analysis.explain.compute import points_of
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
from safevar_sumo.replay.scene import scene_of
from safevar_sumo.results import RESULTS, SolutionId, handles, write_whole
from safevar_sumo.results.manifest import MANIFEST, read_manifest
from safevar_sumo.results.store import SOLUTIONS
from safevar_sumo.scenarios import Point
from safevar_sumo.shipped import PACKAGE
from safevar_sumo.study import SAFETY_DEGREE, foreign_names, refuse_other_than_file
from safevar_sumo.sumo.matrix import aggregated, at_every_point, evaluate, study_at
from safevar_sumo.sumo.system import System, assemble

SPEED, LOCATION = "speed", "impact_location"
AVOIDED, FAILS = "–", "fails"  # noqa: RUF001


def failing_places(matrix: Sequence[Point], failing: Collection[str]) -> dict[str, Any]:
    """A table of the tests that fail: tests and weathers down, speeds across, impact locations in the cells.

    Parameters
    ----------
    matrix
        All points.
    failing
        Names of those that fail.

    Returns
    -------
    A sentence `summary`, column `heads`, and `rows` of a name and a cell for each head; a cell is empty where nothing is tested.
    """
    places = [(point.name in failing, dict(point.place)) for point in matrix]
    speeds = sorted({place[SPEED] for _, place in places if SPEED in place})
    rows: dict[str, dict[Any, list[str]]] = {}
    for fails, place in places:
        speed, location = place.pop(SPEED, None), place.pop(LOCATION, None)
        name = ", ".join([str(place.pop("test", "")), str(place.pop("weather", "")), *(f"{key} {value}" for key, value in place.items())])
        cell = rows.setdefault(name, {}).setdefault(speed, [])
        if fails:
            cell.append(FAILS if location is None else f"{location:g} %")
    columns = [*speeds, *([None] if any(None in cells for cells in rows.values()) else [])]
    has_location = any(LOCATION in dict(point.place) for point in matrix if point.name in failing)
    return {
        "summary": f"Fails at {len(failing)} of {len(matrix)} points.{' Percentages are impact locations.' if has_location else ''}",
        "heads": ["" if speed is None else f"{speed:g} km/h" for speed in columns],
        "rows": [(name, [", ".join(cells[speed]) or AVOIDED if speed in cells else "" for speed in columns])
                 for name, cells in rows.items() if any(cells.values())]}


SAMPLES = 4000
"""Samples of the report's risk and rules."""


class Again(NamedTuple):
    """A setting simulated once more: its evaluation now, and the points of a matrix at which it is unsafe."""

    evaluation: Evaluations
    points: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class ReportInput:
    """One study of a report.

    `place` is its results directory as it was given, `number` its place among the studies, from 1. `system` is None where the study
    cannot be simulated here, and `lacking` says why. `point` is the point of the matrix that the whole case then belongs to; empty for
    the whole study. `changed` lists the differences between what is simulated for the page and what the results were computed with.
    """

    number: int
    place: Path
    case: Case
    manifest: Mapping[str, Any]
    system: System | None
    lacking: str = ""
    point: str = ""
    changed: Sequence[str] = ()
    _compared: dict[bytes, Comparison] = field(default_factory=dict)
    _again: dict[bytes, Again] = field(default_factory=dict)

    @cached_property
    def solutions(self) -> dict[str, dict[str, Any]]:
        """Every solution's row by its handle, which it holds too."""
        named = zip(handles(self.case.solutions), self.case.solutions.to_dict("records"), strict=True)
        return {str(handle): {**{str(name): value for name, value in row.items()}, "handle": str(handle)} for handle, row in named}

    def setting_of(self, handle: SolutionId) -> FloatArray:
        """A solution's setting, shape (n,)."""
        row = self.solutions[str(handle)]
        return np.array([row[name] for name in self.case.characteristics.names], dtype=float)

    def setting_with(self, changes: Mapping[str, float]) -> FloatArray:
        """The original setting with some values in place of its own, shape (n,)."""
        setting = self.case.characteristics.original.copy()
        for name, value in changes.items():
            setting[self.case.characteristics.names.index(name)] = value
        return setting

    def changes(self, setting: FloatArray) -> list[dict[str, str]]:
        """What differs from the original: a text with both values, and what the characteristic is, where the study says so."""
        members = [member for member, value in zip(self.case.characteristics, setting.tolist(), strict=True) if value != member.original]
        texts = changes_in_words(self.case.characteristics, setting)
        return [{"text": text, "short": member.short_name, "words": member.words} for member, text in zip(members, texts, strict=True)]

    def compared(self, setting: FloatArray) -> Comparison:
        """A setting simulated beside the original vehicle, once."""
        assert self.system is not None
        key = setting.tobytes()
        if key not in self._compared:
            self._compared[key] = compare_setting(self.case.study, self.system, setting)
        return self._compared[key]

    def again(self, settings: Sequence[FloatArray]) -> list[Again]:
        """Settings simulated once more, all in one go, each once; nothing is to come out otherwise than it is recorded."""
        assert self.system is not None
        new = {setting.tobytes(): setting for setting in settings if setting.tobytes() not in self._again}
        if new:
            at_points = at_every_point(self.system, np.stack(list(new.values())))
            evaluations, points = aggregated(at_points), points_of(self.system, at_points, self.case.unsafe)
            for row, key in enumerate(new):
                self._again[key] = Again(evaluations.take([row]), points[row])
        return [self._again[setting.tobytes()] for setting in settings]

    @cached_property
    def options(self) -> dict[str, Any]:
        """With which options each question is asked for the page: smaller samples than the commands' own, one criterion for all."""
        unsafe = None if self.case.solutions.empty else str(self.case.unsafe)
        asked: tuple[Options, ...] = (
            ExplainOptions(unsafe=unsafe, limit=12_000), OpinionOptions(unsafe=unsafe), ToleranceOptions(unsafe=unsafe),
            RiskOptions(unsafe=unsafe, samples=SAMPLES), RulesOptions(unsafe=unsafe, samples=SAMPLES))
        return {one.question: one for one in asked}

    @property
    def original_fails(self) -> bool:
        """Whether the original vehicle itself collides: then no change causes anything."""
        return self.case.original[SAFETY_DEGREE] < 0

    def where(self, setting: FloatArray) -> dict[str, Any] | None:
        """At which points of a matrix a setting fails; None of a study without one, and where one point is asked about."""
        if self.system is None or not self.system.matrix or self.point:
            return None
        return failing_places(self.system.matrix, self.again([setting])[0].points)

    def replay(self, setting: FloatArray) -> dict[str, Any]:
        """A setting's animation, as the template `player` takes it."""
        return player_data(scene_of(self.compared(setting)))

    def anchor(self, *parts: object) -> str:
        """A name for a place in the page that belongs to this study."""
        words = "-".join(str(part) for part in ("study", self.number, *parts))
        return "".join(sign if sign.isascii() and sign.isalnum() else "-" for sign in words)


def gather(directories: Iterable[str | Path], point: str | None = None, *, as_it_is_now: bool = False) -> list[ReportInput]:
    """Read results directories, or what their solutions are at one point of a matrix, where they are simulated once more.

    Raises
    ------
    InputError
        If one is no results directory, is damaged or is given twice, a study has no such point, or something that the results were
        computed with has changed since and `as_it_is_now` does not allow that.
    """
    places = [Path(directory) for directory in directories]
    inputs = []
    for number, (place, case) in enumerate(zip(places, load_cases(places), strict=True), 1):
        system, lacking, changed = None, "", list[str]()
        try:
            system = assemble(case.study, str(place))
        except InputError as error:
            lacking = f"What this study is about cannot be simulated here: {error.source}: {error.problem}."
            warn(f"{place}: {lacking}")
        else:
            changed = changes_since(place, case, as_it_is_now=as_it_is_now)
        if point is not None:
            case = _at_point(case, point)
            system = assemble(case.study, str(place))
        inputs.append(ReportInput(number=number, place=place, case=case, manifest=read_manifest(place), system=system, lacking=lacking,
                              point=point or "", changed=changed))
    return inputs


def _at_point(case: Case, point: str) -> Case:
    """A case with its solutions and its original as they are at one point of the study's matrix."""
    study = study_at(case.study, point, "--point")
    system = assemble(study)
    settings = np.concatenate([case.characteristics.original[np.newaxis], case.solutions[list(case.characteristics.names)].to_numpy(float)])
    now = evaluate(system, settings)
    measured = {"f_safe": now.f_safe, **now.metrics, "outcome": now.outcome}
    scoring = system.measuring.scoring
    solutions = case.solutions.drop(columns=[one.name for one in case.scoring.metrics if one.name not in now.metrics])
    return replace(case, study=study, scoring=scoring, original={one.name: float(now.metrics[one.name][0]) for one in scoring.metrics},
                   solutions=solutions.assign(**{name: values[1:] for name, values in measured.items()}))


FOLDER = "answers"
"""Of a results directory."""


def stored(material: ReportInput, name: str, compute: Callable[[], Any]) -> Any:
    """The result of `compute` as plain values; read from the results directory if the same was computed before.

    Nothing is stored where the directory cannot be written, or the code that computes an answer has no identity.
    """
    if material.changed or ("imported" in material.manifest and foreign_names(material.case.study)):
        return json.loads(json.dumps(compute(), allow_nan=False))
    at = f"-{material.anchor(material.point)}" if material.point else ""
    file, identity = material.place / FOLDER / f"{name}{at}.json", _identity(material, name)
    try:
        refuse_other_than_file(file)
        kept = json.loads(file.read_text(encoding="utf-8"))
        if kept["identity"] == identity:
            return kept["value"]
    except (OSError, ValueError, KeyError, TypeError):
        pass  # never computed, or not by us: it is computed now
    text = json.dumps({"identity": identity, "value": compute()}, indent=1, allow_nan=False) + "\n"
    try:
        file.parent.mkdir(exist_ok=True)
        write_whole(file, text)
    except (OSError, SafevarError):
        pass  # a report from results on a read-only disk is a report all the same
    return json.loads(text)["value"]


def _identity(material: ReportInput, name: str) -> str:
    """Digest of all that an answer depends on: the results, the options, the package's code."""
    digest = sha256(_package().encode())
    for kept in (MANIFEST, SOLUTIONS):
        file = material.place / kept
        content = file.read_bytes() if file.is_file() else b""
        digest.update(len(content).to_bytes(8, "big") + content)
    parts = [material.case.finished, material.point, material.options.get(name, material.case.study.spread)]
    digest.update(repr(parts).encode())
    return digest.hexdigest()


@cache
def _package() -> str:
    """Identity of all of the package's code: an answer depends on more of it than results do."""
    files = sorted(PACKAGE.rglob("*.py"))
    return repr([version("safevar_sumo"), RESULTS, [(file.relative_to(PACKAGE).as_posix(), sha256(file.read_bytes()).hexdigest())
                                                    for file in files]])
