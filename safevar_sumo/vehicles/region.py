"""The feasible region of a study: settings whose characteristics satisfy its constraints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import Constraint, Study, unit_text
from safevar_sumo.vehicles.characteristics import CharacteristicSet

SLACK = 1e-9
"""Tolerated violation of a bound, as a share of the range of the quantity in the domains [-]; covers rounding."""
N_REPAIR_SHARES = 64
"""Number of settings that a repair tries between an infeasible setting and the original."""
REJECTIONS = 1000
"""Maximum number of settings drawn for each feasible setting."""
LARGEST_DRAW = 10_000
"""Largest number of settings that are drawn at once, unless more are missing."""
MIXTURE_CONCENTRATION = 0.5
"""Concentration of the weights of vertices in a mixture: below 1, few vertices have most of the weight."""
N_PROBES = 512
"""Number of random settings among which a feasible change is sought, besides vertices of the region and ends of the
domains.
"""
MEAN_CHANGES = 2
"""Mean number of changes in a sparse setting; other random settings change every characteristic."""


class _Bounds(NamedTuple):
    """A constraint as a computation: the `weights` of characteristics by their numbers, the size `width` of the sum's
    range in the domains, its bounds, and the bounds and unit in words, `condition` and `suffix`.
    """

    constraint: Constraint
    weights: tuple[tuple[int, float], ...]
    width: float
    minimum: float
    maximum: float
    condition: str
    suffix: str

    @classmethod
    def of(cls, constraint: Constraint, study: Study, characteristics: CharacteristicSet) -> _Bounds:
        """The computation of a study's constraint."""
        table, widths = study.vehicle.characteristics, characteristics.upper - characteristics.lower
        weights = tuple((characteristics.names.index(name), weight) for name, weight in constraint.sum.items())
        return cls(
            constraint,
            weights,
            float(sum(abs(weight) * widths[column] for column, weight in weights)),
            -np.inf if constraint.at_least is None else constraint.at_least,
            np.inf if constraint.at_most is None else constraint.at_most,
            constraint.bounds_in_words(table),
            unit_text(constraint.unit_of(table)),
        )

    def quantity(self, settings: FloatArray) -> FloatArray:
        """The weighted sum, shape (N,), added term by term so that it does not depend on the number of settings."""
        total = np.zeros(len(settings))
        for column, weight in self.weights:
            total = total + weight * settings[:, column]
        return total

    def excess(self, settings: FloatArray) -> FloatArray:
        """By how much each setting violates the bounds, as a share of `width`, shape (N,)."""
        values = self.quantity(settings)
        return np.asarray(np.maximum(np.maximum(self.minimum - values, values - self.maximum), 0.0) / self.width)

    def __str__(self) -> str:
        return f"{self.constraint.quantity} {self.condition}"


@dataclass(frozen=True)
class FeasibleRegion:
    """Settings that satisfy all constraints of a study; without constraints, all settings.

    `vertices`, shape (V, n), are vertices of the polytope of the linear constraints; none without such constraints.
    """

    characteristics: CharacteristicSet
    bounds: tuple[_Bounds, ...]
    vertices: FloatArray

    def __bool__(self) -> bool:
        return bool(self.bounds)

    def __str__(self) -> str:
        return "; ".join(map(str, self.bounds))

    def violation(self, settings: FloatArray) -> FloatArray:
        """Sum of a setting's violations, each as a share of the range of the constraint's quantity, shape (N,); 0 if
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
        for setting in settings[~self.feasible(settings)][:1]:  # the first one, if any
            row = setting[np.newaxis]
            bound = next(bound for bound in self.bounds if bound.excess(row)[0] > SLACK / len(self.bounds))
            values = ", ".join(
                f"{characteristic.name} = {value:g}{characteristic.suffix}"
                for characteristic, value in zip(self.characteristics, setting, strict=True)
                if characteristic.name in bound.constraint.sum
            )
            quantity = f"{bound.constraint.quantity} = {bound.quantity(row)[0]:g}{bound.suffix}"
            problem = f"violates a constraint: {quantity} ({values})"
            raise InputError(source, problem, bound.condition + otherwise)

    def repaired(self, settings: FloatArray, *, filtered: bool = True) -> FloatArray:
        """Settings moved towards the original until they are feasible, shape (N, n); if `filtered`, feasible after the
        filter.
        """
        repaired, original = settings.copy(), self.characteristics.original
        infeasible = np.flatnonzero(~self._are_accepted(settings, filtered))
        for share in np.arange(N_REPAIR_SHARES - 1, -1, -1) / N_REPAIR_SHARES:
            if not len(infeasible):
                break
            repaired[infeasible] = original + share * (settings[infeasible] - original)
            infeasible = infeasible[~self._are_accepted(repaired[infeasible], filtered)]
        return repaired

    def draw_feasible(
        self,
        draw: Callable[[int], FloatArray],
        number: int,
        rng: np.random.Generator | None = None,
        *,
        filtered: bool = False,
        rejections: int = REJECTIONS,
    ) -> FloatArray:
        """The first `number` feasible settings that `draw` draws, shape (number, n); if `filtered`, feasible after the
        filter.

        If `rejections` draws per setting do not suffice, random mixtures of the region's vertices and the original fill
        the rest; without `rng`, fewer settings are returned.
        """
        batches, draws = [np.zeros((0, len(self.characteristics)))], 0
        while (shortage := number - sum(map(len, batches))) and draws < rejections * number:
            settings = draw(max(shortage, min(draws, LARGEST_DRAW)))  # as many as all draws before
            draws += len(settings)
            batches.append(settings[self._are_accepted(settings, filtered)][:shortage])
        if shortage and rng is not None:
            corners = np.concatenate([self.vertices, self.characteristics.original[np.newaxis]])
            weights = rng.dirichlet(np.full(len(corners), MIXTURE_CONCENTRATION), shortage)
            mixtures = np.clip(weights @ corners, self.characteristics.lower, self.characteristics.upper)
            batches.append(self.repaired(mixtures, filtered=filtered))
        return np.concatenate(batches)

    def _are_accepted(self, settings: FloatArray, filtered: bool) -> BoolArray:
        return self.feasible(self.characteristics.filter(settings) if filtered else settings)


def region_of(study: Study, source: str = "") -> FeasibleRegion:
    """The feasible region of a study.

    Raises
    ------
    InputError
        If the original vehicle or every change is infeasible.
    """
    source = source or study.source
    characteristics = CharacteristicSet.of(study)
    if not study.constraints:
        return FeasibleRegion(characteristics, (), np.zeros((0, len(characteristics))))
    bounds = tuple(_Bounds.of(constraint, study, characteristics) for constraint in study.constraints)
    linear = [
        (tuple(bound.constraint.sum.get(name, 0.0) for name in characteristics.names), bound.minimum, bound.maximum)
        for bound in bounds
    ]
    domain_ends = tuple(characteristics.lower.tolist()), tuple(characteristics.upper.tolist())
    vertices = _vertices(tuple(linear), *domain_ends)
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
    candidates = characteristics.filter(_candidate_changes(region))
    if not (characteristics.changed(candidates).any(axis=1) & region.feasible(candidates)).any():
        raise InputError(
            source,
            f"constraints leave only the original vehicle, as no feasible change passes the filter: {region}",
            "constraints that leave a region around the original",
        )
    return region


@lru_cache(maxsize=16)
def _vertices(linear: tuple[Any, ...], lower: tuple[float, ...], upper: tuple[float, ...]) -> FloatArray | None:
    """Settings with the least and with the greatest value of each characteristic under the linear constraints.

    None if no setting satisfies the constraints.
    """
    from scipy.optimize import linprog  # loading takes half a second

    inequalities = [
        (sign * np.array(weights), sign * limit)
        for weights, minimum, maximum in linear
        for sign, limit in ((-1, minimum), (1, maximum))
        if np.isfinite(limit)
    ]
    left, right = map(np.array, zip(*inequalities, strict=True))
    goals = (sign * goal for goal in np.eye(len(lower)) for sign in (1.0, -1.0))
    results = [linprog(goal, left, right, bounds=np.transpose([lower, upper]), method="highs") for goal in goals]
    if not all(result.success for result in results):
        return None
    return np.asarray(np.clip([result.x for result in results], lower, upper))


def _candidate_changes(region: FeasibleRegion) -> FloatArray:
    """Settings among which a feasible change is sought: vertices, ends of the domains, and random settings."""
    characteristics, original = region.characteristics, region.characteristics.original
    lower, upper, size = characteristics.lower, characteristics.upper, len(characteristics)
    ends = [np.where(np.eye(size, dtype=bool), end, original) for end in (lower, upper)]
    rng = np.random.default_rng(0)
    probes = rng.uniform(lower, upper, (N_PROBES, size))
    sparse_probes = np.where(rng.random((N_PROBES, size)) < MEAN_CHANGES / size, probes, original)
    return np.concatenate([region.vertices, *ends, region.repaired(np.concatenate([probes, sparse_probes]))])
