"""The settings with which two versions A and B of a study are compared. Both versions get the same
changes of their original vehicles, in the same encounters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import pandas as pd
from msgspec.structs import replace

from safevar_sumo.errors import InputError, about
from safevar_sumo.questions.case import Results, Subject
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.pairs import Criteria, Runs
from safevar_sumo.questions.sampling import Interval, sobol_points
from safevar_sumo.records import BoolArray, Evaluations, FloatArray
from safevar_sumo.results import handles_of
from safevar_sumo.study import Domain, Limit, Study
from safevar_sumo.study.encounters import Axes, AxisTable
from safevar_sumo.study.limits import check_limits

BOTH_STAGE = "simulate both versions"
"""The phase of progress in which settings are simulated in both versions."""
MAX_FACTOR = 512
"""Largest number of sampled settings for each setting that must satisfy the constraints of both
studies. If hardly any settings satisfy them, fewer settings are returned.
"""
SAMPLE = "sample"
"""Value of the column `source` of sampled settings."""
LINE = "line"
"""Name of the column with the number of the line on which a sampled setting lies."""
ROUNDS = 4
"""Number of settings on a line. The first setting has half of the line's changes. Each further
setting is half as far from the setting before it as that setting was from its predecessor.
"""


Evaluators = tuple[Evaluator, Evaluator]
"""The evaluators of A and B."""
Restriction = Mapping[str, Limit]
"""The user's limits, by the name of the characteristic."""


class Pairs(NamedTuple):
    """M pairs of settings: the same changes in A and in B.

    Attributes
    ----------
    frame
        Where each pair comes from. The columns are `source`, for solutions also `solution`,
        `algorithm` and `run`, and for sampled settings `line`.
    settings
        The values in A and in B, shape (2, M, n).
    runs
        The evaluations in A and in B.
    """

    frame: pd.DataFrame
    settings: FloatArray
    runs: Runs

    @classmethod
    def joined(cls, groups: Sequence[Pairs]) -> Pairs:
        """The pairs of all groups, one group after the other."""
        frames, settings, runs = zip(*groups, strict=True)
        frame = pd.concat(frames, ignore_index=True)
        joined = list(map(Evaluations.concatenate, zip(*runs, strict=True)))
        return cls(frame, np.concatenate(settings, axis=1), joined)

    @property
    def are_valid(self) -> BoolArray:
        """Which pairs have valid simulations in both versions, shape (M,)."""
        return self.runs[0].valid & self.runs[1].valid

    @property
    def number_infeasible(self) -> int:
        """The number of pairs that violate a constraint of either study."""
        return int(np.count_nonzero(self.runs[0].infeasible | self.runs[1].infeasible))

    def take(self, rows: BoolArray) -> Pairs:
        """The pairs whose row is True in `rows`, shape (M,)."""
        frame = self.frame[rows].reset_index(drop=True)
        return Pairs(
            frame, self.settings[:, rows], [run.take(rows) for run in self.runs]
        )


class CommonDomain(NamedTuple):
    """The settings that both versions can drive, within the user's limits.

    Attributes
    ----------
    evaluators
        The evaluators of A and B, whose characteristics have the same order.
    shift
        B's original values minus A's, shape (n,); 0 for parameters of the scenario. A setting of B
        with the same changes as a setting of A is larger by this.
    lower, upper
        The ends of both domains within the limits, A's in row 0 and B's in row 1, shape (2, n).
    """

    evaluators: Evaluators
    shift: FloatArray
    lower: FloatArray
    upper: FloatArray

    @classmethod
    def of(cls, evaluators: Evaluators, limits: Restriction) -> CommonDomain:
        """The common domain of two versions, within the user's limits.

        Raises
        ------
        InputError
            If B's original vehicle does not keep a limit, or the domains of a searched parameter
            have nothing in common.
        """
        a, b = (side.characteristics for side in evaluators)
        second = evaluators[1].study
        with about(second.source):
            check_limits(second.domains, limits, "limits: ")
        shift = np.where(a.of_vehicle, b.original - a.original, 0.0)
        sides = product(evaluators, a.names)
        ends = [within(limits, name, side.study.domains) for side, name in sides]
        lower, upper = np.reshape(ends, (2, len(a.names), 2)).T
        common = cls(evaluators, shift, lower.T, upper.T)
        lower, upper = common.ends_in_a
        is_empty = lower > upper
        if is_empty.any():
            raise InputError(
                second.source,
                f"{a.names[np.argmax(is_empty)]}: the domains of the two studies do not"
                " overlap",
                "studies with a common domain of each parameter",
            )
        return common

    @property
    def ends_in_a(self) -> tuple[FloatArray, FloatArray]:
        """The lower and the upper ends, shape (n,), of the settings of A that are in A's domain,
        and whose counterparts are in B's domain.
        """
        lower = np.maximum(self.lower[0], self.lower[1] - self.shift)
        return lower, np.minimum(self.upper[0], self.upper[1] - self.shift)

    def holds(self, settings: FloatArray) -> BoolArray:
        """Which of M pairs of settings, shape (2, M, n), lie in the domains of their versions,
        shape (M,).
        """
        values = settings.swapaxes(0, 1)
        return np.asarray(
            ((values >= self.lower) & (values <= self.upper)).all(axis=(1, 2))
        )

    def in_both(self, settings: FloatArray) -> FloatArray:
        """The settings of A and their counterparts in B, shape (2, M, n). A value that rounding
        errors move out of B's domain is put onto the domain's end.
        """
        in_b = np.clip(settings + self.shift, self.lower[1], self.upper[1])
        return np.stack([settings, in_b])

    def evaluate(self, settings: FloatArray) -> list[Evaluations]:
        """Evaluate pairs of settings, shape (2, M, n), each in its version."""
        pairs = zip(self.evaluators, settings, strict=True)
        return [side.evaluate(of_side, BOTH_STAGE) for side, of_side in pairs]


def within(limits: Restriction, name: str, domains: Mapping[str, Domain]) -> Interval:
    """The ends of the domain of the characteristic `name` within the user's limits."""
    domain = domains[name]
    if name in limits:
        return limits[name].interval(domain)
    return domain.lower, domain.upper


def in_order_of(a: Study, b: Study) -> Study:
    """Study B with its characteristics in A's order.

    Raises
    ------
    InputError
        If B has other characteristics or searched parameters, or other units.
    """
    place = {name: number for number, name in enumerate(a.ranges)}

    def in_order(axes: dict[str, AxisTable]) -> Axes:
        """The axes in A's order. Listed axes stand before axes with a range."""
        names = sorted(axes, key=lambda name: place.get(name, -1))
        return {name: axes[name] for name in names}

    # Both studies must have the same characteristics and units.
    units_a = {(name, row.unit) for name, row in a.domains.items()}
    units_b = {(name, row.unit) for name, row in b.domains.items()}
    if units_a == units_b:
        characteristics = {name: b.domains[name] for name in a.vehicle.characteristics}
        vehicle = replace(b.vehicle, characteristics=characteristics)
        return replace(b.mapped(in_order), vehicle=vehicle)

    def in_words(units: set[tuple[str, str]]) -> str:
        """Names with their units, in alphabetical order; `none` without any."""
        return ", ".join(f"{name} [{unit}]" for name, unit in sorted(units)) or "none"

    raise InputError(
        b.source,
        f"cannot be compared: characteristics of {a.name!r} alone: {in_words(units_a - units_b)}; "
        f"of {b.name!r} alone: {in_words(units_b - units_a)}",
        "studies with the same characteristics and searched parameters in the same units",
    )


def pairs_of(
    subjects: Sequence[Subject],
    common: CommonDomain,
    criteria: Criteria,
    samples: int,
) -> tuple[Pairs, int]:
    """The solutions of both sides and `samples` sampled settings, evaluated in both versions. The
    second result is the number of solutions that are left out, because they are not in both
    domains.
    """
    names = list(common.evaluators[0].characteristics.names)
    groups = []
    outside = 0

    for side, case in zip("ab", subjects, strict=True):
        if not isinstance(case, Results):
            continue
        solutions = case.solutions[names].to_numpy(float)
        in_a = solutions if side == "a" else solutions - common.shift
        in_b = solutions if side == "b" else solutions + common.shift
        settings = np.stack([in_a, in_b])
        is_inside = common.holds(settings)
        run_columns = ["algorithm", "run"] if case.has_runs else []
        frame = case.solutions[run_columns].assign(
            source=side, solution=list(map(str, handles_of(case.solutions)))
        )
        outside += int(np.count_nonzero(~is_inside))
        inside = settings[:, is_inside]
        groups.append(Pairs(frame[is_inside], inside, common.evaluate(inside)))
    groups.append(_draw_on_lines(common, criteria, samples))
    return Pairs.joined(groups), outside


def _draw_on_lines(common: CommonDomain, criteria: Criteria, samples: int) -> Pairs:
    """Sample `samples` settings near the place where the vehicles begin to fail.

    The settings lie on lines from the original vehicle to Sobol points of the common domain, in the
    encounters of these points. Nearly every vehicle with random changes of all characteristics
    fails in both versions, which shows no difference. Therefore a line goes on with smaller changes
    after a failure in both versions, and with larger changes after no failure. After a failure in
    one version, lines with even numbers go on with smaller changes, and lines with odd numbers with
    larger changes, whichever version failed. Hence the sample favours no version.
    """
    members = common.evaluators[0].characteristics
    ends = _common_sample(common, math.ceil(samples / ROUNDS))
    starts = members.with_original_vehicle(ends)
    shares = np.full(len(ends), 0.5)
    step = 0.5
    rounds = list[Pairs]()
    budget = samples if len(ends) else 0

    while budget and len(rounds) < ROUNDS:
        lines = np.arange(min(len(ends), budget))
        budget -= len(lines)
        share = shares[lines, np.newaxis]
        settings = common.in_both(starts[lines] + share * (ends - starts)[lines])
        runs = common.evaluate(settings)
        frame = pd.DataFrame({"source": SAMPLE, "solution": "", LINE: lines})
        rounds.append(Pairs(frame, settings, runs))
        are_unsafe = [
            unsafe.of(run) for unsafe, run in zip(criteria, runs, strict=True)
        ]
        failures = np.sum(are_unsafe, axis=0)
        step /= 2
        shares[lines] += np.choose(
            failures, [step, np.where(lines % 2, step, -step), -step]
        )
    return Pairs.joined(rounds)


def _common_sample(common: CommonDomain, number: int) -> FloatArray:
    """`number` settings of A that cover the common domain evenly, and satisfy the constraints of
    both studies. There are fewer settings if hardly any satisfy these constraints.
    """
    lower, upper = common.ends_in_a
    factor = 1
    while True:
        points = sobol_points(number * factor, len(lower), 0)
        settings = lower + points * (upper - lower)
        sides = zip(common.evaluators, common.in_both(settings), strict=True)
        is_feasible = [side.region.feasible(values) for side, values in sides]
        settings = settings[np.all(is_feasible, axis=0)]
        if len(settings) >= number or factor >= MAX_FACTOR:
            return settings[:number]
        factor *= 2
