"""Searches for the worst case. A case is a vehicle, the number of the world in which it drives, and
the place of its encounter on the axes of this world. The search is an evolutionary algorithm.

Nothing in this module knows of studies: a judge returns the robustness of cases.
"""

from __future__ import annotations

from collections.abc import Callable, Generator as Steps, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator

from safevar_sumo.records import FloatArray

CaseJudge = Callable[[FloatArray], FloatArray]
"""Returns the robustness of M cases (their distance to the limit of the criterion), shape (M,). A
case is unsafe below 0, and does not count at infinity.
"""
LEAST_SIMULATIONS = 1000
"""Fewest simulations that must search for a counterexample before a value is printed as safe."""
USUAL_BUDGET = 5000
"""Usual number of simulations that search for a counterexample to a claim."""
PARENTS = 32
"""Number of the worst cases so far from which the next generation comes."""
STEP, PULL, DIFFERENCE = 0.1, 0.5, 0.7
"""STEP is the step of a mutation, as a share of the way to a random value. PULL is the share of the
way from one parent to another. DIFFERENCE is the factor on the difference of two further parents (F
of differential evolution; Storn and Price 1997).
"""
OTHER_WORLD = 0.1
"""Share of children that drive in another world than their parents."""


class Space(NamedTuple):
    """All cases between two ends. A case has n values of a vehicle, the number of a world, and k
    places from 0 to 1.

    Attributes
    ----------
    lower, upper
        The ends, shape (n + 1 + k,).
    size
        The number n of a vehicle's values.
    center
        A vehicle, shape (n,), from which a case may differ in only one value; None if a case may
        differ in all values.
    """

    lower: FloatArray
    upper: FloatArray
    size: int
    center: FloatArray | None = None

    @property
    def width(self) -> FloatArray:
        """The widths of the ranges of a vehicle's values, shape (n,); infinite for a value that
        cannot change.
        """
        width = (self.upper - self.lower)[: self.size]
        return np.where(width > 0, width, np.inf)

    def of_vehicles(
        self,
        lower: FloatArray,
        upper: FloatArray,
    ) -> Space:
        """The space with the same worlds and places, but with other ends of the vehicle's values,
        shape (n,).
        """
        return self._replace(
            lower=np.concatenate([lower, self.lower[self.size :]]),
            upper=np.concatenate([upper, self.upper[self.size :]]),
        )

    def draw(
        self,
        number: int,
        rng: Generator,
    ) -> FloatArray:
        """Random cases. Each value of a vehicle is at an end of its range with a probability of one
        half.
        """
        points = rng.random((number, len(self.lower)))
        at_ends = rng.random(points.shape) < 0.5
        at_ends[:, self.size :] = False
        points = np.where(at_ends, np.round(points), points)
        return self.hold(self.lower + points * (self.upper - self.lower), rng)

    def hold(
        self,
        cases: FloatArray,
        rng: Generator,
    ) -> FloatArray:
        """Cases that are moved into the space. With a `center`, a single value of each vehicle
        stays changed: it is chosen at random, and a larger change has a better chance.
        """
        cases = np.clip(cases, self.lower, self.upper)
        if self.center is None:
            return cases
        vehicles = cases[:, : self.size]
        changes = np.abs(vehicles - self.center) / self.width
        columns = np.argmax(changes * rng.random(changes.shape), axis=1)
        is_chosen = np.arange(self.size) == columns[:, np.newaxis]
        cases[:, : self.size] = np.where(is_chosen, vehicles, self.center)
        return cases

    def children(
        self,
        parents: FloatArray,
        number: int,
        rng: Generator,
    ) -> FloatArray:
        """Make `number` new cases from parents. One half of the new cases mixes two parents, and
        changes about one value. The other half moves from one parent towards another, and by a
        difference of two further parents (differential evolution).
        """
        rows = rng.integers(len(parents), size=(4, number))
        mothers, fathers, plus, minus = parents[rows]
        random = self.draw(number, rng)
        mixtures = np.where(rng.random(mothers.shape) < 0.5, mothers, fathers)
        mutants = self._mutants(mixtures, random, rng)
        moves = PULL * (fathers - mothers)
        differences = DIFFERENCE * (plus - minus)
        neighbours = mothers + moves + differences
        is_odd = np.arange(number)[:, np.newaxis] % 2
        cases = np.where(is_odd, neighbours, mutants)

        # The number of a world must not be mixed: a child drives in the world of its first parent
        # or, seldom, in a random world.
        column = self.size
        is_elsewhere = rng.random(number) < OTHER_WORLD
        worlds = np.where(is_elsewhere, random[:, column], mothers[:, column])
        cases[:, column] = worlds
        return self.hold(cases, rng)

    def _mutants(
        self,
        cases: FloatArray,
        random: FloatArray,
        rng: Generator,
    ) -> FloatArray:
        """Mutated cases. On average a little more than one value changes: it becomes the random
        value, makes a step towards the random value, or becomes an end of its range.
        """
        ends = np.where(rng.random(cases.shape) < 0.5, self.lower, self.upper)
        number_open = max(int(np.count_nonzero(self.lower < self.upper)), 1)
        lot = rng.random(cases.shape) * number_open
        steps = cases + STEP * (random - cases)
        return np.select(
            [lot < 0.4, lot < 0.8, lot < 1.2], [random, steps, ends], cases
        )


class SearchPlan(NamedTuple):
    """The plan of a search for counterexamples.

    Attributes
    ----------
    budget
        Largest number of cases of the search.
    generation
        Number of cases of a generation.
    sequel
        Number of generations that follow the first generation with an unsafe case.
    """

    budget: int
    generation: int = 512
    sequel: int = 2


class Counterexamples(NamedTuple):
    """The result of a search for counterexamples.

    Attributes
    ----------
    cases
        The worst cases, and all unsafe cases, the worst first, shape (K, n + 1 + k).
    robustness
        Their robustness, shape (K,).
    simulated
        Number of all cases of the search.
    """

    cases: FloatArray
    robustness: FloatArray
    simulated: int = 0

    @property
    def unsafe(self) -> FloatArray:
        """The unsafe cases."""
        return self.cases[self.robustness < 0]

    @property
    def least(self) -> float:
        """The robustness of the worst case; infinite if no case counts."""
        return float(self.robustness.min(initial=np.inf))

    def after(
        self,
        cases: FloatArray,
        robustness: FloatArray,
    ) -> Counterexamples:
        """The result after further cases with their robustness."""
        counts = np.isfinite(robustness)
        every_case = np.concatenate([self.cases, cases[counts]])
        values = np.concatenate([self.robustness, robustness[counts]])
        number = max(PARENTS, np.count_nonzero(values < 0))
        worst = np.argsort(values, kind="stable")[:number]
        return Counterexamples(
            every_case[worst], values[worst], self.simulated + len(cases)
        )


CaseSearch = Callable[[Space, FloatArray], Counterexamples]
"""Searches a space for unsafe cases. The search begins with known cases, shape (K, n + 1 + k)."""
Generations = Steps[FloatArray, FloatArray, Counterexamples]
"""A search as a generator: it yields the cases of a generation, is sent their robustness, and
returns the result.
"""


def search_cases(
    judge: CaseJudge,
    space: Space,
    start: FloatArray,
    plan: SearchPlan,
    rng: Generator,
) -> Counterexamples:
    """Search a space for the cases with the least robustness, in generations. The search begins
    with the known cases `start`, and ends `plan.sequel` generations after the first unsafe case.
    """
    return search_side_by_side(judge, [generations_of(space, start, plan, rng)])[0]


def search_side_by_side(
    judge: CaseJudge,
    searches: Sequence[Generations],
) -> list[Counterexamples]:
    """Run several searches at the same time. The judge gets a generation of each search in one
    batch, because few large batches cost less than many small ones.
    """
    results = {}
    judged: dict[int, Any] = dict.fromkeys(range(len(searches)))
    while judged:
        generations = {}
        for number, robustness in judged.items():
            try:
                generations[number] = searches[number].send(robustness)
            except StopIteration as end:
                results[number] = end.value
        if not generations:
            break
        ends = np.cumsum(list(map(len, generations.values())))[:-1]
        robustness = judge(np.concatenate(list(generations.values())))
        parts = np.split(robustness, ends)
        judged = dict(zip(generations, parts, strict=True))
    return [results[number] for number in range(len(searches))]


def generations_of(
    space: Space,
    start: FloatArray,
    plan: SearchPlan,
    rng: Generator,
) -> Generations:
    """The generations of a search of a space (`search_cases`)."""
    size = plan.generation
    generations = plan.sequel
    results = Counterexamples(start[:0], np.zeros(0))
    cases = np.concatenate([space.hold(start, rng), space.draw(size, rng)])
    while results.simulated < plan.budget and generations >= 0:
        cases = cases[: plan.budget - results.simulated]
        robustness = yield cases
        results = results.after(cases, robustness)
        generations -= len(results.unsafe) > 0
        parents = results.cases[:PARENTS]
        cases = (
            space.children(parents, size, rng)
            if len(parents)
            else space.draw(size, rng)
        )
    return results
