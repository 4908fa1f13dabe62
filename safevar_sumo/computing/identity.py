"""What results depend on beside a study's file: resolved models and weather, code, network, versions, platform."""

from __future__ import annotations

import platform
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import msgspec

from safevar_sumo.computing.sources import DIGITS, foreign_code, package_code
from safevar_sumo.results import fixed
from safevar_sumo.simulation import System, network_files
from safevar_sumo.study import Study

Inputs = dict[str, dict[str, str]]
"""Digests of files, by layer and name."""
EXPONENTS = (1 / 21, 1 / 20, -21.0, 21.0)
"""Of the powers that NSGA-II's operators take (distribution index 20)."""
POWERS = 2000


def identity_of(study: Study, system: System) -> dict[str, Any]:
    """The layers of a manifest beside the study: plain values, the same in every process and for every worker.

    `resolved` are the study's tables with models' defaults and the weather's numbers, `network`, `sources` and `code`
    digests by file, `platform` the machine as far as the last bit of a result may depend on it.
    """
    resolved = fixed(study)
    for table, model in (("vehicle", system.vehicle), ("ads", system.ads), ("scenario", system.scenario)):
        if isinstance(model, msgspec.Struct):
            names = {key: value for key, value in resolved[table]["parameters"].items() if isinstance(value, str)}
            resolved[table] = {**resolved[table], "parameters": {**msgspec.to_builtins(model), **names}}
    resolved["weather"] = msgspec.to_builtins(system.weather)
    if system.matrix:
        resolved["weathers"] = [msgspec.to_builtins(point.weather) for point in system.matrix]
    return {"resolved": resolved, **inputs_of(study, system), "platform": _platform()}


def inputs_of(study: Study, system: System) -> Inputs:
    """Digests of the files that every worker must have alike."""
    modules = [member.module for member in system.members if member.guard is not None]
    modules += [name.partition(":")[0] for name in study.search.algorithms if ":" in name]
    parameters = [study.vehicle.parameters, study.ads.parameters, study.scenario.parameters, study.search.parameters]
    return {"network": networks_of(system), "sources": foreign_code(modules, parameters), "code": dict(package_code())}


def networks_of(system: System) -> dict[str, str]:
    """Digests of the files of all networks that settings are simulated on."""
    folders = list(dict.fromkeys(point.scenario.network for point in system.points))
    if len(folders) == 1:
        return network_files(folders[0])
    return {f"{Path(folder).name}/{name}": digest for folder in folders for name, digest in network_files(folder).items()}


def changed(there: Inputs, here: Inputs) -> list[str]:
    """Names of files whose digests differ in the layers that are there."""
    return [name for layer in there for name in sorted({*there[layer], *here.get(layer, {})})
            if there[layer].get(name) != here.get(layer, {}).get(name)]


@cache
def _platform() -> dict[str, str]:
    return {"system": platform.system(), "machine": platform.machine(), "powers": powers_digest()}


def powers_digest() -> str:
    """Tells mathematical libraries apart that round powers differently; all else that results are made of is exact in IEEE 754."""
    bases = [(number + 0.5) / POWERS * 2 for number in range(POWERS)]
    return sha256(repr([[base ** exponent for base in bases] for exponent in EXPONENTS]).encode()).hexdigest()[:DIGITS]
