"""What a pack of evidence claims about results: made from their directory, and again from the pack alone."""

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

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.explain.compute import explain_failures
from safevar_sumo.analysis.options import Options
from safevar_sumo.analysis.rating import RatingOptions
from safevar_sumo.analysis.rating.compute import rate_variant
from safevar_sumo.analysis.repair import RepairOptions
from safevar_sumo.analysis.repair.compute import find_repairs
from safevar_sumo.analysis.research_questions.case import Case, are_collisions, build_case
from safevar_sumo.analysis.risk import RiskOptions
from safevar_sumo.analysis.risk.compute import estimate_risk
from safevar_sumo.analysis.subject import answer_question, study_or_case
from safevar_sumo.analysis.tolerance import ToleranceOptions
from safevar_sumo.analysis.tolerance.compute import find_tolerances
from safevar_sumo.campaign.local import available_cores, local_pool
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import PUBLISHED_SCORING, Scoring
from safevar_sumo.plugins import file_by_name
from safevar_sumo.records import FloatArray, JsonObject
from safevar_sumo.reference.rows import read_reference
from safevar_sumo.report.dossier import dossier_page, make_dossier
from safevar_sumo.report.measurements import check_study, validate_with
from safevar_sumo.report.pack import Description, PackedAnswer, PackedStudy, describe
from safevar_sumo.results import MANIFEST, SOLUTIONS, evaluations_frame, read_manifest
from safevar_sumo.results.journal import files_read_later
from safevar_sumo.study import Origin, Study, convert_table, write_study
from safevar_sumo.sumo.network import OPTIONS_FILE, is_shipped, open_network, options_of
from safevar_sumo.sumo.system import assemble
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
STUDY, SETTINGS, CHECKS, DOSSIER = "study.toml", "settings.csv", "checks.json", "dossier"
ANSWERS, CODE, REFERENCES, VALIDATIONS = "answers", "code", "references", "validations"
"""Files and folders of a study in a pack."""
PLACE = "place"
"""Column of `settings.csv`: the answer that names a setting, and where in its JSON."""
TEXT_COLUMNS = ("algorithm", "outcome", PLACE)
WHOLE_COLUMNS = ("run", "f_num_diff")


class Subject(NamedTuple):
    """A study with its results, as a pack holds them: the manifest and the case, whose solutions were read as CSV."""

    manifest: JsonObject
    case: Case

    @property
    def study(self) -> Study:
        return self.case.study

    def answer(self, options: Options, pool: Pool, progress: Progress) -> str:
        """The JSON of an answer, with the bytes that its command prints."""
        _, compute = QUESTIONS[options.question]
        answer = answer_question(compute, self.case, options, pool=pool, progress=progress)
        return json.dumps(answer.to_dict(), indent=2, allow_nan=False) + "\n"

    def checks(self, pool: Pool, progress: Progress) -> bytes:
        """The JSON of `check_study` on the solutions."""
        settings = self.case.solutions[list(self.case.characteristics.names)].to_numpy(float)
        return json_bytes(check_study(self.study, settings, pool, progress))

    def validation(self, reference: Path, pool: Pool, progress: Progress) -> bytes:
        """The JSON of `validate_with`."""
        return json_bytes(validate_with(self.study, reference, pool, progress))

    def evaluated(self, settings: FloatArray, pool: Pool, progress: Progress, stage: str) -> pd.DataFrame:
        """Settings, shape (M, n), as rows of `solutions.csv` without algorithm and run."""
        evaluations = Evaluator(self.study, pool, progress).evaluate(settings, stage, ignore_constraints=True)
        return evaluations_frame(self.case.characteristics.names, [(("", 0), evaluations)]).drop(
            columns=["algorithm", "run"]
        )


def subject_of(
    manifest: JsonObject, solutions: bytes, runs: Sequence[tuple[str, int]], places: Sequence[str]
) -> Subject:
    """The subject that a manifest and a CSV table of solutions describe; `places` are the folders of user code.

    Raises
    ------
    InputError
        If one of them cannot be read.
    """
    study = convert_table(MANIFEST, manifest["study"], Study, "study")
    study = msgspec.structs.replace(study, origin=Origin(places=tuple(places)))
    scoring = msgspec.convert(manifest["scoring"], Scoring) if "scoring" in manifest else PUBLISHED_SCORING
    frame = read_table(solutions)
    return Subject(manifest, build_case(study, manifest["original"], frame, frame.iloc[:0], runs, scoring=scoring))


def read_table(content: bytes) -> pd.DataFrame:
    """Read a CSV table of settings to the last bit; raises ValueError or KeyError if a cell is no number."""
    frame = pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False)
    numbers = [name for name in frame if name not in TEXT_COLUMNS]
    frame = frame.replace({name: {"": "nan"} for name in numbers}).astype(dict.fromkeys(numbers, float))
    return frame.astype({name: int for name in WHOLE_COLUMNS if name in frame})


def json_bytes(value: JsonObject) -> bytes:
    return (json.dumps(value, indent=2, allow_nan=False) + "\n").encode()


def csv_of(frame: pd.DataFrame) -> bytes:
    return frame.to_csv(index=False, lineterminator="\n").encode()


def named_settings(answer: Any, characteristics: CharacteristicSet, path: str = "") -> Iterator[tuple[str, FloatArray]]:
    """The settings that an answer's JSON names as a whole or by their changes from the original, and their paths."""
    names = characteristics.names
    if isinstance(answer, list):
        for index, item in enumerate(answer):
            yield from named_settings(item, characteristics, f"{path}.{index}")
    elif isinstance(answer, dict):
        for key, value in answer.items():
            is_setting = isinstance(value, dict) and value and value.keys() <= set(names) and "outcome" in answer
            if is_setting and key in ("setting", "changes") and None not in value.values():
                original = dict(zip(names, characteristics.original.tolist(), strict=True))
                yield f"{path}.{key}", np.array([float({**original, **value}[name]) for name in names])
            else:
                yield from named_settings(value, characteristics, f"{path}.{key}")


class Maker:
    """Makes the content of a pack from results directories.

    Parameters
    ----------
    questions
        Names of `QUESTIONS` to be answered about each.
    references
        Files of published rows to validate each study with.
    digests_only
        Whether user code and files stay out of the pack.
    """

    def __init__(
        self,
        questions: Collection[str],
        references: Sequence[Path],
        digests_only: bool,
        jobs: int | None,
        progress: Progress,
    ) -> None:
        self._questions, self._references = [name for name in QUESTIONS if name in questions], references
        self._digests_only, self._jobs, self._progress = digests_only, jobs, progress
        self.files: dict[str, bytes] = {}

    def make(self, directories: Iterable[str | Path]) -> Description:
        """The description of a pack, whose files are then in `files`.

        Raises
        ------
        InputError
            If a directory holds no results of a study, or its inputs have changed since.
        """
        if len({path.stem for path in self._references}) < len(self._references):
            raise InputError("references", "two files have the same name", "files of different names")
        cases = []
        for directory in map(Path, directories):
            case = study_or_case(directory, results_only=True)
            assert isinstance(case, Case)
            if not case.has_runs:
                raise InputError(directory, "holds imported solutions, which have no identity", "results of `study`")
            for reference in self._references:
                read_reference(reference, case.characteristics)  # refuses a wrong file before the work begins
            cases.append((directory, case))
        studies = [self._pack(number, directory, case) for number, (directory, case) in enumerate(cases, 1)]
        return describe(studies, self._digests_only)

    def _pack(self, number: int, directory: Path, case: Case) -> PackedStudy:
        manifest, folder = read_manifest(directory), f"{number}-{case.study.name}"
        del manifest["folders"]  # of this machine
        solutions = csv_of(case.solutions)
        subject = subject_of(manifest, solutions, case.finished_runs, case.study.origin.places)
        code = (
            {}
            if self._digests_only
            else _files_of_user(subject.study, {**manifest["sources"], **files_read_later(directory)})
        )
        answers = list[PackedAnswer]()
        settings = dict[str, FloatArray]()
        with local_pool(self._jobs or available_cores(), subject.study.search.time_limit) as pool:
            for name in self._questions:
                options = QUESTIONS[name][0]()
                text = subject.answer(options, pool, self._progress)
                command = f"{options.command_line(f'results/{case.study.name}')} --json"
                answers.append(PackedAnswer(name, msgspec.to_builtins(options), command))
                self.files[f"{folder}/{ANSWERS}/{name}.json"] = text.encode()
                settings |= named_settings(json.loads(text), case.characteristics, name)
            if settings:
                frame = subject.evaluated(np.array([*settings.values()]), pool, self._progress, "named settings")
                self.files[f"{folder}/{SETTINGS}"] = csv_of(
                    pd.concat([pd.Series([*settings], name=PLACE), frame], axis=1)
                )
            checks = subject.checks(pool, self._progress)
            made = [subject.validation(path, pool, self._progress) for path in self._references]
        for path, validation in zip(self._references, made, strict=True):
            self.files[f"{folder}/{VALIDATIONS}/{path.stem}.json"] = validation
            if not self._digests_only:
                self.files[f"{folder}/{REFERENCES}/{path.name}"] = path.read_bytes()
        self.files |= {
            f"{folder}/{CHECKS}": checks,
            f"{folder}/{MANIFEST}": json_bytes(manifest),
            f"{folder}/{SOLUTIONS}": solutions,
            f"{folder}/{STUDY}": study_text(subject.study).encode(),
            **{f"{folder}/{CODE}/{name}": content for name, content in code.items()},
        }
        counts = {
            "solutions": len(case.solutions),
            "runs": len(case.finished_runs),
            "evaluations": len(case.evaluations),
            "collisions": int(are_collisions(case.evaluations).sum()),
        }
        packed = PackedStudy(folder, case.study.name, counts, answers, list(case.finished_runs), sorted(code))
        mine = {name.removeprefix(f"{folder}/"): text for name, text in self.files.items() if name.startswith(folder)}
        self.files |= {f"{folder}/{name}": text for name, text in dossier_of(subject, packed, mine).items()}
        return packed


def dossier_of(subject: Subject, packed: PackedStudy, files: Mapping[str, bytes]) -> dict[str, bytes]:
    """The dossier as JSON and as a page, from the other files of a study's folder."""
    dossier = make_dossier(
        subject.manifest,
        subject.study,
        packed.counts,
        {one.question: (one.command, json.loads(files[f"{ANSWERS}/{one.question}.json"])) for one in packed.answers},
        json.loads(files[CHECKS]),
        [json.loads(text) for name, text in sorted(files.items()) if name.startswith(f"{VALIDATIONS}/")],
    )
    return {f"{DOSSIER}.json": json_bytes(dossier), f"{DOSSIER}.html": dossier_page(dossier).encode()}


def study_text(study: Study) -> str:
    """A study file with all that the study extends."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"{study.name}.toml")
        write_study(path, study, "The study as it was run, with all that it extends.")
        return path.read_text(encoding="utf-8")


def _files_of_user(study: Study, sources: Iterable[str]) -> dict[str, bytes]:
    """The user's files that count in a study's identity, by the names that a pack gives them: code, files that code
    reads, and networks that are named relative to the study.
    """
    paths = {name: Path(path) for name in sources if (path := file_by_name(name, study.origin.places))}
    tests = [] if study.matrix is None else study.matrix.tests
    tables = [study.scenario.parameters, *(table for test in tests for table in (test.parameters, test.over))]
    texts = [text for table in tables for text in np.atleast_1d(table.get("network", [])).tolist()]
    located = {point.scenario.network for point in assemble(study, study.source).points}
    for text in map(PurePosixPath, {str(text) for text in texts}):
        place = next((path for path in located if Path(path).parts[-len(text.parts) :] == text.parts), "")
        if place and not is_shipped(str(text)) and not text.is_absolute() and ".." not in text.parts:
            network, folder = open_network(place), text if Path(place).is_dir() else text.parent
            view = options_of(network.path(OPTIONS_FILE)).get("gui-settings-file", "")  # SUMO does not start without it
            names = [*(name for name, _ in network.digests), *([view] if view else [])]
            paths |= {str(folder / name): network.folder / name for name in names}
    return {name: path.read_bytes() for name, path in sorted(paths.items())}
