"""Makes every claim of a pack again, from the pack alone, and compares the bytes."""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from itertools import zip_longest
from pathlib import Path
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
from safevar_sumo.plugins import digest_of, file_by_name
from safevar_sumo.records import FloatArray, JsonObject
from safevar_sumo.report.evidence import (
    ANSWERS,
    CHECKS,
    CODE,
    DOSSIER,
    DOSSIER_PAGE,
    PLACE,
    REFERENCES,
    SETTINGS,
    STUDY,
    VALIDATIONS,
    command_of,
    count_found,
    csv_of,
    json_bytes,
    read_table,
    subject_of,
)
from safevar_sumo.report.pack import PACK, PackedStudy, read_pack
from safevar_sumo.results import MANIFEST, SOLUTIONS, handles_of, load_runs, manifest_of, record
from safevar_sumo.results.manifest import differences
from safevar_sumo.study import user_code_names
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import Progress, show_no_progress

SAME, DIFFERS, CANNOT = "same", "differs", "cannot be made here"
LABELS = ["algorithm", "run", PLACE]
"""Columns that no simulation gives."""
Difference = tuple[str, str] | None
"""A value in the pack and the value here."""
Pairs = Iterator[tuple[bytes, bytes]]
"""Bytes in the pack, and the same made here."""


class Claim(NamedTuple):
    """A claim of a pack: its study and name, whether it is the same here, and both values if it is not."""

    study: str
    claim: str
    verdict: str
    packed: str = ""
    here: str = ""


class Verification(NamedTuple):
    """All claims that were made again."""

    claims: Sequence[Claim]

    def count_verdict(self, verdict: str) -> int:
        return sum(claim.verdict == verdict for claim in self.claims)

    def to_dict(self) -> JsonObject:
        """The JSON of `verify`."""
        verdicts = {"same": SAME, "differs": DIFFERS, "cannot": CANNOT}
        return {
            "claims": len(self.claims),
            **{key: self.count_verdict(verdict) for key, verdict in verdicts.items()},
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
        Number of claims, drawn at random, besides that of the search; by default all.
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
    if not folders:
        raise InputError(path, "holds no study", PACK)
    if stray := [name for name in files if not name.startswith(folders)]:
        raise InputError(path, f"{stray[0]} belongs to no study", PACK)
    parts = []
    for packed in description.studies:
        try:
            parts.append(_Part(packed, files, progress))
        except (LookupError, ValueError, TypeError, RecursionError, InputError) as error:
            raise InputError(path, f"{packed.folder} is damaged: {describe_error(error)}", PACK) from None
    if not run_code and (code := [name for part in parts for name in part.code_in_words]):
        problem = f"`verify` would run code of the pack: {', '.join(code)}"
        raise InputError(path, problem, "`run_code=True`, if you trust it")
    with ExitStack() as stack:
        for part in parts:
            part.unpack_code(path, Path(stack.enter_context(tempfile.TemporaryDirectory())))
        names = [(part, name) for part in parts for name in part.names]
        if sample is not None and sample < len(names):
            drawn = np.random.default_rng().choice(len(names), sample, replace=False)
            names = [names[index] for index in sorted(drawn.tolist())]
        if search:
            names += [(part, "search") for part in parts]
        claims = list[Claim]()
        for part in parts:
            with local_pool(jobs or available_cores(), part.subject.study.search.time_limit) as pool:
                claims += part.claims([name for owner, name in names if owner is part], pool)
    return Verification(claims)


class _Part:
    """One study of a pack, and its claims; its construction raises an error of Python's own if it is damaged."""

    def __init__(self, packed: PackedStudy, files: Mapping[str, bytes], progress: Progress) -> None:
        folder, self._progress = f"{packed.folder}/", progress
        own_files = {name.removeprefix(folder): content for name, content in files.items() if name.startswith(folder)}
        self.subject = subject = subject_of(packed, own_files)
        if json_bytes(subject.manifest) != own_files[MANIFEST]:  # such as by digits that no double has
            raise ValueError(f"{MANIFEST} was edited")
        needed = {MANIFEST, SOLUTIONS, *subject.made_files, *(f"{CODE}/{name}" for name in packed.code)}
        for name in sorted(needed ^ own_files.keys()):
            if name in needed or not (name == SETTINGS or name.startswith(f"{REFERENCES}/")):
                raise ValueError(f"{name} {'is missing' if name in needed else 'belongs to no claim'}")
        for answer in packed.answers:
            command_of(answer.question, answer.options, packed.name)  # raises if the question or an option is none
        subject.dossier()  # raises if an answer is damaged
        places = read_table(own_files[SETTINGS])[PLACE] if SETTINGS in own_files else ()
        self._rows = {
            f"solution {handle}": (SOLUTIONS, row) for row, handle in enumerate(handles_of(subject.case.solutions))
        }
        self._rows |= {f"setting {place}": (SETTINGS, row) for row, place in enumerate(places)}
        for file in {SOLUTIONS, SETTINGS} & own_files.keys():
            self._read_rows(file)

    def _read_rows(self, file: str) -> tuple[pd.DataFrame, FloatArray]:
        """A table of settings as texts, whose bytes are compared, and the settings, shape (M, n)."""
        frame = _read_texts(self.subject.files[file])
        return frame, frame[list(self.subject.case.characteristics.names)].to_numpy(dtype=float)

    @property
    def code_in_words(self) -> list[str]:
        """The user code that simulations would run: files of the pack, and what the study names.

        Networks count, since SUMO's options beside them may name files to write.
        """
        study = self.subject.study
        algorithms = [name for name in study.search.algorithms if ":" in name]
        return [*self.subject.packed.code, *user_code_names(study), *algorithms]

    def unpack_code(self, path: Path, folder: Path) -> None:
        """Write the user's files to a folder, and let the study find them there.

        Raises
        ------
        InputError
            If a file is not that of the study's identity.
        """
        packed, files, manifest, _ = self.subject
        for name in packed.code:
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(files[f"{CODE}/{name}"])
            if manifest["files"].get(name, digest_of(target)) != digest_of(target):
                raise InputError(path, f"{CODE}/{name} is not the file of the study's identity", PACK)
        self.subject = subject_of(packed, files, [str(folder)] if packed.code else [])

    @property
    def names(self) -> list[str]:
        """The names of all claims but that of the search."""
        validations = self.subject.names_in(VALIDATIONS)
        return [
            "inputs",
            "study",
            "original vehicle",
            "number of solutions and runs",
            *self._rows,
            *(f"answer {answer.question}" for answer in self.subject.packed.answers),
            "checks",
            *(f"validation {name}" for name in validations),
            "dossier",
        ]

    def claims(self, names: Sequence[str], pool: Pool) -> Iterator[Claim]:
        """The claims with these names, made again: rows first."""
        packed, _, manifest, _ = self.subject
        places = self.subject.study.origin.places
        if missing := [name for name in manifest["files"] if not file_by_name(name, places)]:
            reason = f"the pack has only the digest of {', '.join(missing)}"
            yield from (Claim(packed.name, name, CANNOT, here=reason) for name in names)
            return
        for file in (SOLUTIONS, SETTINGS):
            rows = [name for name in names if name in self._rows and self._rows[name][0] == file]
            if rows:
                yield from self._claims_of(rows, partial(self._row_differences, file, rows, pool))
        for name in names:
            if name not in self._rows:
                yield from self._claims_of([name], partial(self._difference, name, pool))

    def _claims_of(self, names: Sequence[str], compare: Callable[[], Sequence[Difference]]) -> Iterator[Claim]:
        """The claims with these names, whose differences `compare` finds together."""
        study = self.subject.packed.name
        try:
            differences_found = compare()
        except SafevarError as error:
            yield from (Claim(study, name, CANNOT, here=" ".join(str(error).split())) for name in names)
            return
        for name, difference in zip(names, differences_found, strict=True):
            yield Claim(study, name, DIFFERS if difference else SAME, *(difference or ()))

    def _row_differences(self, file: str, names: Sequence[str], pool: Pool) -> list[Difference]:
        """The first column at which each row of a table of settings differs from its new simulation."""
        rows = [self._rows[name][1] for name in names]
        frame, settings = self._read_rows(file)
        evaluated = self.subject.evaluated(settings[rows], pool, self._progress, f"{self.subject.packed.name}: {file}")
        tables = (frame.iloc[rows].drop(columns=LABELS, errors="ignore"), _read_texts(csv_of(evaluated)))
        pairs = zip(*(table.to_dict("records") for table in tables), strict=True)
        return [_first_difference(json_bytes(packed), json_bytes(here)) for packed, here in pairs]

    def _difference(self, name: str, pool: Pool) -> list[Difference]:
        """The first value that differs in a claim that is no row of a table; a list of this one."""
        pairs = (_first_difference(packed, here) for packed, here in self._pairs(name, pool))
        return [next(filter(None, pairs), None)]

    def _pairs(self, name: str, pool: Pool) -> Pairs:
        """What a claim says, in the pack and made again."""
        packed, files, manifest, case = self.subject
        kind, _, stem = name.partition(" ")  # such as "answer risk"
        files_of_claim = {"study": [STUDY], "checks": [CHECKS], "dossier": [DOSSIER, DOSSIER_PAGE]}
        files_of_claim |= {"answer": [f"{ANSWERS}/{stem}.json"], "validation": [f"{VALIDATIONS}/{stem}.json"]}
        for file in files_of_claim.get(kind, ()):
            yield files[file], self.subject.make(file, pool, self._progress)
        if name == "inputs":
            system = assemble(case.study, packed.name)
            now = manifest_of(case.study, identity_of(case.study, system))
            changes = [text for _, text, changes_simulations in differences(manifest, now) if changes_simulations]
            yield b"", "; ".join(changes).encode()
        elif name == "original vehicle":
            original = Evaluator(case.study, pool, self._progress).evaluate_original()
            yield json_bytes(manifest["original"]), json_bytes(record(original, row=0))
        elif name == "number of solutions and runs":
            counts = {"solutions": len(case.solutions), "runs": len(packed.runs)}
            yield json_bytes({key: packed.counts.get(key) for key in counts}), json_bytes(counts)
        elif name == "search":
            yield from self._search_again(pool)
        elif kind == "answer":
            (answer,) = (answer for answer in packed.answers if answer.question == stem)
            yield answer.command.encode(), command_of(stem, answer.options, packed.name).encode()
            stored = [row.removeprefix("setting ") for row in self._rows if row.startswith(f"setting {stem}.")]
            yield json_bytes(stored), json_bytes([place for place, _ in self.subject.named_settings(stem)])

    def _search_again(self, pool: Pool) -> Pairs:
        """What the search found, in the pack and by the same runs again: counts, and the solutions."""
        study, packed = self.subject.study, self.subject.packed
        keys = [key for key in all_runs(study) if (key.algorithm, key.run) in set(packed.runs)]
        with tempfile.TemporaryDirectory() as folder, open_observer(self._progress, study, keys) as observer:
            carry_out_runs(study, assemble(study, packed.name), keys, Path(folder), pool, observer, None)
            _, evaluations, solutions, finished, _ = load_runs(folder)
        yield json_bytes(packed.counts), json_bytes(count_found(solutions, finished, evaluations))
        yield self.subject.files[SOLUTIONS], csv_of(solutions)


def _read_texts(content: bytes) -> pd.DataFrame:
    """A CSV table as texts."""
    return pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False)


def _first_difference(packed: bytes, here: bytes) -> Difference:
    """The first value at which two JSON files differ, or the first line at which other texts do; None if none does."""
    if packed == here:
        return None
    pairs = zip_longest(_list_values(packed), _list_values(here), fillvalue="nothing")
    return next((first, second) for first, second in pairs if first != second)


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
