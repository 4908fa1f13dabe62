"""The identity of a study, all inputs of its results: which files count, and the check of user code, once for each
identity.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from contextlib import suppress
from importlib.metadata import version

import msgspec
import numpy as np
import platformdirs

from safevar_sumo.campaign.evaluation import Inputs, Task, network_digests
from safevar_sumo.campaign.pool import Batch, Pool, evaluate_batches
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
from safevar_sumo.records import Evaluations, JsonObject
from safevar_sumo.results import RESULTS, evaluation_keys
from safevar_sumo.study import Study, fmus_of, tables_of, user_code_names
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.vehicles import CharacteristicSet

_files_read: dict[tuple[bytes, str], Files] = {}
"""Files that models have read in this process, by packed study and working directory."""
_passed_checks: set[str] = set()
"""Identity of the studies whose code has passed in this process, in case the cache folder is not writable."""


def identity_of(study: Study, system: System, pool: Pool | None = None) -> JsonObject:
    """The layers of a manifest except the study: plain values that are the same in every process.

    `resolved` are the tables of the study with all defaults of models and all numbers of the weather; `network` and
    `sources` are digests by file; `results` is the version of the results; `platform` are properties of the machine
    that may affect the last bit of a result.

    Parameters
    ----------
    pool
        Simulates the original vehicle, which shows the files that models read; without a pool, `sources` is empty.
    """
    resolved = evaluation_keys(study)
    for table, model in (("vehicle", system.vehicle), ("ads", system.ads), ("scenario", system.scenario)):
        if isinstance(model, msgspec.Struct):
            given = resolved[table]["parameters"]
            texts_and_paths = {
                key: value
                for key, value in given.items()
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


def evaluate_original(study: Study, work: bytes, pool: Pool, *, must_succeed: bool = True) -> Evaluations:
    """The evaluation of the original vehicle of a packed study; by default a failure is an error."""
    original = CharacteristicSet.of(study).original[np.newaxis]
    return evaluate_batches([Batch(work, original, must_succeed)], pool)[0]


def ask_why_no_verdict(study: Study, pool: Pool) -> str:
    """Why simulations of a study tell nothing about its ADS, as `why_no_verdict` finds in a worker; "" if they do."""
    work = Task(study=study, inputs=inputs_of(study, pool), purpose="empty road").packed
    result = evaluate_original(study, work, pool, must_succeed=False)
    return "" if len(result) else next(iter(result.reasons.values()), "")  # a failed simulation has a row


def check_code(study: Study, inputs: Inputs, pool: Pool) -> None:
    """Check the user code of a study in a worker, unless it has passed before with the same files.

    Raises
    ------
    UserCodeError
        With file, line and advice of the first finding that makes results wrong.
    """
    if not (user_code_names(study) or user_algorithm_packages(study)):
        return
    identity = json.dumps([tables_of(study), inputs, RESULTS, version("safevar_sumo")], sort_keys=True, default=str)
    name = hashlib.sha256(identity.encode()).hexdigest()
    marker = platformdirs.user_cache_path("safevar_sumo") / "checks" / name
    if name in _passed_checks or marker.exists():
        return
    evaluate_original(study, Task(study=study, inputs=inputs, purpose="check").packed, pool)
    _passed_checks.add(name)
    with suppress(OSError):  # without the marker, the next process checks again
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()
