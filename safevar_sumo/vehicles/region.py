"""The feasible region of a study: settings whose characteristics satisfy its constraints."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.plugins import Guard, Lookup, read_only_copy
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import Constraint, Study, unit_text
from safevar_sumo.vehicles.characteristics import CharacteristicSet

SLACK = 1e-9
"""Tolerated violation of a bound, as a share of the range of the quantity in the domains [-]; covers rounding."""
N_REPAIR_SHARES = 64
"""Number of settings that a repair tries between an infeasible setting and the original."""
REJECTIONS = 1000
"""Maximum number of settings drawn for each feasible setting."""
N_PROBES = 512
"""Number of random settings among which a feasible change is sought, besides vertices of the region and ends of the
domains.
"""
DrawSettings = Callable[[int], FloatArray]
"""A function that draws the given number of settings."""


class _Bounds(NamedTuple):
    """A constraint as a computation: `quantity` maps settings, shape (N, n), to values, shape (N,), in a range of size
    `width`.
    """

    constraint: Constraint
    condition: str
    suffix: str
    quantity: Callable[[FloatArray], FloatArray]
    minimum: float
    maximum: float
    width: float

    def excess(self, settings: FloatArray) -> FloatArray:
        """By how much each setting violates the bounds, as a share of `width`, shape (N,)."""
        values = self.quantity(settings)
        return np.asarray(np.maximum(np.maximum(self.minimum - values, values - self.maximum), 0.0) / self.width)

    def __str__(self) -> str:
        return f"{self.constraint.quantity} {self.condition}"


@dataclass(frozen=True)
class FeasibleRegion:
    """Settings that satisfy all constraints of a study; without constraints, all settings.

    `vertices` are vertices of the polytope of the linear constraints, shape (V, n), empty without such constraints.
    """

    characteristics: CharacteristicSet
    bounds: tuple[_Bounds, ...]
    vertices: FloatArray

    def __bool__(self) -> bool:
        return bool(self.bounds)

    def __str__(self) -> str:
        return "; ".join(map(str, self.bounds))

    def violation(self, settings: FloatArray) -> FloatArray:
        """Sum of the violations of all constraints, each as a share of the range of its quantity, shape (N,); 0 if
        feasible.
        """
        excess = np.zeros(len(settings))
        for bound in self.bounds:
            excess = excess + bound.excess(settings)
        return np.where(excess <= SLACK, 0.0, excess)

    def feasible(self, settings: FloatArray) -> BoolArray:
        """Which settings satisfy all constraints; shape (N,)."""
        return np.asarray(self.violation(settings) == 0)

    def check(self, settings: FloatArray, source: object, *, otherwise: str = "") -> None:
        """Refuse settings, shape (N, n), that are not feasible.

        Raises
        ------
        InputError
            Naming the constraint that the first infeasible setting violates, and the values of that setting.
        """
        for setting in settings[~self.feasible(settings)][:1]:
            for bound in self.bounds:
                if bound.excess(setting[np.newaxis])[0] > SLACK / len(self.bounds):
                    quantity = f"{bound.constraint.quantity} = {bound.quantity(setting[np.newaxis])[0]:g}{bound.suffix}"
                    raise InputError(
                        source,
                        f"violates a constraint: {quantity} ({self._describe_values(bound, setting)})",
                        bound.condition + otherwise,
                    )

    def _describe_values(self, bound: _Bounds, setting: FloatArray) -> str:
        return (
            ", ".join(
                f"{characteristic.name} = {value:g}{characteristic.suffix}"
                for characteristic, value in zip(self.characteristics, setting, strict=True)
                if characteristic.name in bound.constraint.sum
                or (bound.constraint.function and value != characteristic.original)
            )
            or "the original"
        )

    def repaired(self, settings: FloatArray, *, filtered: bool = True) -> FloatArray:
        """Settings moved towards the original until they are feasible; if `filtered`, feasible after the filter. Shape
        (N, n).
        """
        repaired = settings.copy()
        infeasible = np.flatnonzero(~self._are_accepted(settings, filtered))
        for share in np.arange(N_REPAIR_SHARES - 1, -1, -1) / N_REPAIR_SHARES:
            if not len(infeasible):
                break
            original = self.characteristics.original
            repaired[infeasible] = original + share * (settings[infeasible] - original)
            infeasible = infeasible[~self._are_accepted(repaired[infeasible], filtered)]
        return repaired

    def draw_feasible(
        self,
        draw: DrawSettings,
        number: int,
        rng: np.random.Generator | None = None,
        *,
        filtered: bool = False,
        rejections: int = REJECTIONS,
    ) -> FloatArray:
        """The first `number` feasible settings drawn (if `filtered`, feasible after the filter), shape (number, n).

        If `rejections` draws per setting do not suffice, random mixtures of the region's vertices fill the rest;
        without `rng`, fewer settings are returned.
        """
        batches, draws = [np.zeros((0, len(self.characteristics)))], 0
        while (shortage := number - sum(map(len, batches))) and draws < rejections * number:
            settings = draw(max(shortage, min(draws, 10_000)))
            draws += len(settings)
            batches.append(settings[self._are_accepted(settings, filtered)][:shortage])
        if shortage and rng is not None:
            corners = np.concatenate([self.vertices, self.characteristics.original[np.newaxis]])
            mixtures = rng.dirichlet(np.full(len(corners), 0.5), shortage) @ corners
            mixtures = np.clip(mixtures, self.characteristics.lower, self.characteristics.upper)
            batches.append(self.repaired(mixtures, filtered=filtered))
        return np.concatenate(batches)

    def _are_accepted(self, settings: FloatArray, filtered: bool) -> BoolArray:
        return self.feasible(self.characteristics.filter(settings) if filtered else settings)


def region_of(study: Study, source: str = "") -> FeasibleRegion:
    """The feasible region of a study.

    Raises
    ------
    InputError
        If a function cannot be loaded, or if the original vehicle or every change is infeasible.
    """
    source = source or study.source
    characteristics = CharacteristicSet.of(study)
    if not study.constraints:
        return FeasibleRegion(characteristics, (), np.zeros((0, len(characteristics))))
    lookup = Lookup(source, study.origin.places)
    bounds = tuple(
        _bounds_of(constraint, study, characteristics, lookup, f"constraints[{number}]")
        for number, constraint in enumerate(study.constraints)
    )
    linear = [
        (tuple(bound.constraint.sum.get(name, 0.0) for name in characteristics.names), bound.minimum, bound.maximum)
        for bound in bounds
        if bound.constraint.sum
    ]
    domain_ends = tuple(characteristics.lower.tolist()), tuple(characteristics.upper.tolist())
    vertices = _vertices(tuple(linear), *domain_ends) if linear else np.zeros((0, len(characteristics)))
    if vertices is None:
        raise InputError(
            source,
            f"constraints: no setting in the domains satisfies all of them: {'; '.join(map(str, bounds))}",
            "constraints that leave a region, with the original in it",
        )
    region = FeasibleRegion(characteristics, bounds, vertices)
    region.check(
        characteristics.original[np.newaxis],
        f"{source}: the original vehicle",
        otherwise="; the original vehicle must satisfy every constraint",
    )
    if not _has_feasible_change(region):
        raise InputError(
            source,
            f"constraints leave only the original vehicle, as no feasible change passes the filter: {region}",
            "constraints that leave a region around the original",
        )
    return region


def _bounds_of(
    constraint: Constraint, study: Study, characteristics: CharacteristicSet, lookup: Lookup, key: str
) -> _Bounds:
    minimum = -np.inf if constraint.at_least is None else constraint.at_least
    maximum = np.inf if constraint.at_most is None else constraint.at_most
    condition, unit = (
        constraint.bounds_in_words(study.vehicle.characteristics),
        constraint.unit_of(study.vehicle.characteristics),
    )
    suffix = unit_text(unit)
    if constraint.sum:
        weights = [(characteristics.names.index(name), weight) for name, weight in constraint.sum.items()]
        width = sum(abs(weight) * (characteristics.upper - characteristics.lower)[column] for column, weight in weights)
        return _Bounds(
            constraint,
            condition,
            suffix,
            lambda settings: _weighted_sum(settings, weights),
            minimum,
            maximum,
            float(width),
        )
    member = lookup.find({}, constraint.function, f"{key}.function")
    guard = member.guard or Guard(lookup.source, f"{key}.function = {constraint.function!r}")
    if not callable(member.target):
        raise InputError(
            lookup.source,
            f"{guard.name} is of type {type(member.target).__name__}",
            "a function of a mapping of arrays",
        )

    def quantity(settings: FloatArray) -> FloatArray:
        columns = read_only_copy(dict(zip(characteristics.names, settings.T, strict=True)))
        return guard.numbers("its call", "values", guard.call("its call", member.target, columns), (len(settings),))

    samples = quantity(np.stack([characteristics.original, characteristics.lower, characteristics.upper]))
    return _Bounds(
        constraint,
        condition,
        suffix,
        quantity,
        minimum,
        maximum,
        float(np.ptp(samples)) or max(1.0, abs(float(samples[0]))),
    )


def _weighted_sum(settings: FloatArray, weights: Sequence[tuple[int, float]]) -> FloatArray:
    """A weighted sum, added term by term so that it does not depend on the number of settings."""
    total = np.zeros(len(settings))
    for column, weight in weights:
        total = total + weight * settings[:, column]
    return total


@lru_cache(maxsize=16)
def _vertices(linear: tuple[Any, ...], lower: tuple[float, ...], upper: tuple[float, ...]) -> FloatArray | None:
    """For each characteristic, settings with its least and its greatest value under the linear constraints; None if no
    setting fits.
    """
    from scipy.optimize import linprog  # loading takes half a second

    inequalities = [
        (sign * np.array(weights), sign * limit)
        for weights, minimum, maximum in linear
        for sign, limit in ((-1, minimum), (1, maximum))
        if np.isfinite(limit)
    ]
    vertices = []
    for column in range(len(lower)):
        for sign in (1.0, -1.0):
            result = linprog(
                sign * np.eye(len(lower))[column],
                A_ub=np.array([weights for weights, _ in inequalities]),
                b_ub=np.array([limit for _, limit in inequalities]),
                bounds=list(zip(lower, upper, strict=True)),
                method="highs",
            )
            if not result.success:
                return None
            vertices.append(np.clip(result.x, lower, upper))
    return np.array(vertices)


def _has_feasible_change(region: FeasibleRegion) -> bool:
    """Whether a feasible setting still differs from the original after the filter."""
    characteristics = region.characteristics
    for settings in _candidate_changes(region):
        filtered = characteristics.filter(settings)
        if (characteristics.changed(filtered).any(axis=1) & region.feasible(filtered)).any():
            return True
    return False


def _candidate_changes(region: FeasibleRegion) -> Iterator[FloatArray]:
    """Settings to try: vertices and ends of the domains first, then random settings."""
    characteristics, original = region.characteristics, region.characteristics.original
    size = len(characteristics)
    yield np.concatenate(
        [
            region.vertices,
            *(
                np.where(np.eye(size, dtype=bool), end, original)
                for end in (characteristics.lower, characteristics.upper)
            ),
        ]
    )
    rng = np.random.default_rng(0)
    probes = rng.uniform(characteristics.lower, characteristics.upper, (N_PROBES, size))
    sparse_probes = np.where(rng.random((N_PROBES, size)) < 2 / size, probes, original)
    yield region.repaired(np.concatenate([probes, sparse_probes]))
