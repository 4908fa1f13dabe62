"""One characteristic alone: its whole domain scanned, and every change between safe and unsafe found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from safevar_sumo.analysis.criterion import Unsafe
from safevar_sumo.analysis.evaluator import Bench
from safevar_sumo.analysis.explain.causes import number
from safevar_sumo.records import FloatArray
from safevar_sumo.study import SAFETY_DEGREE
from safevar_sumo.vehicles import Characteristic

VALUES = 201
"""Values over the domain; the original comes on top."""
FINER, ROUNDS = 8, 4
"""Into how many parts the place of a change is divided, and how often: to a 4096th of the distance of two values."""

SAFE, UNSAFE, NOT_SIMULATED = range(3)


@dataclass(frozen=True, kw_only=True)
class OneAtATimeScan:
    """What one characteristic does while all others are the original's.

    Attributes
    ----------
    profile
        Columns `value` [unit], `safety_degree` [m, or -m/s], `outcome`, `unsafe`, `valid`, in the order of the values; closer
        together where the state changes. What is not valid could not be simulated: it is neither safe nor unsafe.
    """

    characteristic: Characteristic
    profile: pd.DataFrame

    @property
    def _runs(self) -> list[pd.DataFrame]:
        """The profile cut where the state changes: safe, unsafe, not simulated."""
        places = [[place for place, _ in run] for _, run in groupby(enumerate(_states(self.profile).tolist()), key=lambda one: one[1])]
        return [self.profile.iloc[run] for run in places]

    @property
    def _around(self) -> pd.DataFrame | None:
        """The safe values around the original."""
        return next((run for run in self._runs if _states(run)[0] == SAFE and (run["value"] == self.characteristic.original).any()), None)

    @property
    def safe(self) -> tuple[float, float] | None:
        """The safe interval around the original; None if the original itself is unsafe."""
        around = self._around
        return None if around is None else (float(around["value"].iloc[0]), float(around["value"].iloc[-1]))

    @property
    def margins(self) -> tuple[float | None, float | None]:
        """Safety degrees at the ends of the safe interval [m]."""
        around = self._around
        return (None, None) if around is None else (number(around[SAFETY_DEGREE].iloc[0]), number(around[SAFETY_DEGREE].iloc[-1]))

    @property
    def unsafe(self) -> list[tuple[float, float]]:
        """All unsafe intervals, from the first to the last unsafe value of each."""
        return self._intervals(UNSAFE)

    @property
    def not_simulated(self) -> list[tuple[float, float]]:
        """All intervals that could not be simulated, as `unsafe`."""
        return self._intervals(NOT_SIMULATED)

    def _intervals(self, state: int) -> list[tuple[float, float]]:
        return [(float(run["value"].iloc[0]), float(run["value"].iloc[-1])) for run in self._runs if _states(run)[0] == state]

    def record(self) -> dict[str, Any]:
        """As `tolerance --json` prints it."""
        return {"characteristic": self.characteristic.name, "unit": self.characteristic.unit, "original": self.characteristic.original,
                "safe": None if self.safe is None else list(self.safe), "unsafe": [list(interval) for interval in self.unsafe],
                "not_simulated": [list(interval) for interval in self.not_simulated]}


def scan(bench: Bench, columns: Sequence[int], unsafe: Unsafe) -> list[OneAtATimeScan]:
    """Scan the domains of some characteristics, one at a time."""
    members = bench.characteristics.members
    values = [np.union1d(np.linspace(members[column].lower, members[column].upper, VALUES), members[column].original) for column in columns]
    profiles = _evaluated(bench, columns, values, unsafe)
    for _ in range(ROUNDS):
        between = [_where_it_changes(profile) for profile in profiles]
        if not any(map(len, between)):
            break
        finer = _evaluated(bench, columns, between, unsafe)
        profiles = [pd.concat([profile, more], ignore_index=True).sort_values("value", ignore_index=True)
                    for profile, more in zip(profiles, finer, strict=True)]
    return [OneAtATimeScan(characteristic=members[column], profile=profile) for column, profile in zip(columns, profiles, strict=True)]


def _where_it_changes(profile: pd.DataFrame) -> FloatArray:
    """Values between two neighbours of different states."""
    values, states = profile["value"].to_numpy(), _states(profile)
    changes = np.flatnonzero(states[1:] != states[:-1])
    inner = values[changes][:, np.newaxis] + np.diff(values)[changes][:, np.newaxis] * np.arange(1, FINER) / FINER
    return np.setdiff1d(inner, values)


def _states(profile: pd.DataFrame) -> npt.NDArray[np.int_]:
    """Whether each value of a profile is `SAFE`, `UNSAFE` or `NOT_SIMULATED`."""
    return np.where(profile["valid"], np.where(profile["unsafe"], UNSAFE, SAFE), NOT_SIMULATED)


def _evaluated(bench: Bench, columns: Sequence[int], values: Sequence[FloatArray], unsafe: Unsafe) -> list[pd.DataFrame]:
    """Profiles of characteristics at some values each."""
    ends = np.cumsum([len(group) for group in values])
    settings = np.tile(bench.characteristics.original, (ends[-1], 1))
    for column, group, end in zip(columns, values, ends, strict=True):
        settings[end - len(group):end, column] = group
    evaluations = bench.evaluate(settings, "one characteristic at a time")
    frame = pd.DataFrame({"value": np.concatenate(values), SAFETY_DEGREE: evaluations.f_safe, "outcome": evaluations.outcome,
                          "unsafe": unsafe.of(evaluations), "valid": evaluations.valid})
    return [frame.iloc[end - len(group):end].reset_index(drop=True) for group, end in zip(values, ends, strict=True)]
