"""Computes how far each characteristic may go alone, by scans of whole domains, in pairs, and all together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from safevar_sumo.analysis.evaluator import Evaluator, Progress, open_evaluator, silent
from safevar_sumo.analysis.tolerance import ToleranceOptions
from safevar_sumo.analysis.tolerance.joint import Pair, SafeBox, no_box, planes, safe_box
from safevar_sumo.errors import InputError, unknown
from safevar_sumo.metrics import RATING_POINTS, Unsafe
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import Evaluations, FloatArray, Outcome, finite_or_none
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.vehicles import Characteristic
from safevar_sumo.workers.evaluation import Pool

VALUES, RATED_VALUES = 201, 33
"""Number of values over the domain; fewer in a rated study, where each takes a whole matrix. The original value is added."""
FINER, ROUNDS, RATED_ROUNDS = 8, 4, 1
"""Number of parts into which an interval with a change of state is divided, and how often: to a 4096th of the distance of two values."""
ALMOST_ONE, SAME_POINTS = 1 - 1e-6, 1e-9
"""A loss above the first counts as one point; a loss up to the second is rounding."""
SAFE, UNSAFE, NOT_SIMULATED, INFEASIBLE = range(4)
Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class OneAtATimeScan:
    """One characteristic varies, all others are the original's.

    Attributes
    ----------
    profile
        Columns `value` [unit], `safety_degree` [m, or -m/s], `outcome`, `unsafe`, `valid`, in the order of the values; closer
        together where the state changes. A value that is not valid could not be simulated: it is neither safe nor unsafe.
    """

    characteristic: Characteristic
    profile: pd.DataFrame

    def _intervals(self, state: int) -> list[pd.DataFrame]:
        """The parts of the profile in one state, in the order of the values."""
        runs = groupby(enumerate(_states(self.profile).tolist()), key=lambda row: row[1])
        return [self.profile.iloc[[place for place, _ in run]] for value, run in runs if value == state]

    @property
    def _safe_part(self) -> pd.DataFrame | None:
        """The safe values around the original."""
        return next((part for part in self._intervals(SAFE) if (part["value"] == self.characteristic.original).any()), None)

    @property
    def safe(self) -> Interval | None:
        """The safe interval around the original; None if the original itself is unsafe."""
        return None if self._safe_part is None else _ends(self._safe_part)

    @property
    def margins(self) -> tuple[float | None, float | None]:
        """Safety degrees at the ends of the safe interval [m]."""
        if self._safe_part is None:
            return None, None
        low, high = self._safe_part[SAFETY_DEGREE].iloc[[0, -1]]
        return finite_or_none(low), finite_or_none(high)

    @property
    def unsafe(self) -> list[Interval]:
        """All unsafe intervals, from the first to the last unsafe value of each."""
        return [_ends(part) for part in self._intervals(UNSAFE)]

    @property
    def not_simulated(self) -> list[Interval]:
        """All intervals that could not be simulated, as `unsafe`."""
        return [_ends(part) for part in self._intervals(NOT_SIMULATED)]

    @property
    def infeasible(self) -> list[Interval]:
        """All intervals that violate a constraint of the study, as `unsafe`."""
        return [_ends(part) for part in self._intervals(INFEASIBLE)]

    @property
    def points(self) -> list[tuple[float, float]] | None:
        """Values in their order, each with the points that it keeps; None if the study is not rated."""
        if RATING_POINTS.name not in self.profile:
            return None
        return list(zip(self.profile["value"].tolist(), self.profile[RATING_POINTS.name].tolist(), strict=True))

    def first_loss(self, points: float = 0.0) -> float | None:
        """The value nearest to the original that loses more than `points` points; None if there is none."""
        pairs, original = self.points or [], self.characteristic.original
        full = next((kept for value, kept in pairs if value == original), math.nan)
        losing = [value for value, kept in pairs if full - kept > points + SAME_POINTS]
        return min(losing, key=lambda value: abs(value - original), default=None)

    def to_dict(self) -> dict[str, Any]:
        """The entry of `alone` in `tolerance --json`; for a rated study with the points, and the values that first lose some."""
        rated = {} if self.points is None else {
            "points": [list(pair) for pair in self.points], "any_lost": self.first_loss(), "first_point_lost": self.first_loss(ALMOST_ONE)}
        return {**rated,
                "characteristic": self.characteristic.name, "unit": self.characteristic.unit, "original": self.characteristic.original,
                "safe": None if self.safe is None else list(self.safe), "unsafe": [list(interval) for interval in self.unsafe],
                "not_simulated": [list(interval) for interval in self.not_simulated],
                **({"infeasible": [list(interval) for interval in self.infeasible]} if self.infeasible else {})}


def _ends(part: pd.DataFrame) -> Interval:
    return float(part["value"].iloc[0]), float(part["value"].iloc[-1])


def scan(evaluator: Evaluator, columns: Sequence[int], unsafe: Unsafe) -> list[OneAtATimeScan]:
    """Scan the domains of some characteristics, one at a time."""
    members = evaluator.characteristics.members
    number, rounds = (RATED_VALUES, RATED_ROUNDS) if is_rated(evaluator.study) else (VALUES, ROUNDS)
    values = [np.union1d(np.linspace(members[column].lower, members[column].upper, number), members[column].original) for column in columns]
    profiles = _evaluated(evaluator, columns, values, unsafe)
    for _ in range(rounds):
        inner = [_between_states(profile) for profile in profiles]
        if not any(map(len, inner)):
            break
        finer = _evaluated(evaluator, columns, inner, unsafe)
        profiles = [pd.concat([profile, more], ignore_index=True).sort_values("value", ignore_index=True)
                    for profile, more in zip(profiles, finer, strict=True)]
    return [OneAtATimeScan(characteristic=members[column], profile=profile) for column, profile in zip(columns, profiles, strict=True)]


def _between_states(profile: pd.DataFrame) -> FloatArray:
    """Values between two neighbours of different states."""
    values, states = profile["value"].to_numpy(), _states(profile)
    changes = np.flatnonzero(states[1:] != states[:-1])
    inner = values[changes][:, np.newaxis] + np.diff(values)[changes][:, np.newaxis] * np.arange(1, FINER) / FINER
    return np.setdiff1d(inner, values)


def _states(profile: pd.DataFrame) -> npt.NDArray[np.int_]:
    failed = np.where(profile["outcome"] == Outcome.INFEASIBLE, INFEASIBLE, NOT_SIMULATED)
    return np.where(profile["valid"], np.where(profile["unsafe"], UNSAFE, SAFE), failed)


def _evaluated(evaluator: Evaluator, columns: Sequence[int], values: Sequence[FloatArray], unsafe: Unsafe) -> list[pd.DataFrame]:
    """Profiles of characteristics at some values each."""
    ends = np.cumsum([len(group) for group in values])
    settings = np.tile(evaluator.characteristics.original, (ends[-1], 1))
    for column, group, end in zip(columns, values, ends, strict=True):
        settings[end - len(group):end, column] = group
    evaluations = evaluator.evaluate(settings, "one characteristic at a time")
    frame = pd.DataFrame({"value": np.concatenate(values), SAFETY_DEGREE: evaluations.f_safe, "outcome": evaluations.outcome,
                          "unsafe": unsafe.of(evaluations), "valid": evaluations.valid})
    if RATING_POINTS.name in evaluations.metrics:
        frame[RATING_POINTS.name] = evaluations.metrics[RATING_POINTS.name]
    return [frame.iloc[end - len(group):end].reset_index(drop=True) for group, end in zip(values, ends, strict=True)]


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """How far characteristics may go; `pairs` is None if the options do not ask for pairs."""

    study: Study
    unsafe: Unsafe
    original: Evaluations
    alone: list[OneAtATimeScan]
    pairs: list[Pair] | None
    joint: SafeBox

    @property
    def verdict(self) -> str:
        """One sentence on the characteristics and pairs that are unsafe by themselves."""
        single = [scan.characteristic.name for scan in self.alone if scan.unsafe]
        unsafe_pairs = [" with ".join(member.name for member in pair.characteristics) for pair in self.pairs or []
                        if pair.nearest is not None]
        if self.unsafe.of(self.original)[0]:
            return "The original vehicle itself is unsafe."
        if single:
            return f"Unsafe alone: {', '.join(single)}."
        if self.pairs is None:
            return "No single characteristic makes it unsafe."
        if unsafe_pairs:
            pairs = f"{len(unsafe_pairs)} of {len(self.pairs)} pairs: {', '.join(unsafe_pairs)}"
            return f"No single characteristic makes it unsafe, but {pairs}."
        return "No single characteristic and no pair makes it unsafe."

    def to_frame(self) -> pd.DataFrame:
        """One row for each characteristic alone.

        Columns: `characteristic`, `unit`, `original`, `lower` and `upper` of the domain, `safe_from`, `safe_to` [unit],
        `margin_from`, `margin_to`, the safety degrees there [m], and `unsafe` and `not_simulated`, lists of intervals.
        """
        return pd.DataFrame([{
            "characteristic": scan.characteristic.name, "unit": scan.characteristic.unit, "original": scan.characteristic.original,
            "lower": scan.characteristic.lower, "upper": scan.characteristic.upper,
            **dict(zip(("safe_from", "safe_to"), scan.safe or (None, None), strict=True)),
            **dict(zip(("margin_from", "margin_to"), scan.margins, strict=True)), "unsafe": scan.unsafe,
            "not_simulated": scan.not_simulated} for scan in self.alone])

    def to_dict(self) -> dict[str, Any]:
        """The JSON of `tolerance`."""
        return {"study": self.study.name, "unsafe": str(self.unsafe), "alone": [scan.to_dict() for scan in self.alone],
                "pairs": [pair.to_dict() for pair in self.pairs or []], "joint": self.joint.to_dict()}

    def __repr__(self) -> str:
        return f"<Tolerance of {self.study.name}, unsafe {self.unsafe}: {self.verdict}>"


def find_tolerances(study: Study, options: ToleranceOptions, *, pool: Pool | None = None, jobs: int | None = None,
                    progress: Progress = silent) -> Tolerance:
    """Find how far the characteristics of a study may go. The filter is not applied: this is about the vehicle, not about a search.

    Raises
    ------
    InputError
        If `unsafe` or a name cannot be used, or the study cannot be assembled.
    """
    columns = _columns(study, options.characteristics)
    if options.pairs and len(columns) < 2:
        raise InputError("pairs", "one characteristic makes no pair", "at least two characteristics")
    with open_evaluator(study, pool, jobs, progress) as evaluator:
        original = evaluator.original()
        unsafe = evaluator.criterion(options.unsafe, original)
        alone = scan(evaluator, columns, unsafe)
        pairs = planes(evaluator, columns, unsafe) if options.pairs else None
        has_box = not unsafe.of(original)[0] and not is_rated(study)  # in a rated study it would take thousands of whole matrices
        box = (safe_box(evaluator, columns, unsafe, _unsafe_settings(evaluator, alone, pairs or [])) if has_box
               else no_box(evaluator, columns))
    return Tolerance(study=study, unsafe=unsafe, original=original, alone=alone, pairs=pairs, joint=box)


def _columns(study: Study, characteristics: Sequence[str] | None) -> list[int]:
    names, chosen = list(study.vehicle.characteristics), characteristics or ()
    for name in chosen:
        if name not in names:
            raise unknown("characteristics", f"there is no characteristic {name!r}", name, names)
    if len(set(chosen)) < len(chosen):
        raise InputError("characteristics", f"{','.join(chosen)}: one is named twice", "each characteristic once")
    return [column for column, name in enumerate(names) if characteristics is None or name in characteristics]


def _unsafe_settings(evaluator: Evaluator, alone: Sequence[OneAtATimeScan], pairs: Sequence[Pair]) -> FloatArray:
    """The unsafe settings of scans and pairs, shape (K, n)."""
    changes = [{scan.characteristic.name: value} for scan in alone for interval in scan.unsafe for value in interval]
    changes += [dict(zip((member.name for member in pair.characteristics), pair.nearest, strict=True)) for pair in pairs if pair.nearest]
    original = dict(zip(evaluator.characteristics.names, evaluator.characteristics.original.tolist(), strict=True))
    return np.array([list({**original, **values}.values()) for values in changes]).reshape(-1, len(original))
