"""What a pack of evidence claims about results.

`evidence` makes the files of a pack one after the other, each from those before it; `verify` makes them again.
"""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pandas as pd

from safevar_sumo.analysis.case import Case, are_collisions, build_case
from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.explain.compute import explain_failures
from safevar_sumo.analysis.options import Options
from safevar_sumo.analysis.rating import RatingOptions
from safevar_sumo.analysis.rating.compute import rate_variant
from safevar_sumo.analysis.repair import RepairOptions
from safevar_sumo.analysis.repair.compute import find_repairs
from safevar_sumo.analysis.risk import RiskOptions
from safevar_sumo.analysis.risk.compute import estimate_risk
from safevar_sumo.analysis.subject import answer_question, study_or_case
from safevar_sumo.analysis.tolerance import ToleranceOptions
from safevar_sumo.analysis.tolerance.compute import find_tolerances
from safevar_sumo.campaign.local import available_cores, local_pool
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import PUBLISHED_SCORING, Scoring
from safevar_sumo.plugins import file_by_name, is_shipped
from safevar_sumo.records import FloatArray, JsonObject
from safevar_sumo.reference.rows import read_reference
from safevar_sumo.report.dossier import dossier_page, make_dossier
from safevar_sumo.report.measurements import check_study, settings_of, validate_with
from safevar_sumo.report.pack import Description, PackedAnswer, PackedStudy, describe
from safevar_sumo.results import MANIFEST, SOLUTIONS, evaluations_frame, read_manifest
from safevar_sumo.study import Origin, Study, convert_table, write_study
from safevar_sumo.sumo.network import OPTIONS_FILE, options_of
from safevar_sumo.terminal import Progress
from safevar_sumo.vehicles import CharacteristicSet

QUESTIONS: Mapping[str, tuple[type[Options], Callable[..., Any]]] = {
    "explain": (ExplainOptions, explain_failures),
    "tolerance": (ToleranceOptions, find_tolerances),
    "risk": (RiskOptions, estimate_risk),
    "rating": (RatingOptions, rate_variant),
    "repair": (RepairOptions, find_repairs),
}
"""The questions whose answers a pack may hold: their options, and the functions that compute them."""
STUDY, SETTINGS, CHECKS = "study.toml", "settings.csv", "checks.json"
DOSSIER, DOSSIER_PAGE = "dossier.json", "dossier.html"
ANSWERS, CODE, REFERENCES, VALIDATIONS = "answers", "code", "references", "validations"
"""Files and folders of a study in a pack, beside manifest and solutions."""
PLACE = "place"
"""Column of `settings.csv`: the answer that names a setting, and where in its JSON."""
TEXT_COLUMNS = ("algorithm", "outcome", PLACE)
WHOLE_COLUMNS = ("run", "f_num_diff")


class PackedSubject(NamedTuple):
    """A study of a pack, with the files of its folder; its case has the solutions that the pack's CSV file holds."""

    packed: PackedStudy
    files: dict[str, bytes]
    manifest: JsonObject
    case: Case

    @property
    def study(self) -> Study:
        return self.case.study

    def names_in(self, *folders: str) -> list[str]:
        """The distinct names, without folder and ending, of the files in some folders."""
        names = (PurePosixPath(name) for name in self.files)
        return sorted({name.stem for name in names if str(name.parent) in folders})

    @property
    def made_files(self) -> list[str]:
        """The files that `make` makes, in order."""
        answers = [f"{ANSWERS}/{answer.question}.json" for answer in self.packed.answers]
        validations = [f"{VALIDATIONS}/{name}.json" for name in self.names_in(REFERENCES, VALIDATIONS)]
        return [*validations, *answers, CHECKS, STUDY, DOSSIER, DOSSIER_PAGE]

    def make(self, name: str, pool: Pool, progress: Progress) -> bytes:
        """A file of the pack, from the study and the files before it.

        Raises
        ------
        InputError
            If the published rows of a validation are missing.
        """
        folder, stem = name.partition("/")[0], PurePosixPath(name).stem
        if name == STUDY:
            return study_text(self.study)
        if name == CHECKS:
            return json_bytes(check_study(self.study, settings_of(self.case), pool, progress))
        if folder == VALIDATIONS:
            references = (file for file in self.files if file.startswith(f"{REFERENCES}/"))
            reference = next((file for file in references if PurePosixPath(file).stem == stem), None)
            if reference is None:
                raise InputError(name, "the pack has only the digest of its published rows")
            with tempfile.TemporaryDirectory() as unpacked:
                path = Path(unpacked, PurePosixPath(reference).name)
                path.write_bytes(self.files[reference])
                return json_bytes(validate_with(self.study, path, pool, progress))
        if folder == ANSWERS:
            (answer,) = (answer for answer in self.packed.answers if answer.question == stem)
            options, compute = QUESTIONS[stem]
            result = answer_question(compute, self.case, options(**answer.options), pool=pool, progress=progress)
            return json_bytes(result.to_dict())
        dossier = self.dossier()
        return json_bytes(dossier) if name == DOSSIER else dossier_page(dossier).encode()

    def dossier(self) -> JsonObject:
        answers = {
            answer.question: (answer.command, json.loads(self.files[f"{ANSWERS}/{answer.question}.json"]))
            for answer in self.packed.answers
        }
        validations = [json.loads(self.files[f"{VALIDATIONS}/{name}.json"]) for name in self.names_in(VALIDATIONS)]
        checks = json.loads(self.files[CHECKS])
        return make_dossier(self.manifest, self.study, self.packed.counts, answers, checks, validations)

    def named_settings(self, question: str) -> Iterator[tuple[str, FloatArray]]:
        """The settings that an answer names, with their places."""
        answer = json.loads(self.files[f"{ANSWERS}/{question}.json"])
        return _named_settings(answer, self.case.characteristics, question)

    def evaluated(self, settings: FloatArray, pool: Pool, progress: Progress, stage: str) -> pd.DataFrame:
        """Settings, shape (M, n), as rows of `solutions.csv` without algorithm and run."""
        evaluations = Evaluator(self.study, pool, progress).evaluate(settings, stage, ignore_constraints=True)
        frame = evaluations_frame(self.case.characteristics.names, [(("", 0), evaluations)])
        return frame.drop(columns=["algorithm", "run"])


def subject_of(packed: PackedStudy, files: dict[str, bytes], places: Sequence[str] = ()) -> PackedSubject:
    """The subject that manifest and solutions among the files describe; user code is in the folders `places`.

    Raises
    ------
    InputError, KeyError, TypeError, ValueError
        If one of them is damaged.
    """
    manifest = json.loads(files[MANIFEST])
    study = convert_table(MANIFEST, manifest["study"], Study, "study")
    study = msgspec.structs.replace(study, origin=Origin(places=tuple(places)))
    scoring = msgspec.convert(manifest["scoring"], Scoring) if "scoring" in manifest else PUBLISHED_SCORING
    frame = read_table(files[SOLUTIONS])
    case = build_case(study, manifest["original"], frame, frame.iloc[:0], packed.runs, scoring=scoring)
    return PackedSubject(packed, files, manifest, case)


def read_table(content: bytes) -> pd.DataFrame:
    """Read a CSV table of settings to the last bit; raises ValueError or KeyError if a cell is no number."""
    frame = pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False)
    numbers = [name for name in frame if name not in TEXT_COLUMNS]
    frame = frame.replace({name: {"": "nan"} for name in numbers}).astype(dict.fromkeys(numbers, float))
    return frame.astype({name: int for name in WHOLE_COLUMNS if name in frame})


def json_bytes(value: Any) -> bytes:
    return (json.dumps(value, indent=2, allow_nan=False) + "\n").encode()


def csv_of(frame: pd.DataFrame) -> bytes:
    return frame.to_csv(index=False, lineterminator="\n").encode()


def count_found(
    solutions: pd.DataFrame, runs: Collection[tuple[str, int]], evaluations: pd.DataFrame
) -> dict[str, int]:
    """What a search has found."""
    return {
        "solutions": len(solutions),
        "runs": len(runs),
        "evaluations": len(evaluations),
        "collisions": int(are_collisions(evaluations).sum()),
    }


def command_of(question: str, options: JsonObject, study_name: str) -> str:
    """The command that prints an answer."""
    return f"{QUESTIONS[question][0](**options).command_line(f'results/{study_name}')} --json"


def _named_settings(answer: Any, characteristics: CharacteristicSet, path: str) -> Iterator[tuple[str, FloatArray]]:
    """The settings that an answer's JSON names, whole or by their changes from the original, each after its path.

    A setting stands beside its `outcome`; changes with an undefined value name no setting.
    """
    names = characteristics.names
    if isinstance(answer, list):
        for index, item in enumerate(answer):
            yield from _named_settings(item, characteristics, f"{path}.{index}")
    elif isinstance(answer, dict):
        for key, value in answer.items():
            is_setting = isinstance(value, dict) and value and value.keys() <= set(names) and "outcome" in answer
            if is_setting and key in ("setting", "changes") and None not in value.values():
                original = dict(zip(names, characteristics.original.tolist(), strict=True))
                yield f"{path}.{key}", np.array([float({**original, **value}[name]) for name in names])
            else:
                yield from _named_settings(value, characteristics, f"{path}.{key}")


def make_pack(
    directories: Iterable[str | Path],
    questions: Collection[str],
    references: Sequence[Path],
    jobs: int | None,
    progress: Progress,
    *,
    digests_only: bool,
) -> tuple[Description, dict[str, bytes]]:
    """The description and the files of a pack about results.

    Parameters
    ----------
    questions
        Names of `QUESTIONS` to be answered about each.
    references
        Files of published rows to validate each study with.
    digests_only
        Whether user code and files stay out of the pack.

    Raises
    ------
    InputError
        If a directory holds no results of a study, or its inputs have changed since.
    """
    if len({path.stem for path in references}) < len(references):
        raise InputError("references", "two files have the same name", "files of different names")
    cases = []
    for directory in dict.fromkeys(map(Path, directories)):
        case = study_or_case(directory, results_only=True)
        assert isinstance(case, Case)
        if not case.has_runs:
            raise InputError(directory, "holds imported solutions, which have no identity", "results of `study`")
        for path in references:
            read_reference(path, case.characteristics)  # raises errors with the user's path
        cases.append((directory, case))
    studies, files = [], {}
    for number, (directory, case) in enumerate(cases, 1):
        code = {} if digests_only else _files_of_user(case.study, directory)
        subject = _subject_of_results(f"{number}-{case.study.name}", directory, case, questions, code)
        subject.files.update({f"{REFERENCES}/{path.name}": path.read_bytes() for path in references})
        with local_pool(jobs or available_cores(), case.study.search.time_limit) as pool:
            for name in subject.made_files:
                subject.files[name] = subject.make(name, pool, progress)
            settings = dict[str, FloatArray]()
            for answer in subject.packed.answers:
                settings.update(subject.named_settings(answer.question))
            if settings:
                frame = subject.evaluated(np.array([*settings.values()]), pool, progress, "named settings")
                subject.files[SETTINGS] = csv_of(frame.assign(**{PLACE: [*settings]})[[PLACE, *frame]])
        for name, content in subject.files.items():
            if not (digests_only and name.startswith(f"{REFERENCES}/")):
                files[f"{subject.packed.folder}/{name}"] = content
        studies.append(subject.packed)
    return describe(studies, digests_only), files


def _subject_of_results(
    folder: str, directory: Path, case: Case, questions: Collection[str], code: Mapping[str, bytes]
) -> PackedSubject:
    """The subject of a results directory, with the files from which `make` makes all others."""
    name, manifest, answers = case.study.name, read_manifest(directory), []
    manifest.pop("folders", None)  # of this machine
    for question, (options, _) in QUESTIONS.items():
        if question in questions:
            values = msgspec.to_builtins(options())
            answers.append(PackedAnswer(question, values, command_of(question, values, name)))
    counts = count_found(case.solutions, case.finished_runs, case.evaluations)
    packed = PackedStudy(folder, name, counts, answers, list(case.finished_runs), sorted(code))
    files = {MANIFEST: json_bytes(manifest), SOLUTIONS: csv_of(case.solutions)}
    files |= {f"{CODE}/{file}": content for file, content in code.items()}
    return subject_of(packed, files, case.study.origin.places)


def study_text(study: Study) -> bytes:
    """A study file with all that the study extends."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"{study.name}.toml")
        write_study(path, study, "The study as it was run, with all that it extends.")
        return path.read_bytes().partition(b"\n")[2]  # without the path of the schema on this machine


def _files_of_user(study: Study, directory: Path) -> dict[str, bytes]:
    """The user's files that count in the identity of results, by the names that a pack gives them, and the views of
    sumo-gui beside networks, without which SUMO does not start.
    """
    places = study.origin.places
    names = [name for name in read_manifest(directory)["files"] if not (Path(name).is_absolute() or is_shipped(name))]
    for name in [name for name in names if Path(name).name == OPTIONS_FILE]:
        view = options_of(Path(file_by_name(name, places))).get("gui-settings-file", "")
        names += [str(Path(name).with_name(view))] if view else []
    paths = {name: file_by_name(name, places) for name in names}
    return {name: Path(path).read_bytes() for name, path in sorted(paths.items()) if path}
