"""The problem of a repair: the promised wear, and the parameters of the ADS that may change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec.structs import asdict, replace as replace_in

from safevar_sumo.ads import ADS
from safevar_sumo.ads.varied import CHANGEABLE
from safevar_sumo.analysis.evaluator import Evaluator, sobol_points
from safevar_sumo.analysis.preventability import approach_parameters
from safevar_sumo.campaign.evaluation import Selection
from safevar_sumo.errors import InputError, UserCodeError, unknown_name
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, differences
from safevar_sumo.study import FreeParameter, ModelTable, Study, limits_of
from safevar_sumo.study.characteristics import limit_mistakes
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet, FeasibleRegion

MAX_PARAMETERS = 8
DIGITS = 4
"""Significant digits of a changed parameter, or of its range if that needs more decimals: the value that is printed is
the one that has been tried.
"""
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


@dataclass(frozen=True)
class Promise:
    """The promised wear: the characteristics that may wear, with the promised ends as their domains.

    Worn vehicles are arrays of shape (M, w) of these; all other characteristics stay as in the original.
    """

    region: FeasibleRegion
    worn: CharacteristicSet

    @classmethod
    def of(cls, study: Study, region: FeasibleRegion, texts: Sequence[str]) -> Promise:
        """The promise that texts such as "treadDepth >= 2" state, or the study's own without any.

        Raises
        ------
        InputError
            If a promise cannot be read, names no characteristic, lies outside its domain, or lets nothing wear.
        """
        rows, stated = study.vehicle.characteristics, study.repair.promise
        if ALL in texts or (stated == ALL and not texts):
            if len(texts) > 1:
                raise InputError("promise", f"{ALL} beside another promise", f"{ALL} alone, or limits")
            return cls(region, region.characteristics)
        own = stated if stated and isinstance(stated, dict) else study.limits
        for mistake in limit_mistakes(study.source, rows, own, "repair.promise."):
            raise mistake
        limits = limits_of(texts, rows, None if texts else own, "promise")
        if not limits:
            raise InputError("promise", "nothing is promised", f'"NAME >= X" with one of {", ".join(rows)}; or {ALL}')
        ends = {name: limit.interval(rows[name]) for name, limit in limits.items()}
        worn = [
            replace(one, lower=ends[one.name][0], upper=ends[one.name][1])
            for one in region.characteristics
            if one.name in ends and ends[one.name][0] < ends[one.name][1]
        ]
        if not worn:
            raise InputError("promise", "promises a new vehicle only", "a limit short of the original's value")
        return cls(region, CharacteristicSet(tuple(worn)))

    @cached_property
    def columns(self) -> list[int]:
        """Columns of the characteristics that may wear, among all."""
        return [self.region.characteristics.names.index(name) for name in self.worn.names]

    def settings(self, vehicles: FloatArray) -> FloatArray:
        """Worn vehicles with all characteristics of the study, shape (M, n)."""
        settings = np.tile(self.region.characteristics.original, (len(vehicles), 1))
        settings[:, self.columns] = vehicles
        return settings

    def at(self, points: FloatArray) -> FloatArray:
        """Worn vehicles at points of the unit cube."""
        return self.worn.lower + points * (self.worn.upper - self.worn.lower)

    def feasible(self, vehicles: FloatArray) -> FloatArray:
        """Those of M worn vehicles that keep the study's constraints."""
        return vehicles[self.region.feasible(self.settings(vehicles))]

    def draw(self, number: int, rng: np.random.Generator) -> FloatArray:
        """Vehicles drawn uniformly in the feasible part."""
        size = len(self.worn)
        settings = self.region.draw_feasible(lambda count: self.settings(self.at(rng.random((count, size)))), number)
        return np.asarray(settings[:, self.columns])

    def spread(self, number: int, seed: int) -> FloatArray:
        """Distinct feasible vehicles: the corners, or `MAX_CORNERS` of them, and `number` Sobol points."""
        size = len(self.worn)
        if 2**size <= MAX_CORNERS:
            corners = np.indices((2,) * size).reshape(size, -1).T.astype(float)
        else:
            corners = np.round(sobol_points(MAX_CORNERS, size, seed))
        inner = self.feasible(self.at(sobol_points(4 * number if self.region else number, size, seed)))[:number]
        return np.unique(np.concatenate([self.feasible(self.at(corners)), inner]), axis=0)

    def of_solutions(self, settings: FloatArray) -> FloatArray:
        """The worn vehicles among settings of all characteristics, shape (M, n)."""
        vehicles = settings[:, self.columns]
        is_within = ((vehicles >= self.worn.lower) & (vehicles <= self.worn.upper)).all(axis=1)
        return np.asarray(vehicles[is_within & (self.settings(vehicles) == settings).all(axis=1)])

    def shrunk(self, share: float) -> Promise:
        """The promise whose ends lie at a share of the way from the original."""
        members = [
            replace(
                one,
                lower=one.original + share * (one.lower - one.original),
                upper=one.original + share * (one.upper - one.original),
            )
            for one in self.worn
        ]
        return replace(self, worn=CharacteristicSet(tuple(members)))

    def to_dict(self) -> dict[str, list[float]]:
        """The ends of every characteristic that may wear."""
        return {one.name: [one.lower, one.upper] for one in self.worn}

    @property
    def in_words(self) -> str:
        """The worn ends, such as `treadDepth >= 2 mm, brakeTorque >= 0.8`."""
        return ", ".join(
            f"{one.name} {sign} {end:.5g}{one.suffix}"
            for one in self.worn
            for sign, end in ((">=", one.lower), ("<=", one.upper))
            if end != one.original
        )


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
        if today is None:
            known = {*study.ads.parameters, *CHANGEABLE.get(study.ads.model, ())}
            raise unknown_name(source, f"repair.{name}: there is no ads.parameters.{name}", name, known)
        if isinstance(today, bool) or not isinstance(today, int | float):
            raise InputError(
                source, f"repair.{name}: ads.parameters.{name} = {today!r}", "a number, the value of today"
            )
        if not stated:
            row = replace_in(row, lower=min(row.lower, today), upper=max(row.upper, today))
        if not row.lower < row.upper or not row.lower <= today <= row.upper or (row.log and row.lower <= 0):
            problem = f"repair.{name}: lower = {row.lower:g}, upper = {row.upper:g}, and today it is {today:g}"
            legal = f"{'0 < ' if row.log else ''}lower < upper, and bounds that hold the value of today"
            raise InputError(source, problem, legal)
        facts = {key: value for key, value in asdict(row).items() if key != "own"}
        parameters.append(Parameter(name=name, today=float(today), **facts))
    return parameters


@dataclass(frozen=True, kw_only=True)
class Problem:
    """A study's ADS with parameters that may change, and the safety degree `margin` to keep within a promise.

    Sets of parameters are arrays of shape (M, P) in [0, 1], shares of the range from lower to upper bound. With
    `arrays`, one ADS drives vehicles with different parameters; otherwise each set has an own instance.
    """

    evaluator: Evaluator
    promise: Promise
    parameters: list[Parameter]
    margin: float
    arrays: bool = False

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
        """The parameters' values in their units, rounded (`DIGITS`); today's exactly where a share is today's."""
        columns = []
        for one, share, today in zip(self.parameters, shares.T, self.today, strict=True):
            if one.log:
                value = one.lower * (one.upper / one.lower) ** share
            else:
                value = one.lower + share * (one.upper - one.lower)
            distinct, row_of = np.unique(value, return_inverse=True)
            sizes = np.minimum(np.where(distinct == 0, np.inf, np.abs(distinct)), one.upper - one.lower)
            decimals = (DIGITS - 1 - np.floor(np.log10(sizes))).astype(int).tolist()
            rounded = np.array(list(map(round, distinct.tolist(), decimals)))[row_of]
            columns.append(np.where(share == today, one.today, np.clip(rounded, one.lower, one.upper)))
        return np.stack(columns, axis=1)

    def changed_values(self, one: FloatArray) -> dict[str, float]:
        """The values of the parameters that a set, shape (P,), changes, by name."""
        names, values = [parameter.name for parameter in self.parameters], self.values(one[np.newaxis])[0].tolist()
        return {name: value for name, value, flag in zip(names, values, one != self.today, strict=True) if flag}

    def evaluate(self, shares: FloatArray, vehicles: FloatArray, stage: str, points: Sequence[int] = ()) -> Evaluations:
        """Row i: parameters i in vehicle i, at the worst of some points; without any, at the worst of all. The settings
        are the worn characteristics.
        """
        selection = Selection(tuple(one.name for one in self.parameters), tuple(points), self.arrays)
        rows = np.concatenate([self.promise.settings(vehicles), self.values(shares)], axis=1)
        worn = self.promise.worn
        return replace(
            self.evaluator.evaluate_selection(rows, selection, stage),
            settings=vehicles,
            f_diff=worn.largest_change(vehicles),
            f_num_diff=worn.number_changed(vehicles),
        )

    def takes_arrays(self) -> bool:
        """Whether one ADS may drive vehicles with different parameters: a shipped one, or the user's if a sample has
        the same results to the bit.
        """
        table = self.study.ads
        if table.kind or table.model in ADS:
            return not table.kind
        shares = sobol_points(ARRAY_CHECKS, len(self.parameters), 0)
        vehicles = self.promise.at(sobol_points(ARRAY_CHECKS, len(self.promise.worn), 1))
        stage = "does the driving system take arrays?"
        try:
            together = replace(self, arrays=True).evaluate(shares, vehicles, stage)
        except UserCodeError:
            return False
        alone = self.evaluate(shares, vehicles, stage)
        return not any(differences(alone.results, together.results))

    def degrees(
        self, shares: FloatArray, vehicles: FloatArray, stage: str, points: Sequence[int] = ()
    ) -> tuple[FloatArray, npt.NDArray[np.intp]]:
        """Safety degrees of each of M sets of parameters in each of L vehicles, shape (M, L), and the numbers of their
        points among `points`.
        """
        shape = len(shares), len(vehicles)
        rows = np.repeat(shares, len(vehicles), axis=0), np.tile(vehicles, (len(shares), 1))
        evaluations = self.evaluate(*rows, stage, points)
        worst = evaluations.worst_points
        numbers = np.zeros(shape, dtype=np.intp) if worst is None else worst.reshape(shape)
        return degrees_of(evaluations).reshape(shape), numbers

    @cached_property
    def best_driver(self) -> Evaluator:
        """Full braking at the first possible moment."""
        ads = ModelTable(model="full_braking", parameters=approach_parameters(assemble(self.study)))
        return self.evaluator.for_study(replace_in(self.study, ads=ads), verified=0)

    def repairable(self, vehicles: FloatArray) -> BoolArray:
        """Which vehicles full braking at the first possible moment, or the ADS of today, keeps safe."""
        stage = "full braking"
        is_safe = degrees_of(self.best_driver.evaluate(self.promise.settings(vehicles), stage)) >= self.margin
        rest = np.flatnonzero(~is_safe)
        is_safe[rest] = self.degrees(self.today[np.newaxis], vehicles[rest], stage)[0][0] >= self.margin
        return is_safe


def degrees_of(evaluations: Evaluations) -> FloatArray:
    """Safety degrees [m, or -m/s], shape (M,); infinite without a conflict, minus infinity without a valid result."""
    degrees = np.where(np.isnan(evaluations.f_safe), np.inf, evaluations.f_safe)
    return np.where(evaluations.valid, degrees, -np.inf)
