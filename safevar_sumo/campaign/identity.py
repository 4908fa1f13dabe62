"""The identity of a study: all inputs of its results except the study file."""

from __future__ import annotations

import platform
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec

from safevar_sumo.plugins import files_named_in
from safevar_sumo.results import RESULTS, evaluation_keys
from safevar_sumo.study import Study, tables_of
from safevar_sumo.sumo.network import open_network
from safevar_sumo.sumo.system import System

Inputs = dict[str, dict[str, str]]
"""Digests of files, by layer and name."""


def identity_of(study: Study, system: System, sources: Mapping[str, str] = MappingProxyType({})) -> dict[str, Any]:
    """The layers of a manifest except the study: plain values that are the same in every process.

    `resolved` are the tables of the study with all defaults of models and all numbers of the weather; `network` and
    `sources` are digests by file; `results` is the version of the results; `platform` are properties of the machine
    that may affect the last bit of a result.

    Parameters
    ----------
    sources
        Digests of the files that user code reads: see `safevar_sumo.campaign.batches.source_digests`.
    """
    resolved = evaluation_keys(study)
    for table, model in (("vehicle", system.vehicle), ("ads", system.ads), ("scenario", system.scenario)):
        if isinstance(model, msgspec.Struct):
            texts_and_paths = {
                key: value
                for key, value in resolved[table]["parameters"].items()
                if isinstance(value, str) or any(files_named_in(value, study.origin.places))
            }
            resolved[table] = {**resolved[table], "parameters": {**msgspec.to_builtins(model), **texts_and_paths}}
    resolved["weather"] = msgspec.to_builtins(system.weather)
    if system.matrix and system.rater is None:
        resolved["weathers"] = [msgspec.to_builtins(point.weather) for point in system.matrix]
    return {
        "resolved": resolved,
        "network": network_digests(system),
        "sources": dict(sources),
        "results": RESULTS,
        "platform": {"system": platform.system(), "machine": platform.machine()},
    }


def input_files(study: Study, system: System) -> list[Path]:
    """The files that a study is made of: its own file and those that it extends, networks, loaded modules, and files
    that it names.
    """
    networks = [open_network(folder) for folder in dict.fromkeys(point.scenario.network for point in system.points)]
    return [
        *(Path(file) for file in study.origin.files),
        *(network.path(name) for network in networks for name, _ in network.digests),
        *(Path(file) for module in list(sys.modules.values()) if (file := getattr(module, "__file__", None))),
        *map(Path, files_named_in(tables_of(study), study.origin.places)),
    ]


def network_digests(system: System) -> dict[str, str]:
    """Digests of the files of all networks in the simulations."""
    folders = list(dict.fromkeys(point.scenario.network for point in system.points))
    if len(folders) == 1:
        return dict(open_network(folders[0]).digests)
    return {
        f"{Path(folder).name}/{name}": digest for folder in folders for name, digest in open_network(folder).digests
    }
