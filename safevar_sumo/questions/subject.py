"""Loads the subject of a question: a study, or the results in a directory."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace as replace_in

from safevar_sumo.errors import InputError, did_you_mean, one_of, warn
from safevar_sumo.questions.arguments import checked
from safevar_sumo.results import (
    MANIFEST,
    manifest_differences,
    read_manifest,
)
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.study import Study, StudyLike, study_names
from safevar_sumo.study.file import ENDED_STUDIES

if TYPE_CHECKING:
    from safevar_sumo.questions.case import Results, Subject

MAX_CHANGES_NAMED = 3
"""Maximum number of changed inputs that an error names."""


@checked
def load(directory: str | Path) -> Results:
    """Read a results directory; its runs may be unfinished.

    Parameters
    ----------
    directory
        The directory.

    Raises
    ------
    InputError
        If the directory holds no results, or a file in it is damaged.
    """
    from safevar_sumo.questions.case import load_cases

    return load_cases([directory])[0]


def study_or_case(
    source: StudyLike | Results,
    *,
    as_it_is_now: bool = False,
    results_only: bool = False,
) -> Subject:
    """The subject of a question: a study, or results; `source` may be a name or a path.

    With `results_only`, a name or path means a directory, even if a study has the same name.

    Warns
    -----
    UserWarning
        If a directory of results has the name of the study; with `as_it_is_now`, for each input
        that has changed since the results were computed.

    Raises
    ------
    InputError
        If `source` is no study and no results, if an input of the results has changed, or if
        `as_it_is_now` is set for a study.
    """
    from safevar_sumo.questions.case import Results

    if isinstance(source, str | Path):
        # A text that is no legal path must give an error of its own: `os.path` accepts any text.
        names = study_names()
        is_directory = os.path.isdir(source)
        is_study = str(source) in names
        if results_only and not is_directory and (is_study or os.path.isfile(source)):
            raise InputError(
                source,
                "is a study and has no solutions",
                "a directory that the command `study` has written",
            )
        if results_only or (is_directory and not is_study):
            source = load(source)
        elif is_study and os.path.exists(os.path.join(source, MANIFEST)):
            warn(
                f"{source} is the study; the results in the directory of this name are ./{source}"
            )
        elif not (is_study or os.path.lexists(source) or source in ENDED_STUDIES):
            raise InputError(
                source,
                f"is neither a results directory, a study nor a file{did_you_mean(source, names)}",
                "the path of a study file (TOML), a directory that the command `study` has"
                f" written, or {one_of(names)}",
            )
    if isinstance(source, Results):
        if source.directory is not None:
            for change in changes_since(
                source.directory, source, as_it_is_now=as_it_is_now
            ):
                warn(f"{source.directory}: {change}")
        return source
    if as_it_is_now:
        raise InputError(
            "as_it_is_now",
            "a study is simulated as it is now anyway",
            "results, which keep the study that they had",
        )
    return read_study(source)


def part_of(
    subject: Subject, ranges: bool, point: str | None, up_to: str | None
) -> Subject:
    """The part of a subject that a question is asked about: of a study, see `part_of_study`.
    Results may only be cut to a test or point of the matrix.

    Raises
    ------
    InputError
        If the study has no such part, or if results are cut in another way.
    """
    # SUMO takes long to load.
    from safevar_sumo.questions.part import part_of_study

    if isinstance(subject, Study):
        return part_of_study(subject, ranges, point, up_to)
    refuse_part_of_results(ranges=ranges, up_to=up_to)
    if point is None:
        return subject
    return case_at(subject, point)


def refuse_part_of_results(*, ranges: bool, up_to: str | None) -> None:
    """Refuse options that cut encounters, if they are given for results."""
    if ranges or up_to is not None:
        option = "ranges" if ranges else "up_to"
        raise InputError(
            option, "of results, whose encounters are those of their study", "a study"
        )


def study_in(subject: Subject) -> Study:
    """The study itself, or the study of the results."""
    if isinstance(subject, Study):
        return subject
    return subject.study


def with_own_set(subject: Subject) -> Any:
    """The same subject, but its study has only its own parameter set of the vehicle model."""
    study = replace_in(study_in(subject), spread={})
    if isinstance(subject, Study):
        return study
    return replace(subject, study=study)


def case_at(case: Results, point: str) -> Results:
    """Results at a test or point of the study's matrix alone: the solutions and the original
    vehicle are simulated again there.

    Raises
    ------
    InputError
        If the study has no such test or point.
    """
    from safevar_sumo.questions.part import at_point
    from safevar_sumo.sumo.matrix import drive_and_score
    from safevar_sumo.sumo.system import assemble

    study = at_point(case.study, point)
    system = assemble(study)
    settings = system.characteristics.of_others(case.characteristics, case.settings)
    return case.simulated_as(
        study, system.measuring.scoring, drive_and_score(system, settings)
    )


def changes_since(directory: Path, case: Results, *, as_it_is_now: bool) -> list[str]:
    """The inputs that have changed since the results were computed, each in a sentence. Imported
    results record no inputs: then there are no changes.

    Raises
    ------
    InputError
        If an input has changed and `as_it_is_now` is false; the message names the changes.
    """
    from safevar_sumo.campaign.inputs import manifest_now
    from safevar_sumo.sumo.system import assemble

    manifest = read_manifest(directory)
    study = case.study
    if "imported" in manifest:
        return []
    present = manifest_now(study, assemble(study), manifest.get("files", {}))
    changes = [
        text for _, text, matters in manifest_differences(manifest, present) if matters
    ]

    if changes and not as_it_is_now:
        names = "; ".join(changes[:MAX_CHANGES_NAMED])
        if len(changes) > MAX_CHANGES_NAMED:
            names += f" (and {len(changes) - MAX_CHANGES_NAMED} more)"
        raise InputError(
            directory / MANIFEST,
            f"{names}: new simulations would not match these results",
            "the inputs of that time; questions simulate with the present ones, and warn, by"
            " `as_it_is_now=True`",
        )
    return [f"{difference}; simulated as it is now" for difference in changes]
