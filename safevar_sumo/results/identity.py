"""The identity of results: the inputs on which results depend, as their manifest states them. Its
digest, and the differences between the inputs of two manifests.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from hashlib import sha256
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any

from safevar_sumo.records import JsonObject
from safevar_sumo.study import PYMOO, RANGES, Study, tables_of, with_effect
from safevar_sumo.study.schema import Tables

FORMAT = 6
"""Version number of the format of a manifest."""
RESULTS = 13
"""Version number of the package's results, raised whenever they change (enforced by tests/golden).
"""
PACKAGES = ("safevar_sumo", "libsumo", "deap", "numpy")
"""Packages that every study uses."""
LIBRARIES = {"ad_rss": "ad-rss", "highway_idm": "highway-env", "fmu": "fmpy"}
"""Optional packages, by the driving system, or the kind of driving system, that needs them."""
PYMOO_PACKAGES = ("pymoo", "cma")
"""Packages on whose versions the searches of pymoo depend."""
SEARCH_PACKAGES = ("safevar_sumo", "deap", "numpy", *PYMOO_PACKAGES)
"""Packages that only searches use: no single simulation depends on their versions."""
IDENTITY = {
    "study": "the same study and options",
    "files": "the file as it was",
    "results": "that version",
    "versions": "those versions",
    "platform": "such a machine",
}
"""Kinds of inputs on which results depend, and the remedy if such an input has changed. An error
says "expected: another `out` ..., or REMEDY".
"""


def manifest_of(study: Study, identity: Tables) -> JsonObject:
    """The manifest of a study as it is run, without the original vehicle's evaluation.

    Parameters
    ----------
    identity
        Inputs of the results besides the study file, by the keys of `IDENTITY`; see
        `safevar_sumo.campaign.inputs.manifest_now`. `versions` has the versions that a user's
        simulator states.
    """
    versions = {name: version(name) for name in packages_of(study)}
    return {
        "format": FORMAT,
        "study": tables_of(study),
        **identity,
        "versions": {**versions, **identity.get("versions", {})},
    }


def packages_of(study: Study) -> list[str]:
    """The packages that a study uses, and on whose versions its results depend. The packages of
    pymoo are left out if pymoo is not installed: questions about results do not need pymoo.
    """
    packages = list(PACKAGES)
    packages += [
        LIBRARIES[key] for key in (study.ads.model, study.ads.kind) if key in LIBRARIES
    ]
    uses_pymoo = any(name.startswith(PYMOO) for name in study.search.algorithms)
    if uses_pymoo and find_spec("pymoo") is not None:
        packages += PYMOO_PACKAGES
    return packages


def evaluation_keys(tables: Tables) -> JsonObject:
    """The keys of a study's tables that affect evaluations. If a study uses listed encounters, its
    ranges affect nothing, and are left out.
    """
    if tables.get("encounters") != RANGES:
        tables = _without_ranges(tables)
    keys: JsonObject = with_effect(tables, Study)
    return keys


def _without_ranges(tables: Tables) -> JsonObject:
    """The tables of a study with listed encounters only: without ranges of axes, the margin, and
    constraints of parameters that are no characteristics of the vehicle.
    """

    def lists(table: JsonObject) -> JsonObject:
        """A table whose axes in `over` have only their listed values."""
        changed_table = dict(table)
        over = {}
        for name, axis in changed_table.pop("over", {}).items():
            values = axis.get("at") if isinstance(axis, dict) else axis
            if values:
                over[name] = values
        if over:
            changed_table["over"] = over
        return changed_table

    result = {**tables, "scenario": lists(tables["scenario"])}
    result["scenario"].pop("margin", None)
    if matrix := tables.get("matrix"):
        result["matrix"] = {
            **matrix,
            "tests": [lists(test) for test in matrix["tests"]],
        }
    if constraints := result.pop("constraints", None):
        names = tables["vehicle"]["characteristics"].keys()
        constraints = [item for item in constraints if item["sum"].keys() <= names]
        if constraints:
            result["constraints"] = constraints
    return result


def identity_in(manifest: JsonObject) -> JsonObject:
    """The inputs that a manifest states, by the keys of `IDENTITY`."""
    layers = {layer: manifest.get(layer, {}) for layer in IDENTITY}
    return {**layers, "study": evaluation_keys(manifest["study"])}


def identity_digest(manifest: JsonObject) -> str:
    """The digest that identifies a manifest's study in its journals. Versions of pymoo's packages
    are left out, so that the digest is the same with and without a search of pymoo.
    """
    layers = identity_in(manifest)
    versions = {
        name: value
        for name, value in layers["versions"].items()
        if name not in PYMOO_PACKAGES
    }
    return sha256(
        json.dumps({**layers, "versions": versions}, sort_keys=True).encode()
    ).hexdigest()


def manifest_differences(
    stored: JsonObject, now: JsonObject
) -> Iterator[tuple[str, str, bool]]:
    """The differences between the inputs of two manifests: of stored results, and of now.

    Yields for each difference its kind (a key of `IDENTITY`), a sentence, and whether the
    difference may change simulations. Other versions of search libraries, another machine, another
    version of this package with the same `RESULTS`, and new keys of a study change no simulation.
    """
    inputs_before = identity_in(stored)
    # A search library that a user's simulator uses, too, may change simulations.
    searching = {*SEARCH_PACKAGES} - {*now.get("libraries", ())}
    for layer, inputs in identity_in(now).items():
        for key, old, new in changed_values(inputs_before[layer], inputs):
            if key in PYMOO_PACKAGES and None in (old, new):
                continue
            is_harmless = (
                layer == "platform"
                or (layer == "versions" and key in searching)
                or (layer == "study" and old is None)
            )
            name = key or "the version of the package's results"
            if layer == "versions":
                name = f"version of {key}"
            text = f"{name} was {old!r} and is {new!r} now"
            if layer == "files":
                text = f"{key} has changed since"
                if old is None:
                    text = f"{key} is new"
                if new is None:
                    text = f"{key} no longer exists"
            yield layer, text, not is_harmless


def search_extent_of(manifest: JsonObject) -> tuple[list[str], int, int]:
    """Algorithms, number of runs, and evaluations in a run of a study: they decide which solutions
    the table of solutions has.
    """
    search = manifest["study"]["search"]
    return search["algorithms"], search["runs"], search["evaluations"]


def changed_values(old: Any, new: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the innermost keys at which two nested values differ, such as "search.runs", with the
    old and the new value; None without the key. 2 and 2.0 are different.
    """
    if isinstance(old, dict) and isinstance(new, dict):
        for name in sorted({*old, *new}):
            path = name
            if key:
                path = f"{key}.{name}"
            yield from changed_values(old.get(name), new.get(name), path)
    elif json.dumps(old, sort_keys=True) != json.dumps(new, sort_keys=True):
        yield key, old, new
