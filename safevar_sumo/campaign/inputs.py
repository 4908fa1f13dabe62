"""The inputs of results in addition to the study itself, such as versions and digests of files."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from safevar_sumo.errors import InputError
from safevar_sumo.output import file_beside
from safevar_sumo.plugins import code_files, digests, file_by_name, files_in
from safevar_sumo.records import JsonObject
from safevar_sumo.results import RESULTS, manifest_differences, manifest_of
from safevar_sumo.study import Study, data_files, fmus_of, user_modules
from safevar_sumo.sumo.network import open_network
from safevar_sumo.sumo.system import System

PLATFORM = {"system": platform.system(), "machine": platform.machine()}
"""Properties of this machine that may change the last bit of a result."""


def manifest_now(study: Study, system: System, used: Iterable[str] = ()) -> JsonObject:
    """The manifest of a study with the present inputs of its results. The manifest has plain
    values, which are the same in every process.

    `used` are names of further files, which user code was seen to load. Files that exist belong to
    the inputs.
    """
    identity = {
        "files": files_of(study, system, used),
        "results": RESULTS,
        "platform": PLATFORM,
    }
    versions = {}
    libraries = set()
    for scenario in system.scenarios:
        if scenario.version:
            versions[f"version of {type(scenario).__name__}"] = str(scenario.version)
        for name in scenario.LIBRARIES:
            try:
                versions[name] = version(name)
                libraries.add(name)
            except PackageNotFoundError:
                raise InputError(
                    study.source,
                    f"scenario.model = {study.scenario.model!r}: LIBRARIES has {name!r}",
                    "names of installed distributions",
                ) from None
    used_by = {}
    if libraries:
        used_by = {"libraries": sorted(libraries)}
    return manifest_of(study, {**identity, "versions": versions, **used_by})


def refuse_changed_inputs(study: Study, system: System, manifest: JsonObject) -> None:
    """Raise an error if the inputs of a study's results differ from the inputs in a manifest."""
    now = manifest_now(study, system, manifest["files"])
    for _, text, _ in manifest_differences(manifest, now):
        raise InputError(
            f"study {study.name!r}",
            f"{text}: it was changed meanwhile, or a worker has another one",
            "the file as it was, and the same command; or another `out`",
        )


def files_of(study: Study, system: System, used: Iterable[str] = ()) -> dict[str, str]:
    """The digests, by name, of the files on which a study's results depend: the files of its
    networks, user code, FMUs and data files, and the files with the names `used` that exist.
    """
    networks = [open_network(name) for name in sorted(system.networks) if name]
    network_files = {
        network.path(name) for network in networks for name, _ in network.digests
    }
    data = {
        file for path in data_files(study).values() for file in files_in(Path(path))
    }
    files = digests(network_files | data, study.origin.places) | code_of(study, used)
    return dict(sorted(files.items()))


def code_of(study: Study, used: Iterable[str]) -> dict[str, str]:
    """The digests, by name, of the user code and FMUs of a study, and of the files with the names
    `used` that exist.
    """
    places = study.origin.places
    fmus = {
        Path(file_beside(name, places or [os.getcwd()])) for _, name in fmus_of(study)
    }
    used_paths = [file_by_name(name, places) for name in used]
    opened = {Path(path) for path in used_paths if path}
    return digests(code_files(user_modules(study), places) | fmus | opened, places)
