"""The manifest of a results directory: inputs of the results, digests of the directory's files; and differences of two manifests."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

from safevar_sumo.errors import InputError
from safevar_sumo.plugins import Files, digest_of, file_by_name
from safevar_sumo.results.files import MANIFEST, write_whole
from safevar_sumo.study import DESCRIPTION_KEYS, RatingTable, Study, refuse_other_than_file, tables_of

FORMAT = 3
READABLE_FORMATS = (2, FORMAT)
RESULTS = 6
"""Version number of the package's results, raised whenever they change (enforced by tests/golden)."""
PACKAGES = ("safevar_sumo", "libsumo", "eclipse-sumo", "deap", "numpy")
KEYS_WITHOUT_EFFECT_ON_RESULTS = ("title", "published", "repeatability", "fit", "calibration", "spread", "model_error", "variation",
                          "correlations")
"""Keys of a study that change no result."""
KEYS_WITHOUT_EFFECT_ON_EVALUATIONS = ("runs", "algorithms", "evaluations", "time_limit")
"""Keys of a study's search table that change no evaluation, but decide which evaluations there are."""
LAYERS = {
    "resolved": "the same study and options", "network": "the network's file as it was", "sources": "the file as it was",
    "results": "that version", "versions": "those versions", "platform": "such a machine"}
"""Inputs that results depend on, each with the remedy if it has changed; an error says "expected: another `out` ..., or REMEDY"."""
LAYERS_OF_FILES = ("network", "sources")
"""Layers that hold a digest for each file."""
LAYERS_OF_FORMAT_2 = ("resolved", "network", "sources", "code", "versions", "platform")
"""Layers in format 2, which had digests of the package's own files in place of `RESULTS`."""
SIMULATORS = ("libsumo", "eclipse-sumo")
"""Packages on whose versions a single simulation depends."""
DIGESTS_KEY = "digests"
"""Key of the digests of the table of solutions and of the manifest, the latter without this key."""


def manifest_of(study: Study, identity: Mapping[str, Any]) -> dict[str, Any]:
    """The manifest of a study, without the original vehicle's evaluation.

    Parameters
    ----------
    study
        The study as it is run.
    identity
        Inputs of the results besides the study file, by `LAYERS`; see `safevar_sumo.workers.identity.identity_of`.
    """
    return {
        "format": FORMAT, "study": tables_of(study), "seed": study.search.seed, "resolved": evaluation_keys(study), **identity,
        "versions": {name: version(name) for name in PACKAGES}}


def evaluation_keys(study: Study) -> dict[str, Any]:
    """Study keys that affect evaluations."""
    tables: dict[str, Any] = tables_of(study)
    for characteristic in tables["vehicle"]["characteristics"].values():
        for key in DESCRIPTION_KEYS:
            del characteristic[key]
    if study.rating == RatingTable():
        del tables["rating"]  # results from before ratings existed have no such table
    if study.matrix is not None and not study.matrix.protocol:
        del tables["matrix"]["protocol"]
    search = {key: value for key, value in tables["search"].items() if key not in KEYS_WITHOUT_EFFECT_ON_EVALUATIONS}
    return {**{key: value for key, value in tables.items() if key not in KEYS_WITHOUT_EFFECT_ON_RESULTS}, "search": search}


def owner_digest(manifest: Mapping[str, Any]) -> str:
    """The digest that identifies a manifest's study in its journals."""
    if "format" in manifest:
        return _digest_of_json({layer: manifest.get(layer) for layer in (LAYERS if manifest["format"] == FORMAT else LAYERS_OF_FORMAT_2)})
    search = {key: value for key, value in manifest["study"]["search"].items() if key not in ("runs", "algorithms")}
    return _digest_of_json([{**manifest["study"], "search": search}, manifest["versions"], manifest.get("network")])


def first_difference(stored_manifest: Mapping[str, Any], new_manifest: Mapping[str, Any]) -> tuple[str, str]:
    """The first difference of two manifests that may change results, and its remedy; two empty texts if there is no difference."""
    if stored_manifest.get("format") != FORMAT:
        return f"version {stored_manifest['versions'].get('safevar_sumo')} wrote them", "that version"
    for layer, remedy in LAYERS.items():
        for text in _describe_differences(layer, stored_manifest.get(layer, {}), new_manifest.get(layer, {})):
            return text, remedy
    return "", ""


def differences_now(stored: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """All differences between the present inputs of simulations and the inputs of stored results.

    Other versions of search libraries, another machine, and versions of this package with the same `RESULTS` change no simulation.
    """
    if stored.get("format") != FORMAT:
        return [f"version {stored['versions'].get('safevar_sumo')} wrote them"]
    texts = [f"{key} was {before!r} and is {now!r} now" for key, before, now in _changed_values(stored["resolved"], new["resolved"])
             if before is not None]  # a new key is ignored: had it changed results, `RESULTS` would have been raised
    texts += [text for layer in (*LAYERS_OF_FILES, "results") for text in _describe_differences(layer, stored.get(layer, {}), new[layer])]
    before, now = ({name: manifest["versions"].get(name) for name in SIMULATORS} for manifest in (stored, new))
    return [*texts, *_describe_differences("versions", before, now)]


def search_extent_of(manifest: Mapping[str, Any]) -> Any:
    """The study keys that decide which runs, of which length, the table of solutions covers."""
    search = manifest["study"]["search"]
    return [search["algorithms"], search["runs"], search["evaluations"]]


def write_manifest(directory: Path, manifest: Mapping[str, Any]) -> None:
    """Write a manifest with a digest of itself, so that edits are detected."""
    digests = {name: digest for name, digest in manifest.get(DIGESTS_KEY, {}).items() if name != MANIFEST}
    signed_manifest = {**manifest, DIGESTS_KEY: digests}
    signed_manifest[DIGESTS_KEY] = {**digests, MANIFEST: _digest_of_json(signed_manifest)}
    write_whole(directory / MANIFEST, json.dumps(signed_manifest, indent=2, allow_nan=False) + "\n")


def read_manifest(directory: Path) -> dict[str, Any]:
    """The manifest of a results directory.

    Raises
    ------
    InputError
        If there is no manifest, or its file is something else or was edited.
    """
    file = directory / MANIFEST
    expected = "a directory written by the command `study`"
    try:
        refuse_other_than_file(file)
        manifest = json.loads(file.read_text(encoding="utf-8", errors="replace"))
        is_readable = isinstance(manifest["study"], dict) and isinstance(manifest["versions"], dict) \
            and manifest.get("format", FORMAT) in READABLE_FORMATS and isinstance(manifest.get(DIGESTS_KEY, {}), dict)
    except FileNotFoundError:
        likely_path = Path("results") / directory.name
        hint = f"; did you mean {likely_path}?" if likely_path != directory and (likely_path / MANIFEST).is_file() else ""
        raise InputError(directory, f"is not a results directory: there is no {MANIFEST}{hint}", expected) from None
    except OSError as error:
        raise InputError(file, f"cannot be read: {error.strerror}") from None
    except json.JSONDecodeError as error:
        raise InputError(file, f"is torn or was edited, line {error.lineno} is no JSON: {error.msg}",
                         "the file as it was, or no file: the same command then writes it again") from None
    except (ValueError, KeyError, TypeError, RecursionError):
        is_readable = False
    if not is_readable:
        raise InputError(file, "is not a manifest of this version of the program", expected)
    digests = dict(manifest.get(DIGESTS_KEY, {}))
    digest = digests.pop(MANIFEST, None)  # versions up to 0.2.0 wrote no digest
    if digest is not None and digest != _digest_of_json({**manifest, DIGESTS_KEY: digests}):
        raise InputError(file, "was edited; restore it, or remove it and run the same command again, which writes it anew")
    return dict(manifest)


def digest_of_table(text: str) -> str:
    """Digest of a table, independent of its line ends."""
    return sha256(text.replace("\r\n", "\n").encode()).hexdigest()


def is_edited(file: Path, manifest: Mapping[str, Any]) -> bool:
    """Whether a table was changed after it was written; False if the manifest has no digest of the table.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    digest = manifest.get(DIGESTS_KEY, {}).get(file.name)
    try:
        return digest is not None and digest_of_table(file.read_bytes().decode("utf-8", "replace")) != digest
    except FileNotFoundError:
        return False
    except OSError as error:
        raise InputError(file, f"cannot be read: {error.strerror or error}") from None


def refuse_edited_table(file: Path, manifest: Mapping[str, Any], remedy: str) -> None:
    """Refuse a table for which `is_edited` holds; `remedy` names what the user can do."""
    if is_edited(file, manifest):
        raise InputError(file, "was edited: it no longer holds the computed solutions", remedy)


def _describe_differences(layer: str, stored: Any, new: Any) -> Iterator[str]:
    """All differences between a layer of two manifests, in words."""
    for key, old_value, new_value in _changed_values(stored, new):
        if layer in LAYERS_OF_FILES:
            yield f"{key} {'no longer exists' if new_value is None else 'is new' if old_value is None else 'has changed since'}"
        else:
            name = f"version of {key}" if layer == "versions" else key or "the version of the package's results"
            yield f"{name} was {old_value!r} and is {new_value!r} now"


def _changed_values(first: Any, second: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """The innermost keys at which two values differ, with the first and the second value; 2 and 2.0 are different."""
    if isinstance(first, dict) and isinstance(second, dict):
        for name in sorted({*first, *second}):
            yield from _changed_values(first.get(name), second.get(name), f"{key}.{name}" if key else name)
    elif json.dumps(first, sort_keys=True) != json.dumps(second, sort_keys=True):
        yield key, first, second


def make_inputs_comparable(stored: Mapping[str, Any], present_files: Mapping[str, str], late_files: Mapping[str, str],
                           folders: Sequence[str]) -> tuple[dict[str, Any], Files]:
    """Prepare a stored manifest, and the files that its study reads now, for their comparison.

    Both then omit a file that was first read after the study began, unless the file has changed since. If such a file is missing now,
    only the manifest holds it.
    """
    stored_digests, present_digests = dict(stored.get("sources", {})), dict(present_files)
    for name, digest in late_files.items():
        if name not in stored_digests:
            digest_now = present_digests.pop(name, None) or digest_of(file_by_name(name, folders))
            if digest_now != digest:
                stored_digests[name], present_digests[name] = digest, digest_now
    return {**stored, "sources": stored_digests}, {name: digest for name, digest in present_digests.items() if digest}


def _digest_of_json(value: Any) -> str:
    return sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
