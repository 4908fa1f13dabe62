"""The claims of an evidence pack about a study, and the functions that compute each claim again."""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import zip_longest
from pathlib import Path
from shlex import join, split
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pandas as pd

from safevar_sumo.api.evaluation import evaluate_with_workers
from safevar_sumo.api.running import run
from safevar_sumo.campaign import all_runs
from safevar_sumo.campaign.inputs import PLATFORM
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.errors import InputError, SafevarError, about
from safevar_sumo.metrics import PUBLISHED_SCORING, Unsafe
from safevar_sumo.output import temporary_folder
from safevar_sumo.plugins import add_import_folders
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.ask import SIMULATIONS, Question
from safevar_sumo.questions.by_criterion import cases_by
from safevar_sumo.questions.case import Results, build_case
from safevar_sumo.questions.options import flag_of
from safevar_sumo.questions.subject import changes_since
from safevar_sumo.questions.tables import shipped_columns
from safevar_sumo.questions.words import number_of
from safevar_sumo.records import JsonObject, Outcome, csv_text
from safevar_sumo.report.budget import REPLAYS
from safevar_sumo.report.pack import (
    DESCRIPTION,
    PACK,
    PackedManifest,
    PackedStudy,
    json_of,
)
from safevar_sumo.report.page import make_page, usual_questions
from safevar_sumo.report.sections import ReportedStudy
from safevar_sumo.report.sheet import with_answers
from safevar_sumo.report.texts import answer_about, completed, parse_question
from safevar_sumo.results import (
    MANIFEST,
    NO_RUN,
    SOLUTIONS,
    RunName,
    changed_values,
    evaluations_frame,
    in_order,
    manifest_of,
    record,
)
from safevar_sumo.study import (
    PYMOO,
    Origin,
    Study,
    convert_table,
    tables_of,
    user_code_names,
    write_study,
)
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import Parts, Progress

# Files of a study in a pack beside manifest and solutions, and the folder of the user's files.
STUDY = "study.toml"
ANSWERS = "answers.json"
PAGE = "report.html"
CODE = "code"
FILES = {MANIFEST, SOLUTIONS, STUDY, ANSWERS, PAGE}
LISTS = "lists"
"""The folder of the lists of cars in a pack."""
CARS = "cars"
"""The option of a question that names a list of cars."""
SAME = "same"
DIFFERS = "differs"
CANNOT = "cannot be run"
UNCHECKED = "unchecked"
VERDICTS = SAME, DIFFERS, CANNOT, UNCHECKED
MAX_ASKED = 1_000_000
"""Largest sum of all numbers, such as numbers of vehicles, that the questions of a study state."""
MALFORMED = (
    LookupError,
    ValueError,
    TypeError,
    AttributeError,
    RecursionError,
    csv.Error,
    msgspec.MsgspecError,
)
"""The errors that reading a damaged file may raise."""
SURPLUS = 10
"""A pack that claims more than this multiple of the evaluations that its runs may have is damaged.
"""
SHOWN = 200
"""Largest number of characters of a line that a report shows."""
CONTEXT = 40
"""Number of characters that are shown before the first character that differs."""


WHOLE_NUMBER = re.compile(r"[+-]?\d[\d_]*")
CLAIMS = shipped_columns("verify")["claims"]


class Claim(NamedTuple):
    """A claim of a pack: its name, the claimed content, and the function that computes the content
    again; None if the user has not asked for this computation.
    """

    name: str
    packed: bytes
    compute: Callable[[], bytes] | None


class ClaimVerdict(NamedTuple):
    """The verdict on a claim, a row of the table `CLAIMS`. If the content here differs from the
    claimed content, `packed` and `here` have the first line that differs.
    """

    study: str
    claim: str
    verdict: str
    packed: str = ""
    here: str = ""


class Recomputed(NamedTuple):
    """The contents of two claims, computed together: about outcomes, and the table of solutions."""

    outcomes: bytes
    solutions: bytes


class Packed:
    """A study in a pack: all claims follow from its description, manifest, solutions and code.

    The user's code, in the folders `places`, does not run before the first answer or simulation.
    """

    def __init__(
        self,
        packed: PackedStudy,
        files: dict[str, bytes],
        places: Sequence[str],
        jobs: int | None,
        progress: Progress,
        pool: Pool | None = None,
    ) -> None:
        self.packed = packed
        self.files = files
        self._places = places
        self._jobs = jobs
        self.pool = pool
        self._progress = progress
        self.manifest: JsonObject = json_of(files[MANIFEST])
        with about(MANIFEST):
            manifest = convert_table(self.manifest, PackedManifest)
        study = manifest.study
        for key, _, _ in changed_values(
            self.manifest["study"], tables_of(study), "study"
        ):
            raise ValueError(
                f"{MANIFEST}: {key} is not as the command `study` writes it"
            )
        study = msgspec.structs.replace(study, origin=Origin(places=tuple(places)))
        self._check_claims(study)
        solutions = read_table(files[SOLUTIONS])
        self._check_solutions(study, solutions)
        outcomes = packed.outcomes
        numbers = np.arange(len(outcomes), dtype=np.int8)
        codes = np.repeat(numbers, list(outcomes.values()))
        column = pd.Categorical.from_codes(codes, pd.Index(list(outcomes)))
        evaluations = pd.DataFrame({"outcome": column})
        self.case = build_case(
            study,
            self.manifest["original"],
            solutions,
            evaluations,
            packed.runs,
            scoring=manifest.scoring or PUBLISHED_SCORING,
        )
        self._directory = Path("results", study.name)
        self._answers: dict[str, Answer] = {}

    def _check_claims(self, study: Study) -> None:
        """Refuse claims that no intact pack has, before anything is computed."""
        outcomes = self.packed.outcomes
        runs = self.packed.runs
        unknown = outcomes.keys() - set(Outcome)
        if unknown:
            raise ValueError(f"there is no outcome {min(unknown)!r}")
        if not set(runs) <= set(all_runs(study)) or len(runs) > len({*runs}):
            raise ValueError(f"the study has no such runs: {runs[:3]}")
        total = sum(outcomes.values())
        if total > SURPLUS * len(runs) * study.search.evaluations:
            raise ValueError(
                f"{total:,} evaluations are far more than {number_of(len(runs), 'run')} may have"
            )

        # A question must neither write a file nor take for ever.
        words = split(" ".join(self.packed.questions).replace("=", " "))
        numbers = [int(word) for word in words if WHOLE_NUMBER.fullmatch(word.strip())]
        total = sum(
            abs(number) for number in [*numbers, *self.packed.simulations.values()]
        )
        if total > MAX_ASKED:
            raise InputError(
                "ask",
                f"its questions ask for {total:,} vehicles and simulations",
                f"at most {MAX_ASKED:,} in a pack",
            )
        for text in self.packed.questions:
            if "--out" in split(text):
                raise InputError(
                    "ask", f"{text!r} writes a file", "a question without --out"
                )
        lists = [list_in(question) for question in self.packed.questions]
        list_names = [name for name in lists if name]
        packed = [name for name in self.files if name.startswith(f"{LISTS}/")]
        if sorted(list_names) != sorted(packed):
            raise ValueError(
                f"{LISTS}: {packed or 'nothing'} instead of {list_names or 'nothing'}"
            )

    def _check_solutions(self, study: Study, solutions: pd.DataFrame) -> None:
        """Refuse a table of solutions with missing, unknown or repeated columns, or whose numbers
        of rows contradict the description of the pack.
        """
        columns = {"algorithm", "run", *study.domains, *self.manifest["original"]}
        expected = columns - {"collision", "collision_speed"}
        # If two columns are called x, pandas calls the second one "x.1".
        wrong = expected ^ {*solutions}
        if wrong:
            raise ValueError(
                f"{SOLUTIONS}: the column {min(wrong)} is missing, new or there twice"
            )
        if count_solutions(solutions, self.packed.runs) != self.packed.solutions:
            raise ValueError(f"{SOLUTIONS} has other rows than {DESCRIPTION} says")
        different = solutions.drop_duplicates(["algorithm", "run", *study.domains])
        for outcome, count in different["outcome"].value_counts().items():
            stated = self.packed.outcomes.get(str(outcome), 0)
            if count > stated:
                raise ValueError(
                    f"{count} solutions of {stated} simulations have {outcome}"
                )

    @cached_property
    def judged_case(self) -> Results:
        """The results by the criterion of the pack. Raises an InputError if the manifest states
        another scoring than that of the study.
        """
        if self.case.scoring != assemble(self.case.study).measuring.scoring:
            raise InputError(MANIFEST, "scoring is not that of the study", PACK)
        (case,) = cases_by([self.case], self.unsafe, self._jobs, self._progress)
        return case

    @property
    def unsafe(self) -> Unsafe | None:
        """The criterion for unsafe that the pack states; None if it states none."""
        return None if self.packed.unsafe is None else Unsafe.parse(self.packed.unsafe)

    def answer(
        self, text: str, parsed: tuple[Question, JsonObject] | None = None
    ) -> Answer:
        """The answer to a question of the pack, given by its text. `parsed` is a question that no
        text states; then `text` is only its name.
        """
        if text in self._answers:
            return self._answers[text]
        add_import_folders(self._places)
        judged = self.judged_case
        question, values = parsed or parse_question(text)
        part = self.packed.simulations.get(text)
        values = completed(question, values, self.unsafe, part, quick=False)
        case = judged if values.get("unsafe") == self.unsafe else self.case
        with temporary_folder() as folder:
            name = values.get(CARS)
            if name:
                path = Path(folder, name)
                path.parent.mkdir()
                path.write_bytes(self.files[name])
                values[CARS] = str(path)
            answer = answer_about(
                question,
                values,
                [case],
                [self._directory],
                None,
                self._jobs,
                self._progress,
                is_asked=text in {*self.packed.questions} - {*usual_questions(judged)},
                pool=self.pool,
                questions=len(self.packed.questions) + 1,
            )
        command = answer.command.replace(f"{folder}/", "")
        self._answers[text] = replace(answer, command=command)
        return self._answers[text]

    def simulations(self) -> dict[str, int]:
        """The largest numbers of simulations of questions whose text does not state this number."""
        flag = f" {SIMULATIONS.flag} "
        return self.packed.simulations | {
            text: int(answer.command.rpartition(flag)[2])
            for text, answer in self._answers.items()
            if flag in answer.command and flag not in f" {text} "
        }

    def _answer_json(self, text: str) -> bytes:
        return json_bytes(packed_answer(self.answer(text)))

    def ask_speed(self) -> ReportedStudy:
        """The study with the answers of its page, and the answer about its greatest speed."""
        study = ReportedStudy(
            directory=self._directory,
            case=self.judged_case,
            versions=self.manifest["versions"],
            simulations=self.packed.simulations.get(REPLAYS),
        )
        return with_answers(study, self.packed.questions, self.answer)

    def page(self) -> bytes:
        return make_page([self.ask_speed()], Parts(self._progress)).encode()

    def study_file(self) -> bytes:
        """The content of a study file, in which the studies that the study extends are included."""
        with temporary_folder() as folder:
            path = Path(folder, f"{self.case.study.name}.toml")
            write_study(
                path,
                self.case.study,
                "The study as it was run, with all that it extends.",
            )
            # The first line is left out, because it has the path of the schema on this machine.
            return path.read_bytes().partition(b"\n")[2]

    @cached_property
    def simulated(self) -> Recomputed:
        """The evaluation of the original vehicle, and the table of solutions, simulated again."""
        names = self.case.characteristics.names
        settings = self.case.settings
        evaluations = evaluate_with_workers(
            self.case.study, settings, jobs=self._jobs, progress=self._progress
        )
        frame = evaluations_frame(
            names, [(NO_RUN, evaluations.take(range(1, len(settings))))]
        )
        runs = self.case.solutions[["algorithm", "run"]]
        frame[["algorithm", "run"]] = runs.to_numpy()
        return Recomputed(
            json_bytes(record(evaluations)), csv_of(in_order(frame, names))
        )

    @cached_property
    def searched(self) -> Recomputed:
        """Numbers of evaluations by outcome, and the table of solutions, of the same runs again."""
        with temporary_folder() as folder:
            results = run(
                self.case.study,
                Path(folder, "results"),
                jobs=self._jobs,
                progress=self._progress,
                only=self.packed.runs,
            )
            return Recomputed(
                json_bytes(count_outcomes(results)), csv_of(results.solutions)
            )

    @property
    def versions(self) -> tuple[JsonObject, JsonObject]:
        """Versions and platform with which the search was run, and those of this machine."""
        manifest = self.manifest
        packed = {"versions": manifest["versions"], "platform": manifest["platform"]}
        versions = manifest_of(self.case.study, {})["versions"]
        return packed, {"versions": versions, "platform": PLATFORM}

    def claims(self, folder: Path, search: bool) -> Iterator[Claim]:
        """Yield the claims of the pack about this study. The search is repeated only if `search` is
        true. The manifest is in `folder`.
        """
        solutions = self.files[SOLUTIONS]
        yield Claim(
            "inputs",
            b"",
            lambda: "; ".join(
                changes_since(folder, self.case, as_it_is_now=True)
            ).encode(),
        )
        yield Claim("study", self.files[STUDY], self.study_file)
        yield Claim(
            "original vehicle",
            json_bytes(self.manifest["original"]),
            lambda: self.simulated.outcomes,
        )
        yield Claim("solutions", solutions, lambda: self.simulated.solutions)
        for text, answer in zip(
            self.packed.questions, json_of(self.files[ANSWERS]), strict=True
        ):
            yield Claim(
                f"answer {text}", json_bytes(answer), partial(self._answer_json, text)
            )
        yield Claim("report", self.files[PAGE], self.page)

        outcomes = Claim("search: outcomes", json_bytes(self.packed.outcomes), None)
        if not search:
            yield outcomes
            return
        yield outcomes._replace(compute=lambda: self.searched.outcomes)
        yield Claim("search: solutions", solutions, lambda: self.searched.solutions)

    @property
    def code(self) -> list[str]:
        """The names of user code that would run: files of the pack, and code that the study or its
        questions name.

        Networks count, because SUMO's options may name files to write. Files .csv do not count.
        """
        study = self.case.study
        prefix = f"{CODE}/"
        files = [
            name.removeprefix(prefix)
            for name in self.files
            if name.startswith(prefix) and not name.endswith(".csv")
        ]
        code_names = [
            name
            for name in (*study.search.algorithms, *self.packed.questions)
            if ":" in name.partition(" ")[0] and not name.startswith(PYMOO)
        ]
        return [*files, *user_code_names(study), *code_names]


def list_in(text: str) -> str:
    """The path of the list of cars that a question names; "" if it names none."""
    words = split(text)
    if flag_of(CARS) in words:
        return words[words.index(flag_of(CARS)) + 1]
    return ""


def with_list(text: str, path: str) -> str:
    """The text of a question about a list of cars, with `path` in place of the list's path."""
    words = split(text)
    words[words.index(flag_of(CARS)) + 1] = path
    return join(words)


def read_table(content: bytes) -> pd.DataFrame:
    """Read a table of solutions; numbers keep their last bit. Raises a ValueError or KeyError if a
    cell is no number, or a column is missing.
    """
    frame = pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False)
    numbers = frame.columns.difference(["algorithm", "outcome"], sort=False)
    frame[numbers] = frame[numbers].replace("", "nan").astype(float)
    return frame.astype({"run": int, "f_num_diff": int})


def packed_answer(answer: Answer) -> JsonObject:
    """The record of an answer in a pack: the values of the answer, and its command."""
    return {"command": answer.command, **answer.to_dict()}


def json_bytes(value: Any) -> bytes:
    return (json.dumps(value, indent=2, allow_nan=False) + "\n").encode()


def csv_of(frame: pd.DataFrame) -> bytes:
    return csv_text(frame).encode()


def count_outcomes(case: Results) -> dict[str, int]:
    """The number of evaluations of all finished runs, by outcome."""
    runs = pd.MultiIndex.from_frame(case.evaluations[["algorithm", "run"]])
    outcomes = case.evaluations["outcome"][runs.isin(case.finished)]
    counts: dict[Any, int] = outcomes.value_counts().sort_index().to_dict()
    return counts


def count_solutions(solutions: pd.DataFrame, runs: Sequence[RunName]) -> list[int]:
    """Numbers of solutions: of each run, of all runs, and of different solutions (a run may return
    a setting twice).
    """
    counts = Counter(zip(solutions["algorithm"], solutions["run"], strict=True))
    distinct = solutions.drop_duplicates()
    return [*(counts[run] for run in runs), len(solutions), len(distinct)]


def compare_claim(study: str, claim: Claim) -> ClaimVerdict:
    """Compute a claim about a study again and compare it."""
    if claim.compute is None:
        remark = "--search repeats the search"
        return ClaimVerdict(study, claim.name, UNCHECKED, here=remark)
    try:
        computed = claim.compute()
    except SafevarError as error:
        reason = " ".join(str(error).split())
        return ClaimVerdict(study, claim.name, CANNOT, here=reason)
    if claim.packed == computed:
        return ClaimVerdict(study, claim.name, SAME)

    packed_lines = [*claim.packed.decode().splitlines(keepends=True), "nothing"]
    lines = [*computed.decode().splitlines(keepends=True), "nothing"]
    number = _first_difference(packed_lines, lines)
    packed_line = _shown(packed_lines[number], lines[number])
    line = _shown(lines[number], packed_lines[number])
    # Lines may be long: only the text around the first character that differs is shown.
    start = 0
    if max(len(packed_line), len(line)) > SHOWN:
        start = max(_first_difference(packed_line, line) - CONTEXT, 0)
    part = slice(start, start + SHOWN)
    return ClaimVerdict(study, claim.name, DIFFERS, packed_line[part], line[part])


def _first_difference(sequence: Sequence[str], counterpart: Sequence[str]) -> int:
    """The index of the first elements in which two sequences differ."""
    pairs = enumerate(zip_longest(sequence, counterpart))
    return next(index for index, (item, other) in pairs if item != other)


def _shown(line: str, counterpart: str) -> str:
    """A line without spaces around it; the quoted line if both lines differ only in spaces."""
    if line.strip() in ("", counterpart.strip()):
        return repr(line)
    return line.strip()
