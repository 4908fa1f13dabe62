"""Computes how far each characteristic may go by itself (from scans of whole domains), in pairs, and with all others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from safevar_sumo.analysis.evaluator import Evaluator, open_evaluator
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.analysis.subject import study_in
from safevar_sumo.analysis.tolerance import ToleranceOptions
from safevar_sumo.analysis.tolerance.pairs import Pair, scan_pairs
from safevar_sumo.analysis.tolerance.safe_box import SafeBox, find_safe_box, no_safe_box, refuse_tied
from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.metrics import RATING_POINTS, Unsafe
from safevar_sumo.progress import Progress, show_no_progress
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import Evaluations, FloatArray, Outcome, finite_or_none
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.sumo.empty_road import driven_entry
from safevar_sumo.vehicles import Characteristic
from safevar_sumo.workers.evaluation import Pool

SCAN_VALUES, RATED_SCAN_VALUES = 201, 33
"""Number of values over the domain, besides the original value; fewer in a rated study, where each value takes a whole test matrix."""
PARTS_PER_ROUND, ROUNDS, RATED_ROUNDS = 8, 4, 1
"""Number of parts into which a round divides each interval with a change of state; number of rounds, and of rounds in a rated study."""
WHOLE_POINT_LOSS = 1 - 1e-6
"""A loss of more rating points than this counts as a whole point."""
POINT_ROUNDING = 1e-9
"""A loss of at most so many rating points is a rounding error."""
SAFE_STATE, UNSAFE_STATE, NOT_SIMULATED_STATE, INFEASIBLE_STATE = range(4)
"""States of a characteristic's value."""
Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class OneAtATimeScan:
    """The scan of one characteristic while all others keep their original values.

    Attributes
    ----------
    profile
        Columns `value` [unit], `safety_degree` [m, or -m/s], `outcome`, `unsafe`, `valid`, in the order of the values, which
        are closer together where the state changes. A value that is not valid was not simulated: it is neither safe nor unsafe.
    """

    characteristic: Characteristic
    profile: pd.DataFrame

    def _sections(self, state: int) -> list[pd.DataFrame]:
        """The sections of the profile in one state, in the order of the values."""
        groups = groupby(enumerate(_states(self.profile).tolist()), key=lambda item: item[1])
        return [self.profile.iloc[[index for index, _ in group]] for group_state, group in groups if group_state == state]

    @property
    def _safe_section(self) -> pd.DataFrame | None:
        """The safe values around the original."""
        return next((section for section in self._sections(SAFE_STATE) if (section["value"] == self.characteristic.original).any()), None)

    @property
    def safe(self) -> Interval | None:
        """The safe interval around the original; None if the original itself is unsafe."""
        return None if self._safe_section is None else _interval_of(self._safe_section)

    @property
    def margins(self) -> tuple[float | None, float | None]:
        """Safety degrees at the ends of the safe interval [m]."""
        if self._safe_section is None:
            return None, None
        low, high = self._safe_section[SAFETY_DEGREE].iloc[[0, -1]]
        return finite_or_none(low), finite_or_none(high)

    @property
    def unsafe(self) -> list[Interval]:
        """All unsafe intervals, from the first to the last unsafe value of each."""
        return [_interval_of(section) for section in self._sections(UNSAFE_STATE)]

    @property
    def not_simulated(self) -> list[Interval]:
        """All intervals that could not be simulated, in the form of `unsafe`."""
        return [_interval_of(section) for section in self._sections(NOT_SIMULATED_STATE)]

    @property
    def infeasible(self) -> list[Interval]:
        """All intervals that violate a constraint of the study, in the form of `unsafe`."""
        return [_interval_of(section) for section in self._sections(INFEASIBLE_STATE)]

    @property
    def points(self) -> list[tuple[float, float]] | None:
        """Values in ascending order, each with the vehicle's rating points at it; None if the study is not rated."""
        if RATING_POINTS.name not in self.profile:
            return None
        return list(zip(self.profile["value"].tolist(), self.profile[RATING_POINTS.name].tolist(), strict=True))

    def first_loss(self, points: float = 0.0) -> float | None:
        """The value nearest to the original that loses more than `points` rating points; None if no value does."""
        kept_points, original = self.points or [], self.characteristic.original
        original_points = next((kept for value, kept in kept_points if value == original), math.nan)
        losing_values = [value for value, kept in kept_points if original_points - kept > points + POINT_ROUNDING]
        return min(losing_values, key=lambda value: abs(value - original), default=None)

    def to_dict(self) -> dict[str, Any]:
        """An entry of `alone` in `tolerance --json`; in a rated study with points, and the values at which points are first lost."""
        rating_entries = {} if self.points is None else {
            "points": [list(pair) for pair in self.points], "any_lost": self.first_loss(),
            "first_point_lost": self.first_loss(WHOLE_POINT_LOSS)}
        return {**rating_entries,
                "characteristic": self.characteristic.name, "unit": self.characteristic.unit, "original": self.characteristic.original,
                "safe": None if self.safe is None else list(self.safe), "unsafe": [list(interval) for interval in self.unsafe],
                "not_simulated": [list(interval) for interval in self.not_simulated],
                **({"infeasible": [list(interval) for interval in self.infeasible]} if self.infeasible else {})}


def _interval_of(section: pd.DataFrame) -> Interval:
    return float(section["value"].iloc[0]), float(section["value"].iloc[-1])


def scan(evaluator: Evaluator, columns: Sequence[int], unsafe: Unsafe) -> list[OneAtATimeScan]:
    """Scan the domains of some characteristics, one at a time."""
    scanned = [evaluator.characteristics.members[column] for column in columns]
    value_count, rounds = (RATED_SCAN_VALUES, RATED_ROUNDS) if is_rated(evaluator.study) else (SCAN_VALUES, ROUNDS)
    values = [np.union1d(np.linspace(characteristic.lower, characteristic.upper, value_count), characteristic.original)
              for characteristic in scanned]
    profiles = _evaluate_profiles(evaluator, columns, values, unsafe)
    for _ in range(rounds):
        inner_values = [_values_between_states(profile) for profile in profiles]
        if not any(map(len, inner_values)):
            break
        inner_profiles = _evaluate_profiles(evaluator, columns, inner_values, unsafe)
        profiles = [pd.concat([profile, inner], ignore_index=True).sort_values("value", ignore_index=True)
                    for profile, inner in zip(profiles, inner_profiles, strict=True)]
    return [OneAtATimeScan(characteristic=characteristic, profile=profile)
            for characteristic, profile in zip(scanned, profiles, strict=True)]


def _values_between_states(profile: pd.DataFrame) -> FloatArray:
    """New values between neighbouring values of different states."""
    values, states = profile["value"].to_numpy(), _states(profile)
    rows = np.flatnonzero(states[1:] != states[:-1])
    inner = values[rows][:, np.newaxis] + np.diff(values)[rows][:, np.newaxis] * np.arange(1, PARTS_PER_ROUND) / PARTS_PER_ROUND
    return np.setdiff1d(inner, values)


def _states(profile: pd.DataFrame) -> npt.NDArray[np.int_]:
    invalid_states = np.where(profile["outcome"] == Outcome.INFEASIBLE, INFEASIBLE_STATE, NOT_SIMULATED_STATE)
    return np.where(profile["valid"], np.where(profile["unsafe"], UNSAFE_STATE, SAFE_STATE), invalid_states)


def _evaluate_profiles(evaluator: Evaluator, columns: Sequence[int], values: Sequence[FloatArray], unsafe: Unsafe) -> list[pd.DataFrame]:
    """The profile of each characteristic at its `values`."""
    ends = np.cumsum([len(column_values) for column_values in values])
    settings = np.tile(evaluator.characteristics.original, (ends[-1], 1))
    for column, column_values, end in zip(columns, values, ends, strict=True):
        settings[end - len(column_values):end, column] = column_values
    evaluations = evaluator.evaluate(settings, "one characteristic at a time")
    frame = pd.DataFrame({"value": np.concatenate(values), SAFETY_DEGREE: evaluations.f_safe, "outcome": evaluations.outcome,
                          "unsafe": unsafe.of(evaluations), "valid": evaluations.valid})
    if RATING_POINTS.name in evaluations.metrics:
        frame[RATING_POINTS.name] = evaluations.metrics[RATING_POINTS.name]
    return [frame.iloc[end - len(column_values):end].reset_index(drop=True) for column_values, end in zip(values, ends, strict=True)]


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """How far characteristics may go: each by itself (`alone`), two together (`pairs`, None if not requested), and all (`joint`)."""

    study: Study
    unsafe: Unsafe
    original: Evaluations
    alone: list[OneAtATimeScan]
    pairs: list[Pair] | None
    joint: SafeBox
    no_verdict: str = ""

    @property
    def verdict(self) -> str:
        """One sentence on the characteristics and pairs that are unsafe by themselves."""
        single_names = [scan.characteristic.name for scan in self.alone if scan.unsafe]
        unsafe_pairs = [" with ".join(characteristic.name for characteristic in pair.characteristics) for pair in self.pairs or []
                        if pair.nearest is not None]
        if self.no_verdict:
            return self.no_verdict
        if self.unsafe.of(self.original)[0]:
            return "The original vehicle itself is unsafe."
        if single_names:
            return f"Unsafe alone, all others as in the original: {', '.join(single_names)}."
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
        return {"study": self.study.name, **driven_entry(self.no_verdict), "unsafe": str(self.unsafe),
                "alone": [scan.to_dict() for scan in self.alone],
                "pairs": [pair.to_dict() for pair in self.pairs or []], "joint": self.joint.to_dict()}

    def __repr__(self) -> str:
        return f"<Tolerance of {self.study.name}, unsafe {self.unsafe}: {self.verdict}>"


def find_tolerances(source: Study | Case, options: ToleranceOptions, *, pool: Pool | None = None, jobs: int | None = None,
                    progress: Progress = show_no_progress) -> Tolerance:
    """Find how far the characteristics of a study may go. The filter is not applied, as the question is about the vehicle.

    The joint box holds none of the unsafe solutions of results.

    Raises
    ------
    InputError
        If `unsafe` or a name cannot be used, the study cannot be assembled, or hardly any setting of a box satisfies its constraints.
    """
    study = study_in(source)
    columns = _columns_of(study, options.characteristics)
    if options.pairs and len(columns) < 2:
        raise InputError("pairs", "one characteristic makes no pair", "at least two characteristics")
    with open_evaluator(study, pool, jobs, progress) as evaluator:
        original = evaluator.evaluate_original()
        unsafe = evaluator.choose_criterion(options.unsafe, source, original)
        needs_box = not unsafe.of(original)[0] and not is_rated(study)  # a box of a rated study would take thousands of whole test matrices
        if needs_box:
            refuse_tied(evaluator, columns)
        scans = scan(evaluator, columns, unsafe)
        pairs = scan_pairs(evaluator, columns, unsafe) if options.pairs else None
        solutions = None if isinstance(source, Study) else source.solutions[unsafe.rows(source.solutions)]
        box = (find_safe_box(evaluator, columns, unsafe, _unsafe_settings(evaluator, scans, pairs or []), solutions) if needs_box
               else no_safe_box(evaluator, columns))
        return Tolerance(study=study, unsafe=unsafe, original=original, alone=scans, pairs=pairs, joint=box,
                         no_verdict=evaluator.no_verdict)


def _columns_of(study: Study, characteristics: Sequence[str] | None) -> list[int]:
    names, chosen = list(study.vehicle.characteristics), characteristics or ()
    for name in chosen:
        if name not in names:
            raise unknown_name("characteristics", f"there is no characteristic {name!r}", name, names)
    if len(set(chosen)) < len(chosen):
        raise InputError("characteristics", f"{','.join(chosen)}: a characteristic is named twice", "each characteristic once")
    return [column for column, name in enumerate(names) if characteristics is None or name in characteristics]


def _unsafe_settings(evaluator: Evaluator, scans: Sequence[OneAtATimeScan], pairs: Sequence[Pair]) -> FloatArray:
    """The K unsafe settings of scans and pairs, shape (K, n)."""
    changes = [{scan.characteristic.name: value} for scan in scans for interval in scan.unsafe for value in interval]
    changes += [dict(zip((characteristic.name for characteristic in pair.characteristics), pair.nearest, strict=True))
                for pair in pairs if pair.nearest]
    original = dict(zip(evaluator.characteristics.names, evaluator.characteristics.original.tolist(), strict=True))
    return np.array([list({**original, **values}.values()) for values in changes]).reshape(-1, len(original))
