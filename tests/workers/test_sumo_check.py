"""Settings that SUMO itself cannot simulate are no contradiction of the recorded scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.records import Outcome
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import assemble
from safevar_sumo.workers.sumo_check import refuse_unlike_sumo


def test_settings_that_all_fail_in_sumo_lack_the_users_metrics() -> None:
    study = load_study("smoke")
    system = assemble(study)
    once = evaluate(system, system.characteristics.original[np.newaxis])
    recorded = replace(once, metrics={**once.metrics, "mine": np.array([1.0])})
    failed = replace(once, outcome=np.array([Outcome.SIMULATOR_ERROR.value], dtype="U16"))
    refuse_unlike_sumo(study, recorded, failed)
    with pytest.raises(InputError, match=r"mine is 1\.0 in the recorded scene and 2\.0 in SUMO"):
        refuse_unlike_sumo(study, recorded, replace(recorded, metrics={**once.metrics, "mine": np.array([2.0])}))
