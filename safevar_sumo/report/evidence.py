"""Evidence that anybody can compute again: `make_pack` packs results with their page and answers; `verify` computes
everything anew from the pack alone, in a fresh folder, and compares.
"""

from __future__ import annotations

import csv
import io
import json
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cached_property, partial
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pandas as pd

from safevar_sumo.api.evaluation import evaluate_settings
from safevar_sumo.api.running import run
from safevar_sumo.errors import InputError, SafevarError, describe_error
from safevar_sumo.metrics import PUBLISHED_SCORING, Scoring
from safevar_sumo.plugins import file_by_name, is_shipped
from safevar_sumo.questions.case import Case, build_case
from safevar_sumo.questions.subject import changes_since, study_or_case
from safevar_sumo.records import JsonObject
from safevar_sumo.report.input import ReportInput
from safevar_sumo.report.pack import DESCRIPTION, PACK, PackedStudy, Question, read_pack
from safevar_sumo.report.page import make_page
from safevar_sumo.results import MANIFEST, SOLUTIONS, evaluations_frame, read_manifest, record
from safevar_sumo.study import Origin, Study, convert_table, user_code_names, write_study
from safevar_sumo.sumo.network import OPTIONS_FILE, options_of
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import Progress, show_no_progress

STUDY, ANSWERS, PAGE, CODE = "study.toml", "answers.json", "report.html", "code"
"""Files of a study in a pack beside manifest and solutions, and the folder of its user's files."""
FILES = {MANIFEST, SOLUTIONS, STUDY, ANSWERS, PAGE}
SECTIONS_WITHOUT_QUESTION = ("tested", "trust", "reproduce")
SECTIONS_OF_QUESTION: Mapping[Question, tuple[str, ...]] = {
    "explain": ("verdict", "causes"),
    "tolerance": ("tolerance",),
    "risk": ("risk",),
    "repair": ("repair",),
    "rating": (),
}
"""The sections of the page that show an answer of the pack; the page of a rated study shows its rating alone."""
SAME, DIFFERS, CANNOT = "same", "differs", "cannot be run"
CONTEXT, SHOWN = 40, 200
"""Characters of a long value that are shown before the first one that differs, and in all."""


class Claim(NamedTuple):
    """A claim of a pack: its study and name, whether it is the same here, and both values if it is not."""

    study: str
    claim: str
    verdict: str
    packed: str = ""
    here: str = ""


class Packed:
    """A study of a pack: everything follows from its description, manifest, solutions and code.

    The user's code is in the folders `places`, and runs from the first use of `data` on.
    """

    def __init__(self, packed: PackedStudy, files: dict[str, bytes], places: Iterable[str], jobs: int | None) -> None:
        self.packed, self.files, self._jobs, self.progress = packed, files, jobs, show_no_progress
        self.manifest: JsonObject = json.loads(files[MANIFEST])
        study = convert_table(MANIFEST, self.manifest["study"], Study, "study")
        study = msgspec.structs.replace(study, origin=Origin(places=tuple(places)))
        scoring = msgspec.convert(self.manifest["scoring"], Scoring) if "scoring" in self.manifest else None
        solutions, outcomes = read_table(files[SOLUTIONS]), packed.outcomes
        evaluations = pd.DataFrame({"outcome": np.repeat(list(outcomes), list(outcomes.values()))})
        original, scoring = self.manifest["original"], scoring or PUBLISHED_SCORING
        self.case = build_case(study, original, solutions, evaluations, packed.runs, scoring=scoring)
        self._answers: dict[str, Any] = {}

    @cached_property
    def data(self) -> ReportInput:
        study = self.case.study
        return ReportInput(
            study_number=1,
            directory=Path("results", study.name),
            case=self.case,
            system=assemble(study, study.source),
            versions=self.manifest["versions"],
        )

    def answer(self, question: str) -> bytes:
        """The command of a question and its answer's JSON."""
        if question not in self._answers:
            self._answers[question] = self.data.ask(question, self._jobs, self.progress)
        command = f"{self.data.command(question)} --json"
        return json_bytes({"command": command, "answer": self._answers[question].to_dict()})

    def answers(self) -> bytes:
        return json_bytes({question: json.loads(self.answer(question)) for question in self.packed.questions})

    def page(self) -> bytes:
        """The page of the answers; that of a rated study has its rating."""
        for question in [*self.packed.questions, *(["rating"] if self.data.is_rated else [])]:
            self.answer(question)
        shown = chain.from_iterable(SECTIONS_OF_QUESTION[question] for question in self.packed.questions)
        sections = [*SECTIONS_WITHOUT_QUESTION, *shown]
        return make_page([self.data], sections, [self._answers], self.progress).encode()

    def study_file(self) -> bytes:
        """A study file with all that the study extends."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"{self.case.study.name}.toml")
            write_study(path, self.case.study, "The study as it was run, with all that it extends.")
            return path.read_bytes().partition(b"\n")[2]  # without the path of the schema on this machine

    @cached_property
    def simulated(self) -> tuple[bytes, bytes]:
        """The original vehicle's evaluation, and the table of solutions, all simulated again."""
        characteristics, solutions = self.case.characteristics, self.case.solutions
        settings = np.vstack([characteristics.original, solutions[list(characteristics.names)].to_numpy(float)])
        evaluations = evaluate_settings(self.case.study, settings, jobs=self._jobs, progress=self.progress)
        frame = evaluations_frame(characteristics.names, [(("", 0), evaluations.take(range(1, len(settings))))])
        frame[["algorithm", "run"]] = solutions[["algorithm", "run"]].to_numpy()
        return json_bytes(record(evaluations, row=0)), rows_of(csv_of(frame))

    @cached_property
    def searched(self) -> tuple[bytes, bytes]:
        """The outcomes of all evaluations, and the table of solutions, of the same runs again."""
        with tempfile.TemporaryDirectory() as folder:
            study, runs = self.case.study, self.packed.runs
            results = run(study, Path(folder, "results"), jobs=self._jobs, progress=self.progress, only=runs)
            return json_bytes(count_outcomes(results.case)), rows_of(csv_of(results.solutions))

    def checks(self, folder: Path, search: bool) -> dict[str, tuple[bytes, Callable[[], bytes]]]:
        """What the pack claims, and the functions that compute it again, by name; the manifest is in `folder`."""
        answers, solutions = json.loads(self.files[ANSWERS]), rows_of(self.files[SOLUTIONS])
        checks: dict[str, tuple[bytes, Callable[[], bytes]]] = {
            "inputs": (b"", lambda: "; ".join(changes_since(folder, self.case, as_it_is_now=True)).encode()),
            "study": (self.files[STUDY], self.study_file),
            "original vehicle": (json_bytes(self.manifest["original"]), lambda: self.simulated[0]),
            "solutions": (solutions, lambda: self.simulated[1]),
        }
        for question in self.packed.questions:
            checks[f"answer {question}"] = json_bytes(answers[question]), partial(self.answer, question)
        checks["report"] = self.files[PAGE], self.page
        if search:
            checks["search: outcomes"] = json_bytes(self.packed.outcomes), lambda: self.searched[0]
            checks["search: solutions"] = solutions, lambda: self.searched[1]
        return checks

    @property
    def code(self) -> list[str]:
        """The user code that simulations would run: files of the pack, and what the study names.

        Networks count, since SUMO's options beside them may name files to write.
        """
        study, prefix = self.case.study, f"{CODE}/"
        files = [name.removeprefix(prefix) for name in self.files if name.startswith(prefix)]
        return [*files, *user_code_names(study)]


def read_table(content: bytes) -> pd.DataFrame:
    """Read a table of solutions to the last bit; raises ValueError or KeyError if a cell is no number."""
    frame = pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False)
    numbers = [name for name in frame if name not in ("algorithm", "outcome")]
    frame = frame.replace({name: {"": "nan"} for name in numbers}).astype(dict.fromkeys(numbers, float))
    return frame.astype({"run": int, "f_num_diff": int})


def json_bytes(value: Any) -> bytes:
    return (json.dumps(value, indent=2, allow_nan=False) + "\n").encode()


def csv_of(frame: pd.DataFrame) -> bytes:
    return frame.to_csv(index=False, lineterminator="\n").encode()


def rows_of(table: bytes) -> bytes:
    """The rows of a CSV table as JSON."""
    return json_bytes(list(csv.DictReader(io.StringIO(table.decode()))))


def count_outcomes(case: Case) -> dict[str, int]:
    """The number of evaluations of all finished runs, by outcome."""
    runs = pd.MultiIndex.from_frame(case.evaluations[["algorithm", "run"]])
    outcomes = case.evaluations["outcome"][runs.isin(case.finished_runs)]
    return {str(outcome): int(count) for outcome, count in outcomes.value_counts(sort=False).sort_index().items()}


def make_pack(
    directories: Iterable[str | Path],
    questions: Collection[str],
    jobs: int | None = None,
    progress: Progress = show_no_progress,
) -> tuple[list[PackedStudy], dict[str, bytes]]:
    """The description of each study in a pack, and the pack's files.

    Parameters
    ----------
    questions
        Names of `SECTIONS_OF_QUESTION` to be answered about each study.

    Raises
    ------
    InputError
        If a directory holds no results of a study, or its inputs have changed since.
    """
    cases = []
    for directory in dict.fromkeys(map(Path, directories)):
        case = study_or_case(directory, results_only=True)
        assert isinstance(case, Case)
        if not case.has_runs:
            raise InputError(directory, "holds imported solutions, which have no identity", "results of `study`")
        cases.append((directory, case))
    studies, files = [], dict[str, bytes]()
    for number, (directory, case) in enumerate(cases, 1):
        study, manifest = case.study, read_manifest(directory)
        manifest.pop("folders", None)  # of this machine
        asked = [question for question in SECTIONS_OF_QUESTION if question in questions]
        described = PackedStudy(f"{number}-{study.name}", asked, list(case.finished_runs), count_outcomes(case))
        own_files = {
            MANIFEST: json_bytes(manifest),
            SOLUTIONS: csv_of(case.solutions),
            **_files_of_user(study, directory),
        }
        packed = Packed(described, own_files, study.origin.places, jobs)
        packed.progress = partial(_show_within, progress, study.name)
        own_files |= {STUDY: packed.study_file(), ANSWERS: packed.answers(), PAGE: packed.page()}
        studies.append(described)
        files |= {f"{described.folder}/{name}": content for name, content in own_files.items()}
    return studies, files


def _show_within(progress: Progress, whole: str, stage: str, done: int, total: int) -> None:
    progress(f"{whole}: {stage}", done, total)


def _files_of_user(study: Study, directory: Path) -> dict[str, bytes]:
    """The user's files that count in the identity of results, by their names in a pack, and the views of networks,
    without which SUMO does not start.
    """
    places = study.origin.places
    names = [name for name in read_manifest(directory)["files"] if not (Path(name).is_absolute() or is_shipped(name))]
    for name in [name for name in names if Path(name).name == OPTIONS_FILE]:
        view = options_of(Path(file_by_name(name, places))).get("gui-settings-file", "")
        names += [str(Path(name).with_name(view))] if view else []
    paths = {name: file_by_name(name, places) for name in names}
    return {f"{CODE}/{name}": Path(path).read_bytes() for name, path in sorted(paths.items()) if path}


def verify(
    path: Path,
    *,
    search: bool = False,
    run_code: bool = False,
    jobs: int | None = None,
    progress: Progress = show_no_progress,
) -> list[Claim]:
    """Compute what a pack claims again, and compare.

    Parameters
    ----------
    path
        The pack.
    search
        Whether to repeat the whole search, too.
    run_code
        Whether user code in the pack, or named by its studies, may run.

    Raises
    ------
    InputError
        If the pack is damaged, of another version, or holds user code and `run_code` is false.
    """
    description, files = read_pack(path)
    claims = []
    with tempfile.TemporaryDirectory() as folder:
        studies = {
            Path(folder, str(number)): _unpack(path, described, files, Path(folder, str(number)), jobs)
            for number, described in enumerate(description.studies)
        }
        known = {f"{packed.packed.folder}/{name}" for packed in studies.values() for name in packed.files}
        if unknown := files.keys() - known:
            raise InputError(path, f"{min(unknown)} belongs to no study", PACK)
        if not run_code and (code := [name for packed in studies.values() for name in packed.code]):
            problem = f"`verify` would run code of the pack: {', '.join(code)}"
            raise InputError(path, problem, "`run_code=True`, if you trust it")
        for place, packed in studies.items():
            checks = packed.checks(place, search)
            for number, (name, (there, compute)) in enumerate(checks.items(), 1):
                packed.progress = partial(_show_within, progress, f"{number} of {len(checks)}, {name}")
                claims.append(_compare(packed.case.study.name, name, there, compute))
    return claims


def _unpack(path: Path, described: PackedStudy, files: Mapping[str, bytes], folder: Path, jobs: int | None) -> Packed:
    """One study of a pack; its manifest and the user's files are written to a folder.

    Raises
    ------
    InputError
        If it is damaged.
    """
    prefix = f"{described.folder}/"
    own_files = {name.removeprefix(prefix): content for name, content in files.items() if name.startswith(prefix)}
    code = {name: content for name, content in own_files.items() if name.startswith(f"{CODE}/")}
    try:
        if wrong := FILES ^ (own_files.keys() - code.keys()):
            raise ValueError(f"{min(wrong)} {'belongs to no claim' if min(wrong) in own_files else 'is missing'}")
        for name in (MANIFEST, *code):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(own_files[name])
        packed = Packed(described, own_files, [str(folder / CODE)] if code else [], jobs)
        if json.loads(own_files[ANSWERS]).keys() != set(described.questions):
            raise ValueError(f"{ANSWERS} answers other questions than {DESCRIPTION} names")
    except (
        AttributeError,
        LookupError,
        ValueError,
        TypeError,
        RecursionError,
        msgspec.MsgspecError,
        InputError,
    ) as error:
        raise InputError(path, f"{described.folder} is damaged: {describe_error(error)}", PACK) from None
    return packed


def _compare(study: str, claim: str, packed: bytes, compute: Callable[[], bytes]) -> Claim:
    """A claim, computed again; the values shown are those at the first difference."""
    try:
        here = compute()
    except SafevarError as error:
        return Claim(study, claim, CANNOT, here=" ".join(str(error).split()))
    if packed == here:
        return Claim(study, claim, SAME)
    pairs = zip_longest(_list_values(packed), _list_values(here), fillvalue="nothing")
    first, second = next((first, second) for first, second in pairs if first != second)
    same = next(index for index, pair in enumerate(zip_longest(first, second)) if len(set(pair)) > 1)
    start = max(same - CONTEXT, 0) if max(len(first), len(second)) > SHOWN else 0
    return Claim(study, claim, DIFFERS, first[start : start + SHOWN], second[start : start + SHOWN])


def _list_values(content: bytes) -> Iterator[str]:
    """Every value of a JSON file with its path, and every line of any text."""
    text = content.decode(errors="replace")
    with suppress(ValueError):
        yield from _values_of(json.loads(text), "")
    yield from text.splitlines(keepends=True)


def _values_of(value: Any, path: str) -> Iterator[str]:
    if not isinstance(value, dict | list):
        yield f"{path} = {value}"
        return
    for key, item in value.items() if isinstance(value, dict) else enumerate(value):
        yield from _values_of(item, f"{path}.{key}" if path else str(key))
