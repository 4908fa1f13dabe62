"""The identity of a study: all inputs of its results, among them the digests of the files that count."""

from __future__ import annotations

import os
import platform

import msgspec

from safevar_sumo.campaign.evaluation import Inputs, Task, network_digests
from safevar_sumo.campaign.pool import Pool, evaluate_original
from safevar_sumo.campaign.run import algorithm_of, user_algorithm_packages
from safevar_sumo.plugins import (
    Files,
    digest_of,
    digests,
    file_by_name,
    files_named_in,
    note_inputs,
    unload_user_modules,
)
from safevar_sumo.records import JsonObject
from safevar_sumo.results import RESULTS, evaluation_keys
from safevar_sumo.study import Study, fmus_of, user_code_names
from safevar_sumo.sumo.system import System, assemble

_files_read: dict[tuple[bytes, str], Files] = {}
"""Files that models have read in this process, by packed task and working directory."""


def identity_of(study: Study, system: System, pool: Pool | None = None) -> JsonObject:
    """The layers of a manifest except the study: plain values that are the same in every process.

    `resolved` are the tables of the study with all defaults of models and all numbers of the weather; `network` and
    `sources` are digests by file; `results` is the version of the results; `platform` are properties of the machine
    that may affect the last bit of a result.

    Parameters
    ----------
    pool
        Simulates the original vehicle, which shows the files that models read. Without a pool, `sources` is empty.
    """
    resolved = evaluation_keys(study)
    for table, model in (("vehicle", system.vehicle), ("ads", system.ads), ("scenario", system.scenario)):
        if isinstance(model, msgspec.Struct):
            # All parameters, with the model's defaults; but texts as the study has them, as paths become absolute.
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
        "sources": {} if pool is None else {**source_digests(study, pool), **_files_read_by_algorithms(study)},
        "results": RESULTS,
        "platform": {"system": platform.system(), "machine": platform.machine()},
    }


def inputs_of(study: Study, pool: Pool) -> Inputs:
    """Digests of the files that must be the same on every worker, by layer and name; raises as `source_digests`."""
    return {"network": network_digests(assemble(study)), "sources": source_digests(study, pool)}


def source_digests(study: Study, pool: Pool) -> Files:
    """Digests, by name, of files that parameters name, and of files that user code reads while a worker, which reloads
    all user code first, simulates the original vehicle.

    Raises
    ------
    SafevarError
        If the original vehicle cannot be simulated.
    """
    tests = [] if study.matrix is None else study.matrix.tests
    parameters = [
        *(table.parameters for table in (study.vehicle, study.ads, study.scenario, study.search)),
        *(table for test in tests for table in (test.parameters, test.over)),
        [path for _, path in fmus_of(study)],
    ]
    files = digests(files_named_in(parameters, study.origin.places), study.origin.places)
    if user_code_names(study):
        key = Task(study=study, afresh=True).packed, os.getcwd()
        # Without an entry, a file that does not exist: its digest differs.
        files_read = _files_read.get(key, {"": "never read"})
        if any(digest_of(file_by_name(name, study.origin.places)) != digest for name, digest in files_read.items()):
            _files_read[key] = dict(evaluate_original(study, key[0], pool).files)
        files |= _files_read[key]
    return dict(sorted(files.items()))


def _files_read_by_algorithms(study: Study) -> Files:
    """Digests of files that the user's algorithms read while this process loads and instantiates them."""
    packages = user_algorithm_packages(study)
    if not packages:
        return {}
    unload_user_modules()
    with note_inputs() as reading:
        for label in study.search.labels:
            algorithm_of(label, study)
    return digests(reading.files(packages), study.origin.places)
