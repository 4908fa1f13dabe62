"""Makes every claim of a pack again, from the pack alone, and compares the bytes."""

from __future__ import annotations

import io
import json
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.api.running import carry_out_runs, open_observer
from safevar_sumo.campaign import all_runs
from safevar_sumo.campaign.identity import identity_of
from safevar_sumo.campaign.local import available_cores, local_pool
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.errors import InputError, SafevarError, describe_error
from safevar_sumo.plugins import digest_of
from safevar_sumo.records import JsonObject
from safevar_sumo.report.evidence import (
    ANSWERS,
    CHECKS,
    CODE,
    DOSSIER,
    PLACE,
    QUESTIONS,
    REFERENCES,
    SETTINGS,
    STUDY,
    VALIDATIONS,
    csv_of,
    dossier_of,
    json_bytes,
    named_settings,
    read_table,
    study_text,
    subject_of,
)
from safevar_sumo.report.pack import PACK, PackedStudy, read_pack
from safevar_sumo.results import MANIFEST, SOLUTIONS, handles_of, load_runs, manifest_of, record
from safevar_sumo.results.manifest import differences
from safevar_sumo.study import user_code_names
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import Progress, show_no_progress

SAME, DIFFERS, CANNOT = "same", "differs", "cannot be made here"
MAX_COLUMNS_NAMED = 3
"""Number of columns that a differing row names."""
SOLUTION, SETTING, ANSWER, VALIDATION = "solution ", "setting ", "answer ", "validation "
"""Beginnings of the names of claims."""


class Claim(NamedTuple):
    """A claim of a pack: its study and name, whether it is the same here, and both values if it is not."""

    study: str
    claim: str
    verdict: str
    packed: str = ""
    here: str = ""


@dataclass(frozen=True)
class Verification:
    """All claims that were made again."""

    claims: Sequence[Claim]

    def count(self, verdict: str) -> int:
        return Counter(claim.verdict for claim in self.claims)[verdict]

    def to_dict(self) -> JsonObject:
        """The JSON of `verify`."""
        return {
            "claims": len(self.claims),
            "same": self.count(SAME),
            "differs": self.count(DIFFERS),
            "cannot": self.count(CANNOT),
            "table": [claim._asdict() for claim in self.claims],
        }


def verify(
    path: Path,
    sample: int | None = None,
    *,
    search: bool = False,
    run_code: bool = False,
    jobs: int | None = None,
    progress: Progress = show_no_progress,
) -> Verification:
    """Make the claims of a pack again.

    Parameters
    ----------
    path
        The pack.
    sample
        Number of claims, drawn at random; by default all.
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
    folders = tuple(f"{packed.folder}/" for packed in description.studies)
    if not folders or (stray := [name for name in files if not name.startswith(folders)]):
        raise InputError(path, f"{stray[0]} belongs to no study" if folders else "holds no study", PACK)
    with ExitStack() as stack:
        parts = []
        for packed in description.studies:
            try:
                parts.append(_Part(path, packed, files))
            except (LookupError, ValueError, TypeError, RecursionError, InputError) as error:
                raise InputError(path, f"{packed.folder} is damaged: {describe_error(error)}", PACK) from None
        if not run_code and (code := [name for part in parts for name in part.code_in_words]):
            raise InputError(
                path, f"`verify` would run code of the pack: {', '.join(code)}", "`run_code=True`, if you trust it"
            )
        for part in parts:
            part.unpack_code(Path(stack.enter_context(tempfile.TemporaryDirectory())))
        names = [(part, name) for part in parts for name in part.names(search)]
        if sample is not None and sample < len(names):
            drawn = np.random.default_rng().choice(len(names), sample, replace=False)
            names = [names[index] for index in sorted(drawn.tolist())]
        claims = list[Claim]()
        for part in parts:
            chosen = [name for owner, name in names if owner is part]
            with local_pool(jobs or available_cores(), part.subject.study.search.time_limit) as pool:
                claims += part.claims(chosen, pool, progress)
    return Verification(claims)


class _Part:
    """One study of a pack."""

    def __init__(self, path: Path, packed: PackedStudy, files: Mapping[str, bytes]) -> None:
        self._path, self._packed = path, packed
        self._files = {
            name.removeprefix(f"{packed.folder}/"): content
            for name, content in files.items()
            if name.startswith(f"{packed.folder}/")
        }
        self._manifest = json.loads(self._files[MANIFEST])
        if json_bytes(self._manifest) != self._files[MANIFEST]:  # digits that no double has
            raise ValueError(f"{MANIFEST} was edited")
        self.subject = subject_of(self._manifest, self._files[SOLUTIONS], packed.runs, ())
        self._solutions = [str(handle) for handle in handles_of(self.subject.case.solutions)]
        self._settings = read_table(self._files[SETTINGS])[PLACE].tolist() if SETTINGS in self._files else []
        self._validations = {
            PurePosixPath(name).stem: name for name in sorted(self._files) if name.startswith(f"{VALIDATIONS}/")
        }
        dossier_of(self.subject, packed, self._files)  # has all that it needs
        for answer in packed.answers:
            QUESTIONS[answer.question][0](**answer.options)
            self._files[f"{ANSWERS}/{answer.question}.json"]
        for name in packed.code:
            self._files[f"{CODE}/{name}"]
        for file in (SOLUTIONS, SETTINGS) if self._settings else (SOLUTIONS,):
            _texts(self._files[file])[list(self.subject.case.characteristics.names)].to_numpy(dtype=float)
        known = {MANIFEST, SOLUTIONS, SETTINGS, STUDY, CHECKS, f"{DOSSIER}.json", f"{DOSSIER}.html"}
        known |= {f"{ANSWERS}/{answer.question}.json" for answer in packed.answers}
        known |= {f"{CODE}/{name}" for name in packed.code}
        for name in self._files:
            if name not in known and not name.startswith((f"{VALIDATIONS}/", f"{REFERENCES}/")):
                raise ValueError(f"{name} belongs to no claim")

    @property
    def code_in_words(self) -> list[str]:
        """The user code that simulations would run: files of the pack, and what the study names. Networks count: the
        options of SUMO beside them may name files to write.
        """
        study = self.subject.study
        return [*self._packed.code, *user_code_names(study), *(name for name in study.search.algorithms if ":" in name)]

    def unpack_code(self, folder: Path) -> None:
        """Write the user's files to a folder, and let the study find them there.

        Raises
        ------
        InputError
            If a file is not that of the study's identity.
        """
        for name in self._packed.code:
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(self._files[f"{CODE}/{name}"])
            if self._manifest["sources"].get(name, digest_of(target)) != digest_of(target):
                raise InputError(self._path, f"{CODE}/{name} is not the file of the study's identity", PACK)
        places = (str(folder),) if self._packed.code else ()
        self.subject = subject_of(self._manifest, self._files[SOLUTIONS], self._packed.runs, places)

    def names(self, search: bool) -> list[str]:
        """The names of all claims."""
        return [
            "inputs",
            "study",
            "original vehicle",
            "number of solutions and runs",
            *(f"{SOLUTION}{handle}" for handle in self._solutions),
            *(f"{SETTING}{place}" for place in self._settings),
            *(f"{ANSWER}{answer.question}" for answer in self._packed.answers),
            "checks",
            *(f"{VALIDATION}{name}" for name in self._validations),
            DOSSIER,
            *(["search"] if search else []),
        ]

    def claims(self, names: Sequence[str], pool: Pool, progress: Progress) -> Iterator[Claim]:
        """The claims with these names, made again."""
        sources = self._manifest["sources"]
        missing = [name for name in sources if name not in self._packed.code]
        if missing:
            reason = f"the pack has only the digest of {', '.join(missing)}"
            yield from (Claim(self._packed.name, name, CANNOT, here=reason) for name in names)
            return
        rows = {
            **{f"{SOLUTION}{handle}": (SOLUTIONS, row) for row, handle in enumerate(self._solutions)},
            **{f"{SETTING}{place}": (SETTINGS, row) for row, place in enumerate(self._settings)},
        }
        for file in (SOLUTIONS, SETTINGS):
            if chosen := [name for name in names if name in rows and rows[name][0] == file]:
                try:
                    yield from self._rows(file, chosen, [rows[name][1] for name in chosen], pool, progress)
                except SafevarError as error:
                    yield from (Claim(self._packed.name, name, CANNOT, here=str(error)) for name in chosen)
        for name in names:
            if name not in rows:
                try:
                    difference = self._difference(name, pool, progress)
                    verdict, values = (SAME, ()) if difference is None else (DIFFERS, difference)
                except SafevarError as error:
                    verdict, values = CANNOT, ("", " ".join(str(error).split()))
                yield Claim(self._packed.name, name, verdict, *values)

    def _rows(
        self, file: str, names: Sequence[str], rows: Sequence[int], pool: Pool, progress: Progress
    ) -> Iterator[Claim]:
        """Rows of a table of settings, simulated again."""
        packed = _texts(self._files[file]).iloc[list(rows)]
        settings = packed[list(self.subject.case.characteristics.names)].to_numpy(dtype=float)
        here = _texts(csv_of(self.subject.evaluated(settings, pool, progress, f"{self._packed.name}: {file}")))
        columns = [name for name in {**dict.fromkeys(here), **dict.fromkeys(packed)} if name not in _LABELS]
        before, now = (frame.reindex(columns=columns, fill_value="no column").to_numpy(str) for frame in (packed, here))
        for name, first, second in zip(names, before, now, strict=True):
            changed = np.flatnonzero(first != second)[:MAX_COLUMNS_NAMED].tolist()
            texts = (", ".join(f"{columns[index]} {row[index] or '-'}" for index in changed) for row in (first, second))
            yield Claim(self._packed.name, name, DIFFERS if changed else SAME, *texts)

    def _difference(self, name: str, pool: Pool, progress: Progress) -> tuple[str, str] | None:
        """The packed value and the value here, if a claim other than a row differs."""
        study, packed = self.subject.study, self._packed
        if name.startswith(ANSWER):
            return self._answer_difference(name.removeprefix(ANSWER), pool, progress)
        if name == "checks":
            return _other_bytes(self._files[CHECKS], self.subject.checks(pool, progress), name)
        if name.startswith(VALIDATION):
            return self._validation_difference(name.removeprefix(VALIDATION), pool, progress)
        if name == DOSSIER:
            made = dossier_of(self.subject, packed, self._files).items()
            changed = ((file, text) for file, text in made if self._files[file] != text)
            return next((_other_bytes(self._files[file], text, file) for file, text in changed), None)
        if name == "inputs":
            system = assemble(study, packed.name)
            now = manifest_of(study, identity_of(study, system, pool))
            changes = [text for _, text, changes_simulations in differences(self._manifest, now) if changes_simulations]
            return ("", "; ".join(changes)) if changes else None
        if name == "study":
            return _other_lines(self._files[STUDY], study_text(study).encode())
        if name == "original vehicle":
            return self._original_difference(pool, progress)
        if name == "search":
            return self._search_difference(pool, progress)
        counted = {"solutions": len(self._solutions), "runs": len(packed.runs)}
        return _first_difference({key: packed.counts.get(key) for key in counted}, counted, "counts")

    def _original_difference(self, pool: Pool, progress: Progress) -> tuple[str, str] | None:
        original = Evaluator(self.subject.study, pool, progress).evaluate_original()
        return _first_difference(self._manifest["original"], record(original, row=0), "original")

    def _answer_difference(self, question: str, pool: Pool, progress: Progress) -> tuple[str, str] | None:
        (answer,) = [answer for answer in self._packed.answers if answer.question == question]
        options = QUESTIONS[question][0](**answer.options)
        text, packed = self.subject.answer(options, pool, progress), self._files[f"{ANSWERS}/{question}.json"].decode()
        command = f"{options.command_line(f'results/{self.subject.study.name}')} --json"
        if answer.command != command:
            return answer.command, command
        named = [f"{question}{path}" for path, _ in named_settings(json.loads(text), self.subject.case.characteristics)]
        stored = [place for place in self._settings if place.startswith(f"{question}.")]
        if text == packed and named == stored:
            return None
        return _other_bytes(packed.encode(), text.encode(), question) or ("", "other named settings")

    def _validation_difference(self, name: str, pool: Pool, progress: Progress) -> tuple[str, str] | None:
        packed = self._files[self._validations[name]]
        file = str(json.loads(packed)["file"])
        if f"{REFERENCES}/{file}" not in self._files:
            raise InputError(file, "the pack has only the digest of this file")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, PurePosixPath(file).name)
            path.write_bytes(self._files[f"{REFERENCES}/{file}"])
            return _other_bytes(packed, self.subject.validation(path, pool, progress), name)

    def _search_difference(self, pool: Pool, progress: Progress) -> tuple[str, str] | None:
        """Search again: the same runs find the same solutions, after as many evaluations and collisions."""
        study = self.subject.study
        keys = [key for key in all_runs(study) if (key.algorithm, key.run) in set(self._packed.runs)]
        with tempfile.TemporaryDirectory() as folder, open_observer(progress, study, keys) as observer:
            carry_out_runs(study, assemble(study, self._packed.name), keys, Path(folder), pool, observer, None)
            _, evaluations, solutions, finished, _ = load_runs(folder)
        counts = {
            "solutions": len(solutions),
            "runs": len(finished),
            "evaluations": len(evaluations),
            "collisions": int((evaluations["outcome"] == "collision").sum()),
        }
        if difference := _first_difference(self._packed.counts, counts, "counts"):
            return difference
        return _other_lines(self._files[SOLUTIONS], csv_of(solutions))


_LABELS = ("algorithm", "run", PLACE)
"""Columns that no simulation gives."""


def _texts(content: bytes) -> pd.DataFrame:
    """A CSV table as texts, to compare the bytes."""
    return pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False)


def _other_lines(packed: bytes, here: bytes) -> tuple[str, str] | None:
    """The first line at which two texts differ."""
    lines = zip_longest(*(text.decode(errors="replace").splitlines(keepends=True) for text in (packed, here)))
    return next(((str(first).strip(), str(second).strip()) for first, second in lines if first != second), None)


def _other_bytes(packed: bytes, here: bytes, path: str) -> tuple[str, str] | None:
    """The first value at which two JSON files differ, if their bytes do."""
    if packed == here:
        return None
    try:
        difference = _first_difference(json.loads(packed), json.loads(here), path)
    except ValueError:
        difference = None
    return difference or ("other bytes", "other bytes")


def _first_difference(packed: Any, here: Any, path: str) -> tuple[str, str] | None:
    """The first place at which two JSON values differ, with both values; None if nowhere."""
    if isinstance(packed, dict) and isinstance(here, dict):
        pairs = [(f"{path}.{key}", packed.get(key, "none"), here.get(key, "none")) for key in {**packed, **here}]
    elif isinstance(packed, list) and isinstance(here, list) and len(packed) == len(here):
        pairs = [(f"{path}.{index}", packed[index], here[index]) for index in range(len(packed))]
    else:
        same = json.dumps(packed, sort_keys=True, default=str) == json.dumps(here, sort_keys=True, default=str)
        return None if same else (f"{path} = {packed}", f"{path} = {here}")
    return next((found for key, first, second in pairs if (found := _first_difference(first, second, key))), None)
