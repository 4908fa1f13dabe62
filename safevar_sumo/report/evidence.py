"""Evidence that anybody can compute again: `evidence` packs results with their page and answers; `verify` computes
everything anew from the pack alone, in a fresh folder, and compares.
"""

from __future__ import annotations

import csv
import io
import json
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from itertools import zip_longest
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from safevar_sumo.api.evaluation import evaluate_settings
from safevar_sumo.api.running import run
from safevar_sumo.errors import InputError, SafevarError, describe_error
from safevar_sumo.metrics import PUBLISHED_SCORING, Scoring
from safevar_sumo.output import check_writable
from safevar_sumo.plugins import code_files, file_by_name, is_shipped
from safevar_sumo.plugins.lookup import add_import_folders
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.ask import Jobs
from safevar_sumo.questions.case import Case, build_case
from safevar_sumo.questions.subject import changes_since, study_or_case
from safevar_sumo.questions.tables import Column, tabulate
from safevar_sumo.questions.words import number_of
from safevar_sumo.records import JsonObject
from safevar_sumo.report.pack import DESCRIPTION, PACK, PackedStudy, digest_of, read_pack, write_pack
from safevar_sumo.report.page import answer_to, make_page, usual_questions
from safevar_sumo.report.sections import ReportedStudy
from safevar_sumo.results import MANIFEST, SOLUTIONS, evaluations_frame, read_manifest, record
from safevar_sumo.study import Origin, Study, convert_table, user_code_names, write_study
from safevar_sumo.sumo.network import OPTIONS_FILE, options_of
from safevar_sumo.terminal import Progress, open_progress

STUDY, ANSWERS, PAGE, CODE = "study.toml", "answers.json", "report.html", "code"
"""Files of a study in a pack beside manifest and solutions, and the folder of its user's files."""
FILES = {MANIFEST, SOLUTIONS, STUDY, ANSWERS, PAGE}
SAME, DIFFERS, CANNOT = "same", "differs", "cannot be run"
MALFORMED = (LookupError, ValueError, TypeError, AttributeError, RecursionError, msgspec.MsgspecError)
"""What reading a damaged file raises."""
CONTEXT, SHOWN = 40, 200
"""Characters of a long line that are shown before the first one that differs, and in all."""


CLAIMS = {
    "study": Column("", "study of the pack"),
    "claim": Column("", "what the pack holds"),
    "verdict": Column("", f"{SAME}, {DIFFERS} or {CANNOT}"),
    "packed": Column("", "value in the pack, if it differs"),
    "here": Column("", "value here, or the reason why there is none"),
}
Claim = tuple[str, str, str, str, str]
"""A row of `CLAIMS`."""


class Packed:
    """A study of a pack: everything follows from its description, manifest, solutions and code.

    The user's code is in the folders `places`, and runs from the first answer or simulation on.
    """

    def __init__(
        self, packed: PackedStudy, files: dict[str, bytes], places: Sequence[str], jobs: int | None, progress: Progress
    ) -> None:
        self.packed, self.files, self._places, self._jobs, self._progress = packed, files, places, jobs, progress
        self.manifest: JsonObject = json.loads(files[MANIFEST])
        study = convert_table(MANIFEST, self.manifest["study"], Study, "study")
        study = msgspec.structs.replace(study, origin=Origin(places=tuple(places)))
        scoring = msgspec.convert(self.manifest["scoring"], Scoring) if "scoring" in self.manifest else None
        solutions, outcomes = read_table(files[SOLUTIONS]), packed.outcomes
        evaluations = pd.DataFrame({"outcome": np.repeat(list(outcomes), list(outcomes.values()))})
        original, scoring = self.manifest["original"], scoring or PUBLISHED_SCORING
        self.case = build_case(study, original, solutions, evaluations, packed.runs, scoring=scoring)
        self._directory = Path("results", study.name)
        self._answers: dict[str, Answer] = {}

    def answer(self, text: str) -> Answer:
        if text not in self._answers:
            add_import_folders(self._places)
            self._answers[text] = answer_to(text, [self.case], [self._directory], None, self._jobs, self._progress)
        return self._answers[text]

    def _answer_json(self, text: str) -> bytes:
        return json_bytes(packed_answer(self.answer(text)))

    def page(self) -> bytes:
        answers = [self.answer(text) for text in self.packed.questions]
        versions = self.manifest["versions"]
        study = ReportedStudy(directory=self._directory, case=self.case, versions=versions, answers=answers)
        return make_page([study], progress=self._progress).encode()

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
        evaluations = evaluate_settings(self.case.study, settings, jobs=self._jobs, progress=self._progress)
        frame = evaluations_frame(characteristics.names, [(("", 0), evaluations.take(range(1, len(settings))))])
        frame[["algorithm", "run"]] = solutions[["algorithm", "run"]].to_numpy()
        return json_bytes(record(evaluations, row=0)), rows_of(csv_of(frame))

    @cached_property
    def searched(self) -> tuple[bytes, bytes]:
        """The outcomes of all evaluations, and the table of solutions, of the same runs again."""
        with tempfile.TemporaryDirectory() as folder:
            study, runs = self.case.study, self.packed.runs
            results = run(study, Path(folder, "results"), jobs=self._jobs, progress=self._progress, only=runs)
            return json_bytes(count_outcomes(results.case)), rows_of(csv_of(results.solutions))

    def checks(self, folder: Path, search: bool) -> Iterator[tuple[str, bytes, Callable[[], bytes]]]:
        """What the pack claims, and the functions that compute it again; the manifest is in `folder`."""
        solutions = rows_of(self.files[SOLUTIONS])
        yield "inputs", b"", lambda: "; ".join(changes_since(folder, self.case, as_it_is_now=True)).encode()
        yield "study", self.files[STUDY], self.study_file
        yield "original vehicle", json_bytes(self.manifest["original"]), lambda: self.simulated[0]
        yield "solutions", solutions, lambda: self.simulated[1]
        for text, answer in zip(self.packed.questions, json.loads(self.files[ANSWERS]), strict=True):
            yield f"answer {text}", json_bytes(answer), partial(self._answer_json, text)
        yield "report", self.files[PAGE], self.page
        if search:
            yield "search: outcomes", json_bytes(self.packed.outcomes), lambda: self.searched[0]
            yield "search: solutions", solutions, lambda: self.searched[1]

    @property
    def code(self) -> list[str]:
        """The user code that would run: files of the pack, and what the study and the questions name.

        Networks count, since SUMO's options beside them may name files to write.
        """
        study, prefix = self.case.study, f"{CODE}/"
        files = [name.removeprefix(prefix) for name in self.files if name.startswith(prefix)]
        named = [name for name in (*study.search.algorithms, *self.packed.questions) if ":" in name.partition(" ")[0]]
        return [*files, *user_code_names(study), *named]


def read_table(content: bytes) -> pd.DataFrame:
    """Read a table of solutions to the last bit; raises ValueError or KeyError if a cell is no number."""
    frame = pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False)
    numbers = [name for name in frame if name not in ("algorithm", "outcome")]
    frame = frame.replace({name: {"": "nan"} for name in numbers}).astype(dict.fromkeys(numbers, float))
    return frame.astype({"run": int, "f_num_diff": int})


def packed_answer(answer: Answer) -> JsonObject:
    """An answer as a pack holds it: with its command."""
    return {"command": answer.command, **answer.to_dict()}


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


def evidence(
    *results: str | Path, out: Path, ask: tuple[str, ...] = (), jobs: Jobs = None, progress: bool | Progress = False
) -> str:
    """Pack results with their study, page and answers, so that anybody can compute every number again.

    Parameters
    ----------
    results
        Results, or their directories.
    out
        The pack to write.
    ask
        Ask this question instead of the usual ones, with its options, such as "risk --samples 4000"; may be repeated.
    jobs
        Number of worker processes, by default one for each core.
    progress
        True for a bar on the terminal, or a function of a stage, the number done in it, and its total.

    Returns
    -------
    str
        The pack's path, size and sha256.

    Raises
    ------
    InputError
        If a directory holds no results of a study, its inputs have changed since, or there is no such question.
    """
    out = Path(out)
    check_writable(out, "out", (".zip",))
    studies, files = [], dict[str, bytes]()
    with open_progress(progress) as show:
        for number, directory in enumerate(dict.fromkeys(map(Path, results)), 1):
            described, own_files = _pack_study(number, directory, ask, jobs, show)
            studies.append(described)
            files |= {f"{described.folder}/{name}": content for name, content in own_files.items()}
    write_pack(out, studies, files)
    return f"{out} ({out.stat().st_size / 1e6:.2f} MB, sha256 {digest_of(out)})"


def _pack_study(
    number: int, directory: Path, ask: Sequence[str], jobs: int | None, progress: Progress
) -> tuple[PackedStudy, dict[str, bytes]]:
    """The description of a study in a pack, and its files."""
    case = study_or_case(directory, results_only=True)
    assert isinstance(case, Case)
    if not case.has_runs:
        raise InputError(directory, "holds imported solutions, which have no identity", "results of `study`")
    study, manifest = case.study, read_manifest(directory)
    manifest.pop("folders", None)  # of this machine
    questions = list(dict.fromkeys(ask or usual_questions(case, directory)))
    described = PackedStudy(f"{number}-{study.name}", questions, list(case.finished_runs), count_outcomes(case))
    code = _files_of_user(study, manifest["files"], questions)
    files = {MANIFEST: json_bytes(manifest), SOLUTIONS: csv_of(case.solutions), **code}
    packed = Packed(described, files, study.origin.places, jobs, partial(_show_within, progress, study.name))
    answers = json_bytes([packed_answer(packed.answer(text)) for text in questions])
    return described, {**files, STUDY: packed.study_file(), ANSWERS: answers, PAGE: packed.page()}


def _show_within(progress: Progress, whole: str, stage: str, done: int, total: int) -> None:
    progress(f"{whole}: {stage}", done, total)


def _files_of_user(study: Study, named: Mapping[str, str], questions: Sequence[str]) -> dict[str, bytes]:
    """The user's files that the results depend on, the files of the user's questions, and the views of networks,
    without which SUMO does not start, by their names in a pack.
    """
    places = study.origin.places
    names = [name for name in named if not (Path(name).is_absolute() or is_shipped(name))]
    for name in [name for name in names if Path(name).name == OPTIONS_FILE]:
        view = options_of(Path(file_by_name(name, places))).get("gui-settings-file", "")
        names += [str(Path(name).with_name(view))] if view else []
    paths = {name: Path(found) for name in names if (found := file_by_name(name, places))}
    modules = [text.partition(":")[0] for text in questions if ":" in text.partition(" ")[0]]
    folders = [folder for folder in (*places, os.getcwd(), *sys.path) if folder]
    for path in code_files(modules, places):
        folder = max((folder for folder in folders if path.is_relative_to(folder)), key=len)
        paths[path.relative_to(folder).as_posix()] = path
    return {f"{CODE}/{name}": path.read_bytes() for name, path in sorted(paths.items())}


def verify(
    pack: str | Path,
    *,
    search: bool = False,
    run_code: bool = False,
    jobs: Jobs = None,
    progress: bool | Progress = False,
) -> Answer:
    """Compute what a pack of evidence claims again, and compare.

    The exit code is 0 if all is the same, 1 if not, 2 if the pack is damaged or of another version.

    Parameters
    ----------
    pack
        The pack.
    search
        Repeat the whole search, too.
    run_code
        Let user code run that is in the pack, or that its studies and questions name.
    jobs
        Number of worker processes, by default one for each core.
    progress
        True for a bar on the terminal, or a function of a stage, the number done in it, and its total.

    Raises
    ------
    InputError
        If the pack is damaged, of another version, or holds user code and `run_code` is false.
    """
    path = Path(pack)
    description, files = read_pack(path)
    claims = list[Claim]()
    with tempfile.TemporaryDirectory() as folder, open_progress(progress) as show:
        studies = {
            Path(folder, str(number)): _unpack(path, described, files, Path(folder, str(number)), jobs, show)
            for number, described in enumerate(description.studies)
        }
        known = {f"{packed.packed.folder}/{name}" for packed in studies.values() for name in packed.files}
        if unknown := files.keys() - known:
            raise InputError(path, f"{min(unknown)} belongs to no study", PACK)
        if not run_code and (code := [name for packed in studies.values() for name in packed.code]):
            problem = f"`verify` would run code of the pack: {', '.join(code)}"
            raise InputError(path, problem, "`run_code=True`, if you trust it")
        for place, packed in studies.items():
            for name, there, compute in packed.checks(place, search):
                claims.append(_compare(packed.case.study.name, name, there, compute))
    counts = Counter(verdict for _, _, verdict, _, _ in claims)
    return Answer(
        question="verify",
        study=next(iter(studies.values())).case.study,
        verdict=f"{counts[SAME]} of {number_of(len(claims), 'claim')} are the same, {counts[DIFFERS]} differ, "
        f"{counts[CANNOT]} cannot be run.",
        numbers={
            "passed": counts[SAME] == len(claims),
            "sha256": digest_of(path),
            "claims": len(claims),
            **{verdict.partition(" ")[0]: counts[verdict] for verdict in (SAME, DIFFERS, CANNOT)},
        },
        tables={"claims": tabulate("Claims", CLAIMS, claims)},
    )


def _unpack(
    path: Path, described: PackedStudy, files: Mapping[str, bytes], folder: Path, jobs: int | None, progress: Progress
) -> Packed:
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
        if len(json.loads(own_files[ANSWERS])) != len(described.questions):
            raise ValueError(f"{ANSWERS} answers other questions than {DESCRIPTION} names")
        return Packed(described, own_files, [str(folder / CODE)] if code else [], jobs, progress)
    except (*MALFORMED, InputError) as error:
        raise InputError(path, f"{described.folder} is damaged: {describe_error(error)}", PACK) from None


def _compare(study: str, claim: str, packed: bytes, compute: Callable[[], bytes]) -> Claim:
    """A claim, computed again; the lines shown are the first that differ."""
    try:
        here = compute()
    except SafevarError as error:
        return study, claim, CANNOT, "", " ".join(str(error).split())
    if packed == here:
        return study, claim, SAME, "", ""
    pairs = zip_longest(packed.decode().splitlines(), here.decode().splitlines(), fillvalue="nothing")
    first, second = next((first.strip(), second.strip()) for first, second in pairs if first != second)
    same = next(index for index, pair in enumerate(zip_longest(first, second)) if len(set(pair)) > 1)
    start = max(same - CONTEXT, 0) if max(len(first), len(second)) > SHOWN else 0
    return study, claim, DIFFERS, first[start : start + SHOWN], second[start : start + SHOWN]
