"""The problem of a repair: the promised part of the domain, and the parameters of the ADS that may change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import asdict, replace as replace_in

from safevar_sumo.ads import ADS
from safevar_sumo.ads.varied import CHANGEABLE
from safevar_sumo.analysis.evaluator import Evaluator, sobol_points
from safevar_sumo.analysis.preventability import approach_parameters
from safevar_sumo.campaign.evaluation import Selection
from safevar_sumo.errors import InputError, UserCodeError, unknown_name
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, differences
from safevar_sumo.study import SAFETY_DEGREE, FreeParameter, ModelTable, Study, limits_of, unit_text
from safevar_sumo.study.limits import limit_mistakes
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet

DEFAULT_MARGIN = 0.3
"""Safety degree to keep of a study that states no error of its model [m]."""
MAX_PARAMETERS = 8
ARRAY_CHECKS = 8
"""Sets of parameters with which a user's ADS is tried as one for all vehicles."""
MAX_CORNERS = 256
"""Largest number of corners of the promised part; of a part with more, so many random ones are taken."""
PREFIX = "ads.parameters."
ALL = "all"
"""The promise of the whole domain."""


class Parameter(NamedTuple):
    """A parameter of the ADS that may change, with its bounds and the value of today, all in `unit`."""

    name: str
    unit: str
    meaning: str
    lower: float
    upper: float
    log: bool
    today: float

    @property
    def suffix(self) -> str:
        """The unit as text after a number."""
        return unit_text(self.unit)


@dataclass(frozen=True)
class Promise:
    """The promised part of the domain: a box with the ends `lower` and `upper`, shape (n,)."""

    characteristics: CharacteristicSet
    lower: FloatArray
    upper: FloatArray

    @classmethod
    def of(cls, study: Study, texts: Sequence[str]) -> Promise:
        """The promise that texts such as "treadDepth >= 2" state, or the study's own without any.

        Raises
        ------
        InputError
            If a promise cannot be read, names no characteristic, or lies outside its domain.
        """
        one, rows, promise = CharacteristicSet.of(study), study.vehicle.characteristics, study.repair.promise
        if ALL in texts or (promise == ALL and not texts):
            if len(texts) > 1:
                raise InputError("promise", f"{ALL} beside another promise", f"{ALL} alone, or limits")
            return cls(one, one.lower.copy(), one.upper.copy())
        stated = promise if promise and isinstance(promise, dict) else study.limits
        for mistake in limit_mistakes(study.source, rows, stated, "repair.promise."):
            raise mistake
        limits = limits_of(texts, rows, None if texts else stated, "promise")
        if not limits:
            raise InputError(
                "promise", "nothing is promised", f'"NAME >= X" with one of {", ".join(one.names)}; or {ALL}'
            )
        ends = np.array(
            [limits[name].interval(row) if name in limits else (row.original,) * 2 for name, row in rows.items()]
        )
        return cls(one, *ends.T.copy())

    @property
    def columns(self) -> list[int]:
        """Columns of the characteristics that may wear."""
        return np.flatnonzero(self.upper > self.lower).tolist()

    def settings(self, points: FloatArray) -> FloatArray:
        """Settings at points of the unit cube of `columns`, shape (M, n)."""
        settings = np.tile(self.characteristics.original, (len(points), 1))
        lower, width = self.lower[self.columns], (self.upper - self.lower)[self.columns]
        settings[:, self.columns] = lower + points * width
        return settings

    def corners(self, seed: int) -> FloatArray:
        """The corners of the part, shape (M, n), or `MAX_CORNERS` of them."""
        dimensions = len(self.columns)
        if 2**dimensions <= MAX_CORNERS:
            return self.settings(np.indices((2,) * dimensions).reshape(dimensions, -1).T.astype(float))
        return self.settings(np.round(sobol_points(MAX_CORNERS, dimensions, seed)))

    def holds(self, settings: FloatArray) -> BoolArray:
        """Which settings lie in the part."""
        return np.asarray(((settings >= self.lower) & (settings <= self.upper)).all(axis=1))

    def shrunk(self, share: float) -> Promise:
        """The part whose ends lie at a share of the way from the original."""
        original = self.characteristics.original
        return replace(
            self, lower=original + share * (self.lower - original), upper=original + share * (self.upper - original)
        )

    def to_dict(self) -> dict[str, list[float]]:
        """The ends of every characteristic that may wear."""
        return {
            self.characteristics.names[column]: [float(self.lower[column]), float(self.upper[column])]
            for column in self.columns
        }

    @property
    def in_words(self) -> str:
        """The worn ends, such as `treadDepth >= 2 mm, brakeTorque >= 0.8`."""
        texts = []
        for column in self.columns:
            one = self.characteristics.members[column]
            ends = [
                f"{sign} {end:.5g}{one.suffix}"
                for sign, end in ((">=", self.lower[column]), ("<=", self.upper[column]))
                if end != one.original
            ]
            texts.append(f"{one.name} {' and '.join(ends)}")
        return ", ".join(texts)


def parameters_of(study: Study, names: Sequence[str]) -> list[Parameter]:
    """The parameters that may change: `names`, or all under [repair], or those that come with a shipped ADS.

    Raises
    ------
    InputError
        If there is none, one is unknown, or its bounds exclude the value of today.
    """
    source = study.source
    stated = {name.removeprefix(PREFIX): row for name, row in study.repair.parameters.items()}
    table: dict[str, FreeParameter] = stated or CHANGEABLE.get(study.ads.model, {})
    if not table:
        problem = f"ads.model = {study.ads.model!r}: no parameter may change"
        raise InputError(source, problem, "parameters under [repair], such as gain = { lower, upper, unit, meaning }")
    for name in names:
        if name not in table:
            raise unknown_name("change", f"{study.ads.model} has no parameter {name!r} that may change", name, table)
    chosen = [name for name in table if name in (names or table)]
    if len(chosen) > MAX_PARAMETERS:
        raise InputError(source, f"repair: {len(chosen)} parameters may change", f"at most {MAX_PARAMETERS}")
    ads: Any = assemble(study).ads
    parameters = []
    for name in chosen:
        row, today = table[name], study.ads.parameters.get(name, getattr(getattr(ads, "_ads", ads), name, None))
        if isinstance(today, bool) or not isinstance(today, int | float):
            raise InputError(
                source, f"repair.{name}: ads.parameters.{name} = {today!r}", "a number, the value of today"
            )
        if not stated:
            row = replace_in(row, lower=min(row.lower, today), upper=max(row.upper, today))
        if not row.lower < row.upper or not row.lower <= today <= row.upper or (row.log and row.lower <= 0):
            problem = f"repair.{name}: lower = {row.lower:g}, upper = {row.upper:g}, and today it is {today:g}"
            raise InputError(source, problem, "lower < upper, and bounds that hold the value of today")
        facts = {key: value for key, value in asdict(row).items() if key != "own"}
        parameters.append(Parameter(name=name, today=float(today), **facts))
    return parameters


class Failure(NamedTuple):
    """A vehicle, shape (n,), that a set of parameters does not keep safe, at the number of a point."""

    setting: FloatArray
    point: int


@dataclass(kw_only=True)
class Problem:
    """A study's ADS with parameters that may change, and the safety degree `margin` to keep within a promise.

    Sets of parameters are arrays of shape (M, P) in [0, 1], shares of the range from lower to upper bound.
    """

    evaluator: Evaluator
    promise: Promise
    parameters: list[Parameter]
    margin: float

    @property
    def study(self) -> Study:
        return self.evaluator.study

    @cached_property
    def today(self) -> FloatArray:
        """The parameters of today, shape (P,)."""
        ends = np.array([(one.lower, one.upper, one.today) for one in self.parameters])
        log = np.array([one.log for one in self.parameters])[:, np.newaxis]
        lower, upper, today = np.where(log, np.log(np.where(log, ends, 1.0)), ends).T
        return np.asarray((today - lower) / (upper - lower))

    def values(self, shares: FloatArray) -> FloatArray:
        """The parameters' values in their units; today's exactly where a share is today's."""
        columns = []
        for one, share, today in zip(self.parameters, shares.T, self.today, strict=True):
            if one.log:
                value = one.lower * (one.upper / one.lower) ** share
            else:
                value = one.lower + share * (one.upper - one.lower)
            columns.append(np.where(share == today, one.today, np.clip(value, one.lower, one.upper)))
        return np.stack(columns, axis=1)

    def evaluate(self, shares: FloatArray, wear: FloatArray, stage: str, points: Sequence[int] = ()) -> Evaluations:
        """Row i: parameters i with vehicle i, at the worst of some points; without any, at the worst of all."""
        return self._select(shares, wear, stage, points, arrays=self.takes_arrays)

    def _select(
        self, shares: FloatArray, wear: FloatArray, stage: str, points: Sequence[int], *, arrays: bool
    ) -> Evaluations:
        selection = Selection(tuple(one.name for one in self.parameters), tuple(points), arrays)
        return self.evaluator.evaluate_selection(np.concatenate([wear, self.values(shares)], axis=1), selection, stage)

    @cached_property
    def takes_arrays(self) -> bool:
        """Whether one ADS may drive vehicles with different parameters: a shipped one, or the user's if a sample has
        the same results to the bit. Otherwise each set of parameters has an own instance.
        """
        table = self.study.ads
        if table.kind or table.model in ADS:
            return not table.kind
        shares = sobol_points(ARRAY_CHECKS, len(self.parameters), 0)
        wear = self.promise.settings(sobol_points(ARRAY_CHECKS, len(self.promise.columns), 1))
        stage = "does the driving system take arrays?"
        try:
            together = self._select(shares, wear, stage, (), arrays=True)
        except UserCodeError:
            return False
        return not any(differences(self._select(shares, wear, stage, (), arrays=False).results, together.results))

    def degrees(self, shares: FloatArray, wear: FloatArray, stage: str, points: Sequence[int] = ()) -> FloatArray:
        """Safety degrees as `evaluate`; infinite without a conflict, and minus infinity where nothing was simulated."""
        return degrees_of(self.evaluate(shares, wear, stage, points))

    def draw(self, number: int, rng: np.random.Generator) -> FloatArray:
        """Vehicles drawn uniformly in the feasible part of the promise, shape (number, n)."""
        dimensions = len(self.promise.columns)
        return self.feasible(lambda count: self.promise.settings(rng.random((count, dimensions))), number)

    def feasible(self, draw: Any, number: int) -> FloatArray:
        return self.evaluator.region.draw_feasible(draw, number) if self.evaluator.region else draw(number)

    @cached_property
    def best_driver(self) -> Evaluator:
        ads = ModelTable(model="full_braking", parameters=approach_parameters(assemble(self.study)))
        return self.evaluator.for_study(replace_in(self.study, ads=ads), verified=0)

    def repairable(self, wear: FloatArray, stage: str = "full braking") -> BoolArray:
        """Which vehicles full braking at the first possible moment, or the ADS of today, keeps safe."""
        is_safe = degrees_of(self.best_driver.evaluate(wear, stage)) >= self.margin
        rest = np.flatnonzero(~is_safe)
        if len(rest):
            is_safe[rest] = self.degrees(np.tile(self.today, (len(rest), 1)), wear[rest], stage) >= self.margin
        return is_safe


def degrees_of(evaluations: Evaluations) -> FloatArray:
    """Safety degrees [m, or -m/s], shape (M,); infinite without a conflict, minus infinity without a valid result."""
    degrees = np.where(np.isnan(evaluations.f_safe), np.inf, evaluations.f_safe)
    return np.where(evaluations.valid, degrees, -np.inf)


def default_margin(study: Study) -> float:
    """The model's error of a study that states one, else `DEFAULT_MARGIN` [m]."""
    return study.model_error.get(SAFETY_DEGREE, DEFAULT_MARGIN)
