"""A case holds the results of one study: the solutions by algorithm and run, and the metrics of the
original vehicle. All questions read cases.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from safevar_sumo.errors import InputError, check_text, describe_error
from safevar_sumo.metrics import PUBLISHED_SCORING, Measure, Scoring, Unsafe
from safevar_sumo.questions.words import count_in_words
from safevar_sumo.records import (
    Evaluations,
    FloatArray,
    JsonObject,
    NamedValues,
    Outcome,
)
from safevar_sumo.results import RunName, failure_lines, folders_of, load_runs
from safevar_sumo.scenarios import weather_of
from safevar_sumo.study import ORIGINAL_DEGREE, SAFETY_DEGREE, Origin, Study, Weather
from safevar_sumo.vehicles import CharacteristicSet

NSGA2 = "nsga2"
"""The algorithm that RQ2 compares with the others, and whose solutions RQ3 analyses."""
OF_ALGORITHMS = ("titles", "stop_by_themselves")
"""Keys of a manifest (the description of a results directory) whose values become attributes of a
case, although they may be missing.
"""
ALGORITHM_TITLES = {"nsga2": "NSGA-II", "rs": "RS", "safe_fuzzer": "SafeFuzzer"}


class UnanswerableError(InputError):
    """The results lack the data that a question needs."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Results:
    """The results of one study; its runs may be unfinished.

    Attributes
    ----------
    name
        Name of the results in tables.
    study
        The study as it was run.
    original
        The original vehicle's outcome, metrics and objectives as plain values, None where
        undefined.
    solutions
        One row per solution of every finished run. Columns: algorithm, run (absent from imported
        results), the characteristics in their table units, f_safe [m or -m/s], f_diff [fraction],
        f_num_diff, the metrics in their units (NaN where undefined), outcome.
    evaluations
        One row per simulated setting of every run, in the order of the run's requests; same columns
        as `solutions`. If encounters are ranges, `feasible` is true where the original vehicle is
        safe in the same encounter: only these count.
    finished
        Algorithm and number of every finished run.
    directory
        The directory of the results; None if they were not read from one.
    scoring
        The metrics, and the objectives that the search minimises.
    has_runs
        False for imported solutions, whose runs are unknown.
    failures
        Settings that could not be simulated.
    titles
        Names of algorithms for readers, by label. Only algorithms whose class has a name are in it.
    stop_by_themselves
        Labels of algorithms that may end before they have used their budget.
    stated
        The criterion for unsafe solutions that a user states; None for the default.
    """

    name: str
    study: Study
    original: JsonObject
    solutions: pd.DataFrame
    evaluations: pd.DataFrame
    finished: tuple[RunName, ...]
    directory: Path | None = None
    has_runs: bool = True
    failures: tuple[tuple[str, str], ...] = ()
    scoring: Scoring = PUBLISHED_SCORING
    titles: Mapping[str, str] = field(default_factory=dict)
    stop_by_themselves: Collection[str] = ("safe_fuzzer",)
    stated: Unsafe | None = None

    def _repr_html_(self) -> str:
        return f"<p>{escape(repr(self))}</p>\n{self.solutions.to_html(max_rows=10, index=False)}"

    def __repr__(self) -> str:
        return (
            f"<Results of {self.name} in {self.directory}: {len(self.finished)} runs,"
            f" {len(self.solutions)} solutions>"
        )

    @property
    def original_metrics(self) -> NamedValues:
        """The original vehicle's metrics by name; NaN where undefined."""
        metrics = {}
        for metric in self.scoring.metrics:
            value = self.original.get(metric.name)
            metrics[metric.name] = np.nan if value is None else float(value)
        return metrics

    def title_of(self, algorithm: str) -> str:
        """The name of an algorithm for readers."""
        return self.titles.get(algorithm) or ALGORITHM_TITLES.get(algorithm, algorithm)

    @property
    def characteristics(self) -> CharacteristicSet:
        """The characteristics of the study."""
        return CharacteristicSet.of(self.study)

    @property
    def settings(self) -> FloatArray:
        """The settings of the original vehicle and of the M solutions, shape (1 + M, n)."""
        solutions = self.solutions[list(self.characteristics.names)].to_numpy(float)
        return np.concatenate([self.characteristics.original_settings, solutions])

    @property
    def different_solutions(self) -> pd.DataFrame:
        """The solutions without duplicates: the first of several equal settings remains."""
        return self.solutions.drop_duplicates(list(self.characteristics.names))

    def simulated_as(
        self, study: Study, scoring: Scoring, evaluations: Evaluations
    ) -> Results:
        """These results with another study, and as they were simulated in that study.

        Parameters
        ----------
        study, scoring
            The other study and its metrics.
        evaluations
            The evaluations of `settings` in the other study, in the same order.
        """
        # The first evaluation is that of the original vehicle.
        returned = evaluations.take(slice(1, None))
        solutions = self.solutions.drop(
            columns=list(self.original_metrics.keys() - evaluations.metrics.keys())
        ).assign(f_safe=returned.f_safe, **returned.results)
        original = JsonObject()
        for metric in scoring.metrics:
            original[metric.name] = float(evaluations.metrics[metric.name][0])
        return replace(
            self, study=study, scoring=scoring, original=original, solutions=solutions
        )

    @property
    def weather(self) -> Weather:
        """The weather of the study."""
        return weather_of(self.study.weather)

    @property
    def unsafe(self) -> Unsafe:
        """The criterion for unsafe solutions: the stated criterion, else that of the study, else
        the default (`Unsafe.default`).
        """
        if self.stated is None and self.study.unsafe.criterion:
            return Unsafe.parse(self.study.unsafe.criterion)
        return self.stated or Unsafe.default(
            self.original_metrics, self.solutions["outcome"]
        )

    @property
    def algorithms(self) -> tuple[str, ...]:
        """Labels of the algorithms with solutions or a finished run, in the study's order."""
        names = {*self.solutions["algorithm"], *dict(self.finished)}
        in_order = dict.fromkeys([*self.study.search.labels, *sorted(names)])
        return tuple(name for name in in_order if name in names)

    def original_degrees(self, solutions: pd.DataFrame) -> pd.Series[float]:
        """For each solution, the safety degree of the original vehicle. If encounters are ranges,
        the original vehicle drives in the solution's own encounter.
        """
        if ORIGINAL_DEGREE in solutions:
            return solutions[ORIGINAL_DEGREE]
        return pd.Series(self.original_metrics[SAFETY_DEGREE], index=solutions.index)

    @property
    def why_no_solution(self) -> str:
        """The reason for which there is no solution, in words; "" if there are solutions."""
        if len(self.solutions):
            return ""
        if not self.finished:
            return "no run is finished"

        # A search may return only feasible settings: perhaps no setting is feasible.
        feasible = self.evaluations[self.scoring.feasible_rows(self.evaluations)]
        if feasible.empty:
            return (
                "the original vehicle keeps at least"
                f" {self.study.scenario.margin or 0.0:g} m of clearance (scenario.margin) in none"
                f" of the {len(self.evaluations):,} encounters"
            )
        valid = feasible.dropna(
            subset=[objective.name for objective in self.scoring.objectives]
        )
        number = int(self.unsafe.rows(valid).sum())
        return (
            f"the algorithms selected none of the {len(valid):,} simulated vehicles that have a"
            " value for every objective (quantity that the search minimises)."
            f" {count_in_words(number, len(valid)).capitalize()} vehicles with such values"
            f" {self.unsafe.verbs[number > 1]}"
        )

    def require_solutions(self) -> None:
        """Refuse results without a solution: raise `UnanswerableError` with the reason."""
        if reason := self.why_no_solution:
            expected = "results with at least one solution"
            if self.has_runs and not self.finished:
                expected = "at least one finished run: `study` goes on where it was interrupted"
            raise UnanswerableError(self.name, f"has no solution: {reason}", expected)

    def solutions_of(self, algorithm: str) -> pd.DataFrame:
        """The solutions of all finished runs of an algorithm in one frame.

        Raises
        ------
        UnanswerableError
            If the algorithm has no finished run.
        """
        if algorithm not in self.algorithms:
            names = ", ".join(self.algorithms) or "no algorithm"
            raise UnanswerableError(
                self.name,
                f"has no finished run of {algorithm}",
                f"results of {algorithm} (it has results of {names})",
            )
        return self.solutions[self.solutions["algorithm"] == algorithm]

    def require_runs(self) -> None:
        """Refuse solutions that belong to no run, because they are imported: raise
        `UnanswerableError`.
        """
        if not self.has_runs:
            raise UnanswerableError(
                self.name,
                "is imported: the runs of its solutions are unknown",
                "results of the command `study`",
            )

    def runs_of(self, algorithm: str) -> list[int]:
        """The numbers of the finished runs of an algorithm, in ascending order.

        Raises
        ------
        UnanswerableError
            If the solutions are imported and belong to no run.
        """
        self.require_runs()
        return sorted(run for name, run in self.finished if name == algorithm)

    @property
    def run_counts(self) -> Counter[str]:
        """The number of finished runs of each algorithm."""
        return Counter(algorithm for algorithm, _ in self.finished)

    @property
    def shortfall(self) -> str:
        """A note on unfinished runs, which every answer about the solutions shows; "" if all runs
        are finished, or the runs are unknown.
        """
        finished = self.run_counts
        planned = self.study.search.runs
        unfinished = [
            f"{finished[name]} of {planned} runs of {name}"
            for name in self.study.search.labels
            if finished[name] < planned
        ]
        if not (self.has_runs and unfinished):
            return ""
        return (
            f"The results of {self.name} are incomplete: {', '.join(unfinished)} are finished. Only"
            " solutions of finished runs count."
        )

    @property
    def remarks(self) -> list[str]:
        """Notes for the readers of every table of these results."""
        remarks = [self.shortfall] if self.shortfall else []
        if not self.has_runs:
            remarks.append(
                f"The solutions of {self.name} are imported and belong to no run. The metrics of"
                " the original vehicle were published or supplied with these solutions."
            )
        if self.failures:
            remarks.append(
                f"{len(self.failures)} vehicles of {self.name} could not be simulated"
                " (simulator-error) and are in no result:"
                f" {'; '.join(failure_lines(self.failures))}. The command study --retry-failed"
                " simulates these vehicles again."
            )
        return remarks


Subject = Study | Results
"""The subject of a question: a study, or the results of one."""


def solutions_for_metric(solutions: pd.DataFrame, metric: Measure) -> pd.DataFrame:
    """The solutions that count for a metric. Some metrics, such as TET and TIT, are compared only
    over solutions without a collision (docs/method.md, section 4).
    """
    if metric.over_collisions:
        return solutions
    return solutions[~are_collisions(solutions)]


def are_collisions(solutions: pd.DataFrame) -> pd.Series[bool]:
    """Whether each solution ended with a collision."""
    return solutions["outcome"] == str(Outcome.COLLISION)


def load_cases(directories: Iterable[str | Path]) -> list[Results]:
    """Read directories of results. If several results have the same name, their names get the
    directory in brackets.

    Raises
    ------
    InputError
        If a directory holds no results, is damaged, or is given twice.
    """
    paths = [Path(check_text("directory", directory)) for directory in directories]
    for path, count in Counter(map(Path.resolve, paths)).items():
        if count > 1:
            raise InputError(
                "directories", f"{path} is given twice", "each results directory once"
            )

    cases = []
    for path in paths:
        try:
            manifest, evaluations, solutions, finished, failures = load_runs(path)
            study = msgspec.convert(manifest["study"], Study)
            study = msgspec.structs.replace(
                study, origin=Origin(places=folders_of(path, manifest))
            )
            facts = {name: manifest[name] for name in OF_ALGORITHMS if name in manifest}
            if "scoring" in manifest:
                facts["scoring"] = msgspec.convert(manifest["scoring"], Scoring)
            cases.append(
                build_case(
                    study,
                    manifest["original"],
                    solutions,
                    evaluations,
                    finished,
                    directory=path,
                    has_runs="imported" not in manifest,
                    failures=failures,
                    **facts,
                )
            )
        except (TypeError, ValueError, KeyError, ArithmeticError) as error:
            raise InputError(
                path,
                f"is damaged: {describe_error(error)}",
                "an unchanged directory of the command `study`",
            ) from error

    names = Counter(case.name for case in cases)
    for place, path in enumerate(paths):
        name = cases[place].name
        if names[name] > 1:
            cases[place] = replace(cases[place], name=f"{name} ({path})")
    return cases


def build_case(
    study: Study,
    original: JsonObject,
    solutions: pd.DataFrame,
    evaluations: pd.DataFrame,
    finished: Sequence[RunName],
    scoring: Scoring = PUBLISHED_SCORING,
    **facts: Any,
) -> Results:
    """Make results. In `original`, the original vehicle's metrics by name, an undefined metric is
    None or missing.

    Frames get a column of NaN for each metric and objective that they lack. `facts` are further
    attributes of `Results`.
    """
    names = [measure.name for measure in (*scoring.metrics, *scoring.objectives)]

    def with_all_columns(frame: pd.DataFrame) -> pd.DataFrame:
        """The frame with a column of NaN for each metric and objective that it lacks."""
        absent = [name for name in names if name not in frame]
        return frame.assign(**dict.fromkeys(absent, np.nan))

    solutions = with_all_columns(solutions)
    evaluations = with_all_columns(evaluations)
    if scoring.safe_original is not None:
        evaluations = evaluations.assign(feasible=scoring.feasible_rows(evaluations))
    return Results(
        name=study.name,
        study=study,
        original=original,
        solutions=solutions,
        evaluations=evaluations,
        finished=tuple(finished),
        scoring=scoring,
        **facts,
    )
