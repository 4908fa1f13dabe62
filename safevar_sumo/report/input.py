"""The input of a report: results, the options of the questions that it asks, and simulations of single settings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.questions.ask import find_question
from safevar_sumo.questions.case import Case, load_cases
from safevar_sumo.questions.subject import at_point, changes_since
from safevar_sumo.questions.words import change_texts
from safevar_sumo.records import FloatArray, JsonObject
from safevar_sumo.replay.animation import player_data
from safevar_sumo.replay.comparison import Comparison, compare_setting
from safevar_sumo.replay.figure import draw_comparison
from safevar_sumo.replay.scene import lay_out_scene
from safevar_sumo.results import choose_handle, handles_of, read_manifest
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.terminal import Progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure


SAMPLES: Mapping[str, JsonObject] = {"risk": {"samples": 4000}, "rules": {"samples": 4000}}
"""The number of vehicles sampled for these sections."""
EXPLAIN_SIMULATIONS = 30_000
"""Approximate number of simulations for the minimal causes of all failures, and for the search for a robust failure."""


@dataclass(frozen=True, kw_only=True)
class ReportInput:
    """One study of a report.

    `study_number` counts from 1, `directory` holds the results. `point` names the only point of the matrix that the
    page is about; it is empty for the whole study. `margin` is that of `tolerance` and `repair`. `versions` are of
    the packages that the results were computed with; `later_changes` names the files and versions that have changed
    since.
    """

    study_number: int
    directory: Path
    case: Case
    system: System
    versions: Mapping[str, str]
    margin: float | None = None
    point: str = ""
    later_changes: Sequence[str] = ()

    @property
    def is_rated(self) -> bool:
        """Whether the page is about the points of a rating."""
        return is_rated(self.case.study) and not self.point

    @cached_property
    def values(self) -> Mapping[str, JsonObject]:
        """The values of options that are not the commands' defaults; a rated study's variant is the solution with the
        fewest changes that loses a point.
        """
        solution = self.select_handles("fewest")[0] if self.is_rated and self.any_unsafe else None
        return {
            **SAMPLES,
            "compare": {},
            "explain": {"limit": EXPLAIN_SIMULATIONS},
            "opinion": {},
            "rating": {"solution": solution},
            "repair": {"margin": self.margin},
            "tolerance": {"margin": self.margin},
        }

    def ask(self, question: str, jobs: int | None, progress: Progress, *others: Case) -> Any:
        """The answer to a question of the page, `others` beside its study."""
        subjects, values = [self.case, *others], self.values[question]
        return find_question(question).answer(subjects, values, jobs=jobs, progress=progress)

    def command(self, question: str) -> str:
        """The command that prints this answer."""
        return find_question(question).command_line([str(self.directory)], self.point, self.values[question])

    @cached_property
    def solutions(self) -> dict[str, JsonObject]:
        """Rows of the solutions by handle; each row also holds its handle."""
        handles = map(str, handles_of(self.case.solutions))
        rows: list[dict[Any, Any]] = self.case.solutions.to_dict("records")
        return {handle: {**row, "handle": handle} for handle, row in zip(handles, rows, strict=True)}

    @property
    def any_unsafe(self) -> bool:
        return bool(self.case.unsafe.rows(self.case.solutions).any())

    def select_handles(self, *choices: str) -> list[str]:
        """The distinct handles of the solutions that choices select; if none is unsafe, of the most severe solution."""
        if self.case.solutions.empty:
            return []
        possible = choices if self.any_unsafe else ("most_severe",)
        handles = (choose_handle(self.case.solutions, self.case.unsafe, name, self.directory) for name in possible)
        return list(dict.fromkeys(map(str, handles)))

    def setting_of(self, handle: str) -> FloatArray:
        """A solution's setting, shape (n,)."""
        return np.array([self.solutions[handle][name] for name in self.case.characteristics.names], dtype=float)

    def list_changes(self, setting: FloatArray) -> list[tuple[str, str, str]]:
        """A setting's changes from the original: for each a text with both values, the characteristic's short name and
        its description.
        """
        characteristics = self.case.characteristics
        changed = [item for item, value in zip(characteristics, setting, strict=True) if value != item.original]
        texts = change_texts(characteristics, dict(zip(characteristics.names, setting.tolist(), strict=True)))
        return [(text, item.short_name, item.words) for item, text in zip(changed, texts, strict=True)]

    def play(self, setting: FloatArray) -> tuple[Comparison, JsonObject]:
        """Simulate a setting beside the original vehicle, in a matrix at its worst point.

        Returns the comparison, and the animation with the point, in the form that the template `player` takes.
        """
        comparison = compare_setting(self.case.study, self.system, setting)
        return comparison, {**player_data(lay_out_scene(comparison)), "point": comparison.point}

    def draw_failure(self, handle: str) -> Figure:
        """The figure of a failure beside the original vehicle."""
        return draw_comparison(compare_setting(self.case.study, self.system, self.setting_of(handle)))

    def anchor(self, *parts: object) -> str:
        """The HTML anchor of an element of the page, in this study's section."""
        text = "-".join(str(part) for part in ("study", self.study_number, *parts))
        return "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in text)


def read_inputs(
    directories: Iterable[str | Path],
    point: str | None = None,
    margin: float | None = None,
    *,
    as_it_is_now: bool = False,
) -> list[ReportInput]:
    """Read results directories; with `point`, simulate their solutions again at this point of the matrix.

    Raises
    ------
    InputError
        If a directory holds no results, is damaged or is given twice, a study cannot be simulated here or has no such
        point, or files or versions have changed since the results were computed and `as_it_is_now` is false.
    """
    paths = [Path(directory) for directory in directories]
    inputs = []
    for study_number, (path, case) in enumerate(zip(paths, load_cases(paths), strict=True), 1):
        later_changes = changes_since(path, case, as_it_is_now=as_it_is_now)
        subject = case if point is None else at_point(case, point)
        inputs.append(
            ReportInput(
                study_number=study_number,
                directory=path,
                case=subject,
                system=assemble(subject.study, str(path)),
                versions=read_manifest(path)["versions"],
                margin=margin,
                point=point or "",
                later_changes=later_changes,
            )
        )
    return inputs
