"""Scans of the domains of characteristics one at a time; all others keep their original values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.sampling import Interval
from safevar_sumo.records import FloatArray
from safevar_sumo.study import SAFETY_DEGREE
from safevar_sumo.vehicles import Characteristic

SCAN_VALUES = 201
"""Number of values over the domain, besides the original."""
PARTS_PER_ROUND = 8
"""Number of parts into which a round divides each interval with a change of state."""
ROUNDS = 4
"""Number of such rounds."""
SCAN_STAGE = "one characteristic at a time"


class OneAtATimeScan(NamedTuple):
    """The scan of one characteristic.

    Attributes
    ----------
    profile
        Columns `value` [unit], `safety_degree` [m, or -m/s] and `state` ("safe", "unsafe",
        "not_simulated" or "infeasible"), in the order of the values, which are closer together
        where the state changes.
    """

    characteristic: Characteristic
    profile: pd.DataFrame

    @property
    def intervals(self) -> pd.DataFrame:
        """The runs of neighbouring values of one state: `state`, the first value `low` and the last
        one `high`.
        """
        states = self.profile["state"]
        values = self.profile["value"]
        is_first = states != states.shift()
        is_last = states != states.shift(-1)
        ends = {"low": values[is_first].to_numpy(), "high": values[is_last].to_numpy()}
        return pd.DataFrame({"state": states[is_first].to_numpy(), **ends})

    def of_state(self, state: str) -> list[Interval]:
        """The intervals of a state."""
        frame = self.intervals
        return list(
            frame.loc[frame["state"] == state, ["low", "high"]].itertuples(index=False, name=None)
        )

    @property
    def safe(self) -> Interval | None:
        """The safe interval around the original; None if the original itself is unsafe."""
        original = self.characteristic.original
        return next(
            (ends for ends in self.of_state("safe") if ends[0] <= original <= ends[1]), None
        )

    def degree(self, value: float) -> float:
        """The safety degree at a value of the profile [m, or -m/s]."""
        return float(self.profile.set_index("value")[SAFETY_DEGREE][value])


def scan(
    evaluator: Evaluator,
    columns: Sequence[int],
    unsafe: Unsafe,
    within: Sequence[Interval] | None = None,
    number: int | None = None,
) -> list[OneAtATimeScan]:
    """Scan the domains of some characteristics, or intervals within them, one at a time; at
    `number` values, by default `SCAN_VALUES`.
    """
    scanned = [evaluator.characteristics.members[column] for column in columns]
    rounds = ROUNDS if evaluator.left is None else 0  # none for a rough answer
    # All scans together take a sixth of few simulations.
    number = evaluator.at_most(number or SCAN_VALUES, 6 * len(scanned))
    ends = [(item.lower, item.upper) for item in scanned] if within is None else within
    values = [
        np.union1d(np.linspace(*end, number), item.original)
        for item, end in zip(scanned, ends, strict=True)
    ]
    profiles = _evaluate_profiles(evaluator, columns, values, unsafe)
    for _ in range(rounds):
        values = [_values_between_states(profile) for profile in profiles]
        if not any(map(len, values)):
            break
        finer_profiles = _evaluate_profiles(evaluator, columns, values, unsafe)
        profiles = [
            pd.concat(coarse_and_fine, ignore_index=True).sort_values("value", ignore_index=True)
            for coarse_and_fine in zip(profiles, finer_profiles, strict=True)
        ]
    return list(map(OneAtATimeScan, scanned, profiles))


def _values_between_states(profile: pd.DataFrame) -> FloatArray:
    """New values that divide the intervals between neighbouring values of different states."""
    values = profile["value"].to_numpy()
    states = profile["state"].to_numpy()
    rows = np.flatnonzero(states[1:] != states[:-1])[:, np.newaxis]
    inner = (
        values[rows]
        + (values[rows + 1] - values[rows]) * np.arange(1, PARTS_PER_ROUND) / PARTS_PER_ROUND
    )
    return np.setdiff1d(inner, values)


def _evaluate_profiles(
    evaluator: Evaluator, columns: Sequence[int], values: Sequence[FloatArray], unsafe: Unsafe
) -> list[pd.DataFrame]:
    """The profile of each characteristic at its `values`."""
    sizes = list(map(len, values))
    ends = np.cumsum(sizes)[:-1]
    settings = np.tile(evaluator.characteristics.original, (sum(sizes), 1))
    settings[np.arange(len(settings)), np.repeat(columns, sizes)] = np.concatenate(values)
    evaluations = evaluator.evaluate_over_encounters(settings, unsafe, SCAN_STAGE)
    state = np.select(
        [evaluations.infeasible, ~evaluations.valid, unsafe.of(evaluations)],
        ["infeasible", "not_simulated", "unsafe"],
        "safe",
    )
    frame = pd.DataFrame(
        {"value": np.concatenate(values), SAFETY_DEGREE: evaluations.f_safe, "state": state}
    )
    return [
        frame.iloc[rows].reset_index(drop=True) for rows in np.split(np.arange(len(frame)), ends)
    ]
