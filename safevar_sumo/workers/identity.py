"""The identity of a study: the inputs of its results besides its file."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from functools import cache
from hashlib import sha256
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec

from safevar_sumo.plugins import DIGITS, named_files
from safevar_sumo.results import RESULTS, evaluation_keys
from safevar_sumo.study import Study
from safevar_sumo.sumo.network import network_files
from safevar_sumo.sumo.system import System

Inputs = dict[str, dict[str, str]]
"""Digests of files, by layer and name."""
EXPONENTS = (1 / 21, 1 / 20, -21.0, 21.0)
"""Exponents of the powers that NSGA-II's operators compute (distribution index 20)."""
POWERS = 2000


def identity_of(study: Study, system: System, sources: Mapping[str, str] = MappingProxyType({})) -> dict[str, Any]:
    """The layers of a manifest besides the study: plain values, the same in every process and for every worker.

    `resolved` are the study's tables with models' defaults and the weather's numbers, `network` and `sources` digests by file,
    `results` the number of the package's results, `platform` the properties of the machine on which the last bit of a result may depend.

    Parameters
    ----------
    sources
        Digests of the files that other people's code reads: see `safevar_sumo.workers.sources_of`.
    """
    resolved = evaluation_keys(study)
    for table, model in (("vehicle", system.vehicle), ("ads", system.ads), ("scenario", system.scenario)):
        if isinstance(model, msgspec.Struct):
            names = {key: value for key, value in resolved[table]["parameters"].items()
                     if isinstance(value, str) or any(named_files(value, study.origin.places))}
            resolved[table] = {**resolved[table], "parameters": {**msgspec.to_builtins(model), **names}}
    resolved["weather"] = msgspec.to_builtins(system.weather)
    if system.matrix and system.rater is None:
        resolved["weathers"] = [msgspec.to_builtins(point.weather) for point in system.matrix]
    return {"resolved": resolved, "network": networks_of(system), "sources": dict(sources), "results": RESULTS, "platform": _platform()}


def networks_of(system: System) -> dict[str, str]:
    """Digests of the files of all networks that settings are simulated on."""
    folders = list(dict.fromkeys(point.scenario.network for point in system.points))
    if len(folders) == 1:
        return network_files(folders[0])
    return {f"{Path(folder).name}/{name}": digest for folder in folders for name, digest in network_files(folder).items()}


@cache
def _platform() -> dict[str, str]:
    return {"system": platform.system(), "machine": platform.machine(), "powers": powers_digest()}


def powers_digest() -> str:
    """Digest of powers, which mathematical libraries round differently; all other operations are exact in IEEE 754."""
    bases = [(number + 0.5) / POWERS * 2 for number in range(POWERS)]
    return sha256(repr([[base ** exponent for base in bases] for exponent in EXPONENTS]).encode()).hexdigest()[:DIGITS]
