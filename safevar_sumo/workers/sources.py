"""Files that a study's results depend on beside its own: those that its models read, and those that its parameters name."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from safevar_sumo.plugins import Files, digest_of, digests, located, named_files
from safevar_sumo.study import Study, foreign_names
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.evaluation import Pool, packed
from safevar_sumo.workers.identity import Inputs, networks_of
from safevar_sumo.workers.local import result_of
from safevar_sumo.workers.retrying import RetryingPool

_read: dict[tuple[bytes, str], Files] = {}
"""Files that models have read in this process, by packed study and working directory."""


def inputs_of(study: Study, pool: Pool) -> Inputs:
    """Digests of the files that every worker must have alike, by layer and name; raises as `sources_of`."""
    return {"network": networks_of(assemble(study)), "sources": sources_of(study, pool)}


def sources_of(study: Study, pool: Pool) -> Files:
    """Digests, by name, of the files that models from outside read in one run of the original vehicle, and of files that parameters name.

    The run takes place in a worker that loads everything anew.

    Raises
    ------
    SafevarError
        If the original vehicle cannot be simulated.
    """
    files = digests(named_files(_parameters(study), study.origin.places), study.origin.places)
    if foreign_names(study):
        work = packed(study, {}, afresh=True)
        key = work, os.getcwd()
        if any(digest_of(located(name, study.origin.places)) != digest for name, digest in _read.get(key, {"": "never read"}).items()):
            original = CharacteristicSet.of(study.vehicle.characteristics).original[np.newaxis]
            _read[key] = dict(result_of(RetryingPool(pool, study).submit(work, original, must_succeed=True)).files)
        files |= _read[key]
    return dict(sorted(files.items()))


def _parameters(study: Study) -> list[Any]:
    """All parameters of a study's models and algorithms."""
    tests = [] if study.matrix is None else study.matrix.tests
    return [study.vehicle.parameters, study.ads.parameters, study.scenario.parameters, study.search.parameters,
            *(table for test in tests for table in (test.parameters, test.over))]
