"""What a question is asked of: a study, or the results of one, read back."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from safevar_sumo.analysis.options import Options
from safevar_sumo.errors import InputError, did_you_mean, one_of, warn
from safevar_sumo.results import MANIFEST, comparable_inputs, differences_now, manifest_of, read_later, read_manifest
from safevar_sumo.study import Study, StudyLike, load_study, study_names
from safevar_sumo.terminal import shown

if TYPE_CHECKING:
    import pandas as pd

    from safevar_sumo.analysis.research_questions.case import Case

MOST = 3
"""Changes that are named in one line."""


@dataclass(frozen=True)
class Results:
    """What a results directory holds, finished or not.

    Attributes
    ----------
    directory
        The directory.
    case
        Study, solutions and evaluations, as the research questions take them.
    """

    directory: Path
    case: Case

    @property
    def study(self) -> Study:
        """The study as it was run."""
        return self.case.study

    @cached_property
    def original(self) -> Mapping[str, Any]:
        """The original vehicle's outcome, metrics and objectives as plain values; what is undefined is None."""
        return dict(read_manifest(self.directory)["original"])

    @property
    def solutions(self) -> pd.DataFrame:
        """One row per solution of every finished run.

        Columns: algorithm, run (not of imported ones), the characteristics in their table units, f_safe [m or -m/s],
        f_diff [fraction], f_num_diff, the metrics in their units (NaN where undefined), outcome.
        """
        return self.case.solutions

    @property
    def evaluations(self) -> pd.DataFrame:
        """One row per simulated setting of every run, in the order in which the run asked; columns as of `solutions`."""
        return self.case.evaluations

    @property
    def finished(self) -> tuple[tuple[str, int], ...]:
        """Algorithm and number of every finished run."""
        return self.case.finished

    def __repr__(self) -> str:
        return f"<Results of {self.case.name} in {self.directory}: {len(self.finished)} runs, {len(self.solutions)} solutions>"


def load(directory: str | Path) -> Results:
    """Read a results directory as `run` or a command has left it, finished or not.

    Parameters
    ----------
    directory
        The directory.

    Raises
    ------
    InputError
        If it is none, or a file in it is damaged.
    """
    from safevar_sumo.analysis.research_questions.case import load_cases

    return Results(Path(directory), load_cases([directory])[0])


def study_or_case(source: StudyLike | Results, *, as_it_is_now: bool = False) -> Study | Case:
    """The study, or the case of results or of their directory, that a question is about.

    Warns
    -----
    UserWarning
        With `as_it_is_now` of what has changed since the results were computed.

    Raises
    ------
    InputError
        If it is neither, or something that the results were computed with has changed since.
    """
    if isinstance(source, str | Path) and str(source) not in study_names():
        if os.path.isdir(source):  # takes any text, which methods of a path do not
            source = load(source)
        elif not os.path.exists(source):
            legal = f"a directory that the command study has written, {one_of(study_names())}, or the path of a study file (TOML)"
            problem = f"is no results directory, no study and no file{did_you_mean(source, study_names())}"
            raise InputError(source, problem, legal)
    if isinstance(source, Results):
        for change in changes_since(source.directory, source.case, as_it_is_now=as_it_is_now):
            warn(f"{source.directory}: {change}")
        return source.case
    return load_study(source)


def study_of(source: StudyLike | Results, *, as_it_is_now: bool = False) -> Study:
    """The study itself, or the one of the results; raises as `study_or_case`."""
    subject = study_or_case(source, as_it_is_now=as_it_is_now)
    return subject if isinstance(subject, Study) else subject.study


def changes_since(directory: Path, case: Case, *, as_it_is_now: bool = False) -> list[str]:
    """Differences between what is simulated now and what results were computed with; none of imported results, which record nothing.

    Raises
    ------
    InputError
        If it differs in anything and `as_it_is_now` does not allow that; names the files.
    """
    from safevar_sumo.campaign import read_by_algorithms
    from safevar_sumo.sumo.system import assemble
    from safevar_sumo.workers.batches import sources_of
    from safevar_sumo.workers.identity import identity_of
    from safevar_sumo.workers.local import local_pool

    manifest, study = read_manifest(directory), case.study
    if "imported" in manifest:
        return []
    system = assemble(study, str(directory))
    with local_pool(1, study.search.time_limit) as pool:
        sources = {**sources_of(study, pool), **read_by_algorithms(study)}
    manifest, sources = comparable_inputs(manifest, sources, read_later(directory), study.origin.places)
    changed = differences_now(manifest, manifest_of(study, identity_of(study, system, sources)))
    if changed and not as_it_is_now:
        more = f" (and {len(changed) - MOST} more)" if len(changed) > MOST else ""
        raise InputError(directory / MANIFEST, f"{'; '.join(changed[:MOST])}{more}: what is simulated now is not what these results hold",
                         "what was there then; or --as-it-is-now (as_it_is_now=True), which simulates with what is there now and says so")
    return [f"{difference}; simulated as it is now" for difference in changed]


T = TypeVar("T")


def answered(compute: Callable[..., T], subject: Study | Case, options: type[Options], given: Mapping[str, Any]) -> T:
    """The result of a question's computation; `given` holds the arguments of the question's function by name."""
    from safevar_sumo.metrics import Unsafe

    asked = {name: given[name] for name in options.described()}
    if asked.get("unsafe") is not None:
        asked["unsafe"] = str(Unsafe.parse(asked["unsafe"]))
    with shown(given["progress"]) as show:
        return compute(subject, options(**asked), pool=given["pool"], jobs=given["jobs"], progress=show)
