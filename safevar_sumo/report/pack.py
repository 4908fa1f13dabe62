"""An evidence pack: a zip archive of plain files. Reading refuses an archive that is no intact
pack.
"""

from __future__ import annotations

import io
import json
import lzma
import stat
import sys
import zipfile
import zlib
from hashlib import file_digest, sha256
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, NoReturn

import msgspec
from msgspec import Meta, Struct

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Scoring
from safevar_sumo.output import MAX_UNPACKED, read_file, whole_file
from safevar_sumo.records import JsonObject
from safevar_sumo.results.identity import PACKAGES
from safevar_sumo.results.manifest import OriginalRecord
from safevar_sumo.study import Study

DESCRIPTION = "pack.json"
MAX_FILES = 10_000
MAX_PACK_EVALUATIONS = 100_000_000
MORE_IN_DIRECTORY = 16
"""Difference between an entry in the directory of a zip archive and the header of its file [bytes].
"""
DIRECTORY_END = 22
"""Size of the end of the directory of a zip archive [bytes]."""
UNIX_MODE_SHIFT = 16
"""Number of bits below the file's mode in the attributes of a zip entry."""
PACK = "a file that the command `evidence` has written, unchanged"
"""The expected input in errors about a pack."""


class PackedStudy(Struct, frozen=True, forbid_unknown_fields=True):
    """The description of one results directory in a pack.

    Attributes
    ----------
    folder
        The folder of the study in the pack.
    questions
        The texts of the questions whose answers the pack has.
    runs
        The finished runs, by algorithm and number.
    outcomes
        The numbers of evaluations of these runs, by outcome.
    solutions
        Numbers of solutions; see `count_solutions`.
    unsafe
        The criterion for unsafe; None if the user stated none.
    simulations
        Largest numbers of simulations of questions whose text does not state them, by text.
    """

    folder: str
    questions: list[str]
    runs: list[tuple[str, int]]
    outcomes: dict[str, Annotated[int, Meta(ge=0, le=MAX_PACK_EVALUATIONS)]]
    solutions: list[int]
    unsafe: str | None
    simulations: dict[str, int]


class PackedPlatform(Struct, frozen=True, forbid_unknown_fields=True):
    """The operating system and the processor with which results were computed."""

    system: str
    machine: str


class PackedManifest(Struct, frozen=True, forbid_unknown_fields=True):
    """The keys of a manifest that a pack keeps: `verify` compares or names each of them."""

    format: int
    study: Study
    files: dict[str, str]
    results: int
    platform: PackedPlatform
    versions: dict[str, str]
    original: OriginalRecord
    scoring: Scoring | None = None


class Description(Struct, frozen=True, forbid_unknown_fields=True):
    """The file `pack.json`. `files` has the sha256 of all other files of the pack, by name."""

    versions: dict[str, str]
    files: dict[str, str]
    studies: Annotated[list[PackedStudy], Meta(min_length=1)]


def write_pack(path: Path, studies: list[PackedStudy], files: dict[str, bytes]) -> None:
    """Write a pack; equal contents give equal bytes."""
    described = msgspec.json.encode(
        Description(versions_here(), digests_of(files), studies)
    )
    texts = {DESCRIPTION: msgspec.json.format(described, indent=1) + b"\n", **files}
    with whole_file(path, "out") as file, zipfile.ZipFile(file, "w") as archive:
        for name in sorted(texts):
            # Without a date an entry has the default, in 1980: equal contents give equal bytes.
            entry = zipfile.ZipInfo(name)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << UNIX_MODE_SHIFT
            archive.writestr(entry, texts[name])


def versions_here() -> dict[str, str]:
    """The versions of Python and of packages that compute the answers and the page of a pack on
    this machine.
    """
    # Matplotlib and Pillow draw the pictures of the page.
    packages = (*PACKAGES, "matplotlib", "pillow")
    return {
        **{name: version(name) for name in packages},
        "python": sys.version.split()[0],
    }


def json_of(content: bytes) -> Any:
    """The value of a JSON text. Raises a ValueError if the text is no JSON, has a key twice, or
    contains NaN or an infinity.
    """

    def once(pairs: list[tuple[str, Any]]) -> JsonObject:
        names = [name for name, _ in pairs]
        if len({*names}) < len(names):
            raise ValueError(f"the key {max(names, key=names.count)!r} is there twice")
        return dict(pairs)

    value = json.loads(content.decode(), object_pairs_hook=once)
    # The text 1e999 becomes an infinity without an error: encoding the value finds it.
    json.dumps(value, allow_nan=False)
    return value


def digests_of(files: dict[str, bytes]) -> dict[str, str]:
    """The sha256 of files, by name."""
    return {name: sha256(files[name]).hexdigest() for name in sorted(files)}


def digest_of(path: Path) -> str:
    """The sha256 of the file of a pack, by which readers identify the pack."""
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()


def read_pack(path: Path) -> tuple[Description, dict[str, bytes]]:
    """Read a pack into memory.

    Raises
    ------
    InputError
        If the file is no pack, damaged, too large, written by another version, or holds paths that
        leave it or other files than its description names.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(read_file(path, MAX_UNPACKED))) as archive:
            _check_entries(path, archive.infolist())
            _check_layout(path, archive.infolist())
            files = {
                entry.filename: archive.read(entry) for entry in archive.infolist()
            }
    except OSError as error:
        raise InputError(
            path, f"cannot be read: {error.strerror or error}", PACK
        ) from None
    except (
        zipfile.BadZipFile,
        ValueError,
        RuntimeError,
        EOFError,
        zlib.error,
        lzma.LZMAError,
    ) as error:
        _refuse(path, f"is no zip archive, or damaged: {error}")
    if DESCRIPTION not in files:
        _refuse(path, f"holds no {DESCRIPTION}")
    try:
        described = msgspec.convert(json_of(files.pop(DESCRIPTION)), Description)
    except (ValueError, msgspec.MsgspecError, RecursionError) as error:
        _refuse(path, f"{DESCRIPTION} is damaged, or of another version: {error}")

    for name in sorted(files.keys() ^ described.files.keys()):
        problem = "is missing"
        if name in files:
            problem = f"is not named in {DESCRIPTION}"
        _refuse(path, f"{name} {problem}")

    # Other versions may compute other results: then differences would mean nothing.
    present = {"safevar_sumo": version("safevar_sumo"), "libsumo": version("libsumo")}
    changed = [
        f"{name} {described.versions.get(name)}"
        for name in present
        if described.versions.get(name) != present[name]
    ]
    if changed:
        versions = [f"{name} {version}" for name, version in present.items()]
        raise InputError(
            path,
            f"was made with {', '.join(changed)}",
            f"a pack of this version: {', '.join(versions)}",
        )
    return described, files


def _check_entries(path: Path, entries: list[zipfile.ZipInfo]) -> None:
    """Refuse entries that leave the folder of the pack, are links, are there twice, or are too many
    or too large. No entry has been unpacked before.
    """
    names = [entry.filename for entry in entries]
    for entry in entries:
        name = entry.filename
        path_of_entry = PurePosixPath(name)
        is_inside = (
            name == str(path_of_entry)
            and not path_of_entry.is_absolute()
            and ".." not in path_of_entry.parts
        )
        # `name` must be a normal path: "a//b" without its beginning "a/" would be the path "/b".
        if not is_inside or "\\" in name or ":" in name:
            _refuse(path, f"the path {name!r} leaves the pack")
        if stat.S_ISLNK(entry.external_attr >> UNIX_MODE_SHIFT):
            _refuse(path, f"{name!r} is a symbolic link")

    if len(names) > MAX_FILES or len(names) != len(set(names)):
        _refuse(
            path,
            f"holds {len(names)} files, at most {MAX_FILES} are allowed, each once",
        )
    size = sum(entry.file_size for entry in entries)
    if size > MAX_UNPACKED:
        _refuse(
            path,
            f"unpacked it has {size / 1e9:.1f} GB, at most {MAX_UNPACKED / 1e9:g} are allowed",
        )


def _check_layout(path: Path, entries: list[zipfile.ZipInfo]) -> None:
    """Refuse an archive with bytes that belong to no file: before, between or behind the files, or
    in comments.
    """
    problem = "holds bytes that belong to no file"
    end = 0
    directory = DIRECTORY_END
    for entry in entries:
        if entry.header_offset != end:
            _refuse(path, problem)
        header = len(entry.FileHeader())
        end += header + entry.compress_size
        directory += header + MORE_IN_DIRECTORY
    if path.stat().st_size != end + directory:
        _refuse(path, problem)


def _refuse(path: Path, problem: str) -> NoReturn:
    raise InputError(path, problem, PACK)
