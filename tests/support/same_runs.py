"""Runs that must be the same to the bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from safevar_sumo.records import RESULT_ROUNDING, FloatArray
from safevar_sumo.sumo import simulate_all_points
from safevar_sumo.sumo.system import System


def assert_same(system: System, settings: FloatArray) -> list[str]:
    """Assert that recorded scenes and SUMO give the same bits, or what is computed of a scene the
    same to `ROUNDING`; returns all outcomes.
    """
    outcomes = []
    tolerance = RESULT_ROUNDING if len(system.characteristics.scenario) else 0.0
    results = (
        simulate_all_points(replace(system, in_sumo=in_sumo), settings)
        for in_sumo in (False, True)
    )
    for recorded, copies in zip(*results, strict=True):
        theirs_by_name = copies.evaluations.results
        pairs = [
            (values, theirs_by_name[name])
            for name, values in recorded.evaluations.results.items()
        ]
        pairs += zip(recorded.runs.contact, copies.runs.contact, strict=True)
        pairs += [
            (getattr(recorded.runs, name), getattr(copies.runs, name))
            for name in ("relative_speed", "warning_ttc")
        ]
        for ours, theirs in pairs:
            if np.asarray(ours).dtype.kind == "f":
                np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance)
            else:
                np.testing.assert_array_equal(ours, theirs)
        outcomes += recorded.evaluations.outcome.tolist()
    return outcomes
