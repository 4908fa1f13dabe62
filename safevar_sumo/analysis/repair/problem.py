"""What a repair is asked: the promised wear, and the parameters of the ADS that may change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
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
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, differences
from safevar_sumo.study import FreeParameter, ModelTable, Study, limits_of
from safevar_sumo.study.characteristics import limit_mistakes
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet, FeasibleRegion

MAX_PARAMETERS = 8
DIGITS = 4
"""Significant digits of a parameter's changed value, or of its range if that is smaller: the value that is printed is
the one that has been tried.
"""
ARRAY_CHECKS = 8
"""Sets of parameters with which a user's ADS is tried as one for all vehicles."""
MAX_CORNERS = 256
"""Largest number of corners of the promised domain that are tried; of more, so many random ones are taken."""
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
    """The promised wear: the w characteristics that may wear, with the promised ends as their domains.

    Arrays of vehicles, shape (M, w), hold these characteristics; all others stay as in the original.
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
        of_study = stated if stated and isinstance(stated, dict) else study.limits
        for mistake in limit_mistakes(study.source, rows, of_study, "repair.promise."):
            raise mistake
        limits = limits_of(texts, rows, None if texts else of_study, "promise")
        if not limits:
            raise InputError("promise", "nothing is promised", f'"NAME >= X" with one of {", ".join(rows)}; or {ALL}')
        ends = {name: limit.interval(rows[name]) for name, limit in limits.items()}
        worn = []
        for characteristic in region.characteristics:
            lower, upper = ends.get(characteristic.name, (0.0, 0.0))
            if lower < upper:
                worn.append(replace(characteristic, lower=lower, upper=upper))
        if not worn:
            raise InputError("promise", "promises a new vehicle only", "a limit short of the original's value")
        return cls(region, CharacteristicSet(tuple(worn)))

    @cached_property
    def columns(self) -> list[int]:
        """Columns of the characteristics that may wear, among those of all characteristics."""
        return [self.region.characteristics.names.index(name) for name in self.worn.names]

    def settings(self, vehicles: FloatArray) -> FloatArray:
        """The settings of vehicles: all characteristics of the study, shape (M, n)."""
        settings = np.tile(self.region.characteristics.original, (len(vehicles), 1))
        settings[:, self.columns] = vehicles
        return settings

    def vehicles_at(self, points: FloatArray) -> FloatArray:
        """The vehicles at points of the unit cube, shape (M, w)."""
        return self.worn.lower + points * (self.worn.upper - self.worn.lower)

    def feasible(self, vehicles: FloatArray) -> FloatArray:
        """Those vehicles that keep the study's constraints."""
        return vehicles[self.region.feasible(self.settings(vehicles))]

    def draw(self, number: int, rng: np.random.Generator) -> FloatArray:
        """Vehicles drawn uniformly among the feasible ones."""

        def draw_settings(count: int) -> FloatArray:
            return self.settings(self.vehicles_at(rng.random((count, len(self.worn)))))

        return np.asarray(self.region.draw_feasible(draw_settings, number)[:, self.columns])

    def corners_and_sobol_points(self, number: int, seed: int) -> FloatArray:
        """Distinct feasible vehicles: the corners, or `MAX_CORNERS` of them, and `number` Sobol points."""
        size = len(self.worn)
        if 2**size <= MAX_CORNERS:
            corners = np.array(list(product((0.0, 1.0), repeat=size)))
        else:
            corners = np.round(sobol_points(MAX_CORNERS, size, seed))
        # Constraints refuse some points.
        points = sobol_points(4 * number if self.region else number, size, seed)
        inner = self.feasible(self.vehicles_at(points))[:number]
        return np.unique(np.concatenate([self.feasible(self.vehicles_at(corners)), inner]), axis=0)

    def vehicles_among(self, settings: FloatArray) -> FloatArray:
        """The vehicles within the promise among settings of all characteristics, shape (M, n)."""
        vehicles = settings[:, self.columns]
        is_within = ((vehicles >= self.worn.lower) & (vehicles <= self.worn.upper)).all(axis=1)
        return np.asarray(vehicles[is_within & (self.settings(vehicles) == settings).all(axis=1)])

    def shrunk(self, share: float) -> Promise:
        """The promise whose ends lie at a share of the way from the original to the ends of this promise."""
        members = [
            replace(
                characteristic,
                lower=characteristic.original + share * (characteristic.lower - characteristic.original),
                upper=characteristic.original + share * (characteristic.upper - characteristic.original),
            )
            for characteristic in self.worn
        ]
        return replace(self, worn=CharacteristicSet(tuple(members)))

    def to_dict(self) -> dict[str, list[float]]:
        """The ends of every characteristic that may wear."""
        return {worn.name: [worn.lower, worn.upper] for worn in self.worn}

    @property
    def in_words(self) -> str:
        """The worn ends, such as `treadDepth >= 2 mm, brakeTorque >= 0.8`."""
        return ", ".join(
            f"{worn.name} {sign} {end:.5g}{worn.suffix}"
            for worn in self.worn
            for sign, end in ((">=", worn.lower), ("<=", worn.upper))
            if end != worn.original
        )


def parameters_of(study: Study, names: Sequence[str]) -> list[Parameter]:
    """The parameters that may change: those called `names`, or all under [repair], or those of a shipped ADS.

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
    ads = getattr(ads, "_ads", ads)  # a user's ADS within its guard
    parameters = []
    for name in chosen:
        row, today = table[name], study.ads.parameters.get(name, getattr(ads, name, None))
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
class RepairProblem:
    """A study's ADS with P parameters that may change, and the criterion to keep within a promise: safety degrees of at
    least `margin`.

    Sets of parameters, shape (M, P), are shares of the range from lower to upper bound in [0, 1]. With `arrays`, one
    ADS drives vehicles with different parameters; otherwise there is an instance for each set.
    """

    evaluator: Evaluator
    promise: Promise
    parameters: list[Parameter]
    unsafe: Unsafe
    arrays: bool = False

    @property
    def study(self) -> Study:
        return self.evaluator.study

    @property
    def margin(self) -> float:
        return self.unsafe.keep + self.unsafe.contact

    @cached_property
    def today(self) -> FloatArray:
        """The parameters of today, shape (P,)."""
        values = np.array([(parameter.lower, parameter.upper, parameter.today) for parameter in self.parameters])
        is_log = np.array([parameter.log for parameter in self.parameters])[:, np.newaxis]
        lower, upper, today = np.where(is_log, np.log(np.where(is_log, values, 1.0)), values).T
        return np.asarray((today - lower) / (upper - lower))

    def values(self, shares: FloatArray) -> FloatArray:
        """The parameters' values in their units, shape (M, P): today's value where a share is today's, otherwise
        rounded to `DIGITS`.
        """
        columns = []
        for parameter, share, share_today in zip(self.parameters, shares.T, self.today, strict=True):
            lower, upper = parameter.lower, parameter.upper
            value = lower * (upper / lower) ** share if parameter.log else lower + share * (upper - lower)
            distinct, row_of = np.unique(value, return_inverse=True)
            sizes = np.minimum(np.where(distinct == 0, np.inf, np.abs(distinct)), upper - lower)
            decimals = (DIGITS - 1 - np.floor(np.log10(sizes))).astype(int).tolist()
            rounded = np.array(list(map(round, distinct.tolist(), decimals)))[row_of]
            columns.append(np.where(share == share_today, parameter.today, np.clip(rounded, lower, upper)))
        return np.stack(columns, axis=1)

    def changed_values(self, change: FloatArray) -> dict[str, float]:
        """The values of the parameters that a change, one set of shape (P,), changes, by name."""
        (values,) = self.values(change[np.newaxis]).tolist()
        return {
            parameter.name: value
            for parameter, value, is_changed in zip(self.parameters, values, change != self.today, strict=True)
            if is_changed
        }

    def evaluate(self, shares: FloatArray, vehicles: FloatArray, stage: str, points: Sequence[int] = ()) -> Evaluations:
        """Evaluate each set of parameters with the vehicle of its row, at the worst of `points`, or of all points if
        none is named.

        The settings of the evaluations are the worn characteristics.
        """
        selection = Selection(tuple(parameter.name for parameter in self.parameters), tuple(points), self.arrays)
        rows = np.concatenate([self.promise.settings(vehicles), self.values(shares)], axis=1)
        worn = self.promise.worn
        return replace(
            self.evaluator.evaluate_selection(rows, selection, stage),
            settings=vehicles,
            f_diff=worn.largest_change(vehicles),
            f_num_diff=worn.number_changed(vehicles),
        )

    def takes_arrays(self) -> bool:
        """Whether one ADS may drive vehicles with different parameters: a shipped one, or the user's class if a sample
        has the same results to the bit.
        """
        if self.study.ads.kind:
            return False
        if self.study.ads.model in ADS:
            return True
        shares = sobol_points(ARRAY_CHECKS, len(self.parameters), 0)
        vehicles = self.promise.vehicles_at(sobol_points(ARRAY_CHECKS, len(self.promise.worn), 1))
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
        """Safety degrees of each of M sets of parameters in each of L vehicles, shape (M, L), and the places of their
        worst points among `points`.
        """
        shape = len(shares), len(vehicles)
        rows = np.repeat(shares, len(vehicles), axis=0), np.tile(vehicles, (len(shares), 1))
        evaluations = self.evaluate(*rows, stage, points)
        worst = evaluations.worst_points
        numbers = np.zeros(shape, dtype=np.intp) if worst is None else worst.reshape(shape)
        return degrees_of(evaluations).reshape(shape), numbers

    def degrees_today(self, vehicles: FloatArray, stage: str) -> FloatArray:
        """Safety degrees of vehicles with the parameters of today, shape (L,)."""
        degrees, _ = self.degrees(self.today[np.newaxis], vehicles, stage)
        return degrees.reshape(-1)

    @cached_property
    def best_driver(self) -> Evaluator:
        """Full braking at the first possible moment."""
        ads = ModelTable(model="full_braking", parameters=approach_parameters(assemble(self.study)))
        return self.evaluator.for_study(replace_in(self.study, ads=ads), verified=0)

    def repairable(self, vehicles: FloatArray) -> BoolArray:
        """Which vehicles full braking at the first possible moment, or else the ADS of today, keeps safe."""
        stage = "full braking"
        is_safe = degrees_of(self.best_driver.evaluate(self.promise.settings(vehicles), stage)) >= self.margin
        unsafe = np.flatnonzero(~is_safe)
        is_safe[unsafe] = self.degrees_today(vehicles[unsafe], stage) >= self.margin
        return is_safe


def degrees_of(evaluations: Evaluations) -> FloatArray:
    """Safety degrees [m, or -m/s], shape (M,); infinite without a conflict, minus infinity without a valid result."""
    degrees = np.where(np.isnan(evaluations.f_safe), np.inf, evaluations.f_safe)
    return np.where(evaluations.valid, degrees, -np.inf)
