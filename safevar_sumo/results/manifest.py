"""The manifest of a results directory: the inputs that its results depend on, and their differences from other
inputs.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from safevar_sumo.errors import InputError
from safevar_sumo.results.files import MANIFEST, write_whole
from safevar_sumo.results.journal import FORMAT
from safevar_sumo.study import DESCRIPTION_KEYS, Study, refuse_other_than_file, tables_of

RESULTS = 6
"""Version number of the package's results, raised whenever they change (enforced by tests/golden)."""
SIMULATORS = ("libsumo", "eclipse-sumo")
"""Packages on whose versions a single simulation depends."""
PACKAGES = ("safevar_sumo", *SIMULATORS, "deap", "numpy")
KEYS_WITHOUT_EFFECT_ON_RESULTS = (
    "title",
    "published",
    "repeatability",
    "fit",
    "calibration",
    "spread",
    "model_error",
    "variation",
    "correlations",
)
"""Keys of a study that change no result."""
KEYS_WITHOUT_EFFECT_ON_EVALUATIONS = ("runs", "algorithms", "evaluations", "time_limit")
"""Keys of a study's search table that change no evaluation, but decide which evaluations there are."""
IDENTITY = {
    "resolved": "the same study and options",
    "network": "the network's file as it was",
    "sources": "the file as it was",
    "results": "that version",
    "versions": "those versions",
    "platform": "such a machine",
}
"""Inputs that results depend on, each with the remedy if it has changed; an error says "expected: another `out` ..., or
REMEDY".
"""
LAYERS_OF_FILES = ("network", "sources")
"""Inputs that are a digest for each file; all workers must have the same files."""


class Difference(NamedTuple):
    """A difference between stored and present inputs in words; its layer of `IDENTITY`; and whether it may change
    simulations.

    Other search libraries and machines, other versions of this package with the same `RESULTS`, and new keys of a study
    do not.
    """

    layer: str
    text: str
    changes_simulations: bool


def manifest_of(study: Study, identity: Mapping[str, Any]) -> dict[str, Any]:
    """The manifest of a study as it is run, without the original vehicle's evaluation.

    Parameters
    ----------
    identity
        Inputs of the results besides the study file, by `IDENTITY`; see `safevar_sumo.campaign.identity.identity_of`.
    """
    return {
        "format": FORMAT,
        "study": tables_of(study),
        "seed": study.search.seed,
        "resolved": evaluation_keys(study),
        **identity,
        "versions": {name: version(name) for name in PACKAGES},
    }


def evaluation_keys(study: Study) -> dict[str, Any]:
    """Study keys that affect evaluations."""
    tables: dict[str, Any] = tables_of(study)
    for characteristic in tables["vehicle"]["characteristics"].values():
        for key in DESCRIPTION_KEYS:
            del characteristic[key]
    search = {key: value for key, value in tables["search"].items() if key not in KEYS_WITHOUT_EFFECT_ON_EVALUATIONS}
    return {
        **{key: value for key, value in tables.items() if key not in KEYS_WITHOUT_EFFECT_ON_RESULTS},
        "search": search,
    }


def identity_digest(manifest: Mapping[str, Any]) -> str:
    """The digest that identifies a manifest's study in its journals."""
    return sha256(json.dumps({layer: manifest.get(layer) for layer in IDENTITY}, sort_keys=True).encode()).hexdigest()


def differences(stored: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[Difference]:
    """The differences between the inputs of stored results and other inputs."""
    for layer in IDENTITY:
        for key, before, after in _changed_values(stored.get(layer, {}), now.get(layer, {})):
            if layer in LAYERS_OF_FILES:
                text = (
                    f"{key} "
                    f"{'no longer exists' if after is None else 'is new' if before is None else 'has changed since'}"
                )
            else:
                name = f"version of {key}" if layer == "versions" else key or "the version of the package's results"
                text = f"{name} was {before!r} and is {after!r} now"
            is_harmless = (
                layer == "platform"
                or (layer == "versions" and key not in SIMULATORS)
                or (layer == "resolved" and before is None)
            )
            yield Difference(layer, text, not is_harmless)


def search_extent_of(manifest: Mapping[str, Any]) -> Any:
    """The study keys that decide which runs, of which length, the table of solutions covers."""
    search = manifest["study"]["search"]
    return [search["algorithms"], search["runs"], search["evaluations"]]


def write_manifest(directory: Path, manifest: Mapping[str, Any]) -> None:
    """Write a manifest."""
    write_whole(directory / MANIFEST, json.dumps(manifest, indent=2, allow_nan=False) + "\n")


def read_manifest(directory: Path) -> dict[str, Any]:
    """The manifest of a results directory.

    Raises
    ------
    InputError
        If there is no manifest, or it is damaged or of another format.
    """
    file = directory / MANIFEST
    expected = "a directory written by the command `study`"
    try:
        refuse_other_than_file(file)
        manifest = json.loads(file.read_text(encoding="utf-8", errors="replace"))
        study, written_by, number = manifest["study"], manifest["versions"]["safevar_sumo"], manifest.get("format", 1)
    except FileNotFoundError:
        likely_path = Path("results") / directory.name
        hint = (
            f"; did you mean {likely_path}?" if likely_path != directory and (likely_path / MANIFEST).is_file() else ""
        )
        raise InputError(directory, f"is not a results directory: there is no {MANIFEST}{hint}", expected) from None
    except OSError as error:
        raise InputError(file, f"cannot be read: {error.strerror}") from None
    except json.JSONDecodeError as error:
        raise InputError(
            file,
            f"is torn or was edited, line {error.lineno} is no JSON: {error.msg}",
            "the file as it was, or no file: the same command then writes it again",
        ) from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        study = None
    if not isinstance(study, dict):
        raise InputError(file, "is not a manifest of this program", expected)
    if number != FORMAT:
        raise InputError(
            directory,
            f"holds results in format {number}; this version reads format {FORMAT}",
            f"the release that wrote them, safevar_sumo {written_by}; or another `out`",
        )
    return dict(manifest)


def folders_of(directory: Path, manifest: Mapping[str, Any]) -> tuple[str, ...]:
    """Folders of the user code and files of a directory's study: those of the manifest that exist, then the directory's
    two parents.
    """
    folders = [os.path.abspath(directory.resolve() / folder) for folder in manifest.get("folders", ())]
    return tuple(dict.fromkeys([*filter(os.path.isdir, folders), *map(str, directory.resolve().parents[:2])]))


def relative_folders(directory: Path, study: Study) -> list[str]:
    """The folders of a study's files, relative to the directory."""
    folders = []
    for folder in study.origin.places:
        try:
            folders.append(os.path.relpath(folder, directory.resolve()))
        except ValueError:  # on another drive
            folders.append(folder)
    return folders


def _changed_values(first: Any, second: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """The innermost keys at which two values differ, with the first and the second value; 2 and 2.0 are different."""
    if isinstance(first, dict) and isinstance(second, dict):
        for name in sorted({*first, *second}):
            yield from _changed_values(first.get(name), second.get(name), f"{key}.{name}" if key else name)
    elif json.dumps(first, sort_keys=True) != json.dumps(second, sort_keys=True):
        yield key, first, second
