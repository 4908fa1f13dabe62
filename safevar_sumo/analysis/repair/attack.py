"""Attacks on sets of parameters with the search that broke today's, and proof on fresh wear."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.evaluator import CONFIDENCE
from safevar_sumo.analysis.repair.problem import Problem, degrees_of
from safevar_sumo.campaign.run import algorithm_of
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.search import Problem as SearchProblem
from safevar_sumo.vehicles import CharacteristicSet

ATTACKS = 3
"""Runs of the search, each with a seed of its own, that must find nothing."""
RANDOM_ATTACKS = 1024
"""Random vehicles that attack too: they find failures that lie far from the worst."""
MAX_UNSAFE_SHARE = 0.001
"""Upper bound of the share of unsafe vehicles that fresh wear has to prove."""


class Proof(NamedTuple):
    """`unsafe` of `n` vehicles drawn after the parameters were chosen; at most `at_most` of all are, with
    `confidence`.
    """

    n: int
    unsafe: int
    at_most: float
    confidence: float = CONFIDENCE


def attack(problem: Problem, sets: Sequence[FloatArray], round_number: int) -> list[FloatArray]:
    """For each set of parameters the vehicles within the promise that it does not keep safe, worst first, shape (M, n).

    Vehicles that no driving system keeps safe are left out.
    """
    characteristics, columns = problem.promise.characteristics, problem.promise.columns
    members = tuple(
        replace(characteristics.members[column], lower=float(lower), upper=float(upper))
        for column, lower, upper in zip(
            columns, problem.promise.lower[columns], problem.promise.upper[columns], strict=True
        )
    )
    own, search = CharacteristicSet(members), problem.study.search
    label = next(iter(search.labels))
    original = np.tile(characteristics.original, (len(sets), 1))
    originals = problem.evaluate(np.array(sets), original, "attack")
    runs = []
    owners = [number for number in range(len(sets)) for _ in range(ATTACKS)]
    for index, number in enumerate(owners):
        task = SearchProblem(
            characteristics=own,
            original=_reduced(originals.take([number]), columns, own),
            evaluations=search.evaluations,
            population=search.population,
        )
        rng = np.random.default_rng((search.seed, round_number, index))
        runs.append(algorithm_of(label, problem.study).search(task, rng))
    failures: list[list[tuple[float, FloatArray]]] = [[] for _ in sets]
    pending: dict[int, Evaluations | None] = dict.fromkeys(range(len(runs)))
    while pending:
        wanted = dict[int, FloatArray]()
        for index, answer in pending.items():
            try:
                wanted[index] = next(runs[index]) if answer is None else runs[index].send(answer)
            except StopIteration:
                continue
        pending = dict(zip(wanted, _judge(problem, sets, owners, wanted, columns, own, failures), strict=True))
    random = problem.draw(RANDOM_ATTACKS, np.random.default_rng((search.seed, round_number, ATTACKS)))
    for number, one in enumerate(sets):
        degrees = problem.degrees(np.tile(one, (len(random), 1)), random, "attack by random wear")
        failures[number] += [(degrees[row], random[row]) for row in np.flatnonzero(degrees < problem.margin)]
    return [_worst(problem, found) for found in failures]


def _judge(
    problem: Problem,
    sets: Sequence[FloatArray],
    owners: Sequence[int],
    wanted: dict[int, FloatArray],
    columns: Sequence[int],
    own: CharacteristicSet,
    failures: list[list[tuple[float, FloatArray]]],
) -> list[Evaluations]:
    """Evaluations of the settings that searches want, in the characteristics that may wear; notes the failures."""
    if not wanted:
        return []
    wear = []
    for settings in wanted.values():
        full = np.tile(problem.promise.characteristics.original, (len(settings), 1))
        full[:, list(columns)] = settings
        wear.append(problem.evaluator.region.repaired(full, filtered=False) if problem.evaluator.region else full)
    shares = np.repeat(
        [sets[owners[index]] for index in wanted], [len(settings) for settings in wanted.values()], axis=0
    )
    evaluations = problem.evaluate(shares, np.concatenate(wear), "attack")
    degrees, answers, start = degrees_of(evaluations), [], 0
    for (index, settings), full in zip(wanted.items(), wear, strict=True):
        rows = np.arange(start, start + len(settings))
        failures[owners[index]] += [
            (degrees[row], full[row - start]) for row in rows.tolist() if degrees[row] < problem.margin
        ]
        answers.append(_reduced(replace(evaluations.take(rows), settings=full), columns, own))
        start += len(settings)
    return answers


def _reduced(evaluations: Evaluations, columns: Sequence[int], own: CharacteristicSet) -> Evaluations:
    """Evaluations with the columns of the characteristics that may wear."""
    settings = evaluations.settings[:, list(columns)]
    return replace(
        evaluations,
        settings=settings,
        f_diff=own.largest_change(settings),
        f_num_diff=own.number_changed(settings),
        worst_points=None,
    )


MAX_NEW = 32
"""Largest number of failures of an attack that become counterexamples."""


def _worst(problem: Problem, found: Sequence[tuple[float, FloatArray]]) -> FloatArray:
    """The worst distinct failures that a driving system could avoid, worst first."""
    empty = np.zeros((0, len(problem.promise.characteristics)))
    if not found:
        return empty
    order = np.argsort([degree for degree, _ in found], kind="stable")
    settings = np.array([found[row][1] for row in order])
    _, first = np.unique(settings, axis=0, return_index=True)
    settings = settings[np.sort(first)]
    spread = settings[np.linspace(0, len(settings) - 1, min(len(settings), MAX_NEW)).astype(int)]
    return np.asarray(spread[problem.repairable(spread)])


def prove(problem: Problem, one: FloatArray, attempt: int) -> tuple[Proof, FloatArray]:
    """Draw fresh wear for a set of parameters; returns the proof and the unsafe vehicles.

    Attempt k may be wrong with probability alpha / 2^k of alpha = 1 - `CONFIDENCE`, the first with alpha itself if it
    succeeds, so that later attempts draw more.
    """
    error = (1 - CONFIDENCE) / 2**attempt
    number = math.ceil(math.log(error) / math.log1p(-MAX_UNSAFE_SHARE))
    wear = problem.draw(number, np.random.default_rng((problem.study.search.seed, 7, attempt)))
    degrees = problem.degrees(np.tile(one, (number, 1)), wear, "proof on fresh wear")
    failing = wear[degrees < problem.margin]
    unsafe = failing[problem.repairable(failing)] if len(failing) else failing
    drawn = number - len(failing) + len(unsafe)
    bound = (
        1.0 if not drawn else -math.expm1(math.log(error) / drawn) if not len(unsafe) else _bound(len(unsafe), drawn)
    )
    return Proof(drawn, len(unsafe), bound), unsafe


def _bound(unsafe: int, drawn: int) -> float:
    from scipy.stats import beta

    return float(beta.ppf(CONFIDENCE, unsafe + 1, drawn - unsafe)) if unsafe < drawn else 1.0
