"""The manifest of a results directory: whose results these are, and in what another study differs from theirs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

from safevar_sumo.errors import InputError
from safevar_sumo.study import WORDS, Study, refuse_other_than_file, tables_of

MANIFEST, RUNS = "manifest.json", "runs"
FORMAT = 3
READABLE = (2, FORMAT)
RESULTS = 1
"""Stands for the package's code in whatever hangs on its results: raised whenever they change, to which tests/golden forces."""
VERSIONED = ("safevar_sumo", "libsumo", "eclipse-sumo", "deap", "numpy")
FREE = ("title", "published", "repeatability", "fit", "calibration", "variation", "correlations")
"""Keys of a study that change no result of a campaign."""
FREE_OF_SEARCH = ("runs", "algorithms", "evaluations", "time_limit")
"""Keys of its search table that change no evaluation: which runs there are, how far they go, how long one may take."""
LAYERS = {
    "resolved": "the same study and options", "network": "the network's file as it was", "sources": "the file as it was",
    "results": "that version", "versions": "those versions", "platform": "such a machine"}
"""What results depend on, as far as a manifest tells, and the way back where it differs."""
OF_FILES = ("network", "sources")
"""Layers of digests by file."""
LAYERS_BEFORE = ("resolved", "network", "sources", "code", "versions", "platform")
"""Those of format 2, which had digests of the package's files."""
SIMULATORS = ("libsumo", "eclipse-sumo")
"""Versions on which a simulation that is asked for now depends; the others are those of searches and of the package."""
DIGESTS = "digests"
"""Key of the digests of files of the directory itself."""


def manifest_of(study: Study, identity: Mapping[str, Any]) -> dict[str, Any]:
    """The manifest of a study, but for the original vehicle.

    Parameters
    ----------
    study
        As it is run, options applied.
    identity
        What its results depend on beside its file, by `LAYERS`: see `safevar_sumo.workers.identity_of`.
    """
    return {
        "format": FORMAT, "study": tables_of(study), "seed": study.search.seed, "resolved": fixed(study), **identity,
        "versions": {name: version(name) for name in VERSIONED}}


def fixed(study: Study) -> dict[str, Any]:
    """Study keys that affect evaluations."""
    everything: dict[str, Any] = tables_of(study)
    for characteristic in everything["vehicle"]["characteristics"].values():
        for key in WORDS:
            del characteristic[key]
    search = {key: value for key, value in everything["search"].items() if key not in FREE_OF_SEARCH}
    return {**{key: value for key, value in everything.items() if key not in FREE}, "search": search}


def owner(manifest: Mapping[str, Any]) -> str:
    """The digest that the journals of a manifest's study carry."""
    if "format" in manifest:
        return _digest({layer: manifest.get(layer) for layer in (LAYERS if manifest["format"] == FORMAT else LAYERS_BEFORE)})
    search = {key: value for key, value in manifest["study"]["search"].items() if key not in ("runs", "algorithms")}
    return _digest([{**manifest["study"], "search": search}, manifest["versions"], manifest.get("network")])


def difference(stored: Mapping[str, Any], new: Mapping[str, Any]) -> tuple[str, str]:
    """In what two manifests differ so that results may, and the way back; two empty texts if in nothing."""
    if stored.get("format") != FORMAT:
        return f"version {stored['versions'].get('safevar_sumo')} wrote them", "that version"
    for layer, way_back in LAYERS.items():
        for told in _differences(layer, stored.get(layer, {}), new.get(layer, {})):
            return told, way_back
    return "", ""


def differences_now(stored: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Everything in which what is simulated now differs from what results were computed with.

    Other versions of what only searches, and another machine, change no simulation; nor does another version of this package
    with the same number `RESULTS`.
    """
    if stored.get("format") != FORMAT:
        return [f"version {stored['versions'].get('safevar_sumo')} wrote them"]
    found = [f"{key} is {there!r} there and {here!r} here" for key, there, here in _pairs(stored["resolved"], new["resolved"])
             if there is not None]  # a key that came later: the number of results tells whether it changes any
    found += [told for layer in (*OF_FILES, "results") for told in _differences(layer, stored.get(layer, {}), new[layer])]
    there, here = ({name: of["versions"].get(name) for name in SIMULATORS} for of in (stored, new))
    return [*found, *_differences("versions", there, here)]


def counted(manifest: Mapping[str, Any]) -> Any:
    """What of the journals counts: algorithms, runs, evaluations of each."""
    search = manifest["study"]["search"]
    return [search["algorithms"], search["runs"], search["evaluations"]]


def read_manifest(directory: Path) -> dict[str, Any]:
    """The manifest of a results directory.

    Raises
    ------
    InputError
        If there is none, or the file is something else.
    """
    file = directory / MANIFEST
    legal = "a directory that the command study has written"
    try:
        refuse_other_than_file(file)
        manifest = json.loads(file.read_text(encoding="utf-8"))
        if isinstance(manifest["study"], dict) and isinstance(manifest["versions"], dict) and manifest.get("format", FORMAT) in READABLE \
                and isinstance(manifest.get(DIGESTS, {}), dict):
            return dict(manifest)
    except FileNotFoundError:
        meant = Path("results") / directory.name
        hint = f"; did you mean {meant}?" if meant != directory and (meant / MANIFEST).is_file() else ""
        raise InputError(directory, f"is no results directory: there is no {MANIFEST}{hint}", legal) from None
    except OSError as error:
        raise InputError(file, f"cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, RecursionError):
        pass
    raise InputError(file, "is not a manifest of this version of the program", legal)


def _differences(layer: str, stored: Any, new: Any) -> Iterator[str]:
    """Everything in which a layer of two manifests differs, told for a person."""
    for key, there, here in _pairs(stored, new):
        if layer in OF_FILES:
            what = "is not there any more" if here is None else "was not there" if there is None else "has changed"
            yield f"{key} {what} since"
        else:
            what = f"version of {key}" if layer == "versions" else key or "the number of the package's results"
            yield f"{what} is {there!r} there and {here!r} here"


def _pairs(stored: Any, new: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """The innermost keys at which two values differ, with both; 2 and 2.0 are different."""
    if isinstance(stored, dict) and isinstance(new, dict):
        for name in sorted({*stored, *new}):
            yield from _pairs(stored.get(name), new.get(name), f"{key}.{name}" if key else name)
    elif json.dumps(stored, sort_keys=True) != json.dumps(new, sort_keys=True):
        yield key, stored, new


def _digest(what: Any) -> str:
    return sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()
