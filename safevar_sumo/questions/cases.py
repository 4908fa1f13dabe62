"""Cases: a vehicle, the number of the world in which it drives, and its place on the axes of that
world's encounters; and the search for the case that leaves least to the limit.

Nothing here knows of studies: a judge says what cases leave.
"""

from __future__ import annotations

from collections.abc import Callable, Generator as Steps, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator

from safevar_sumo.records import FloatArray

CaseJudge = Callable[[FloatArray], FloatArray]
"""What each of M cases leaves to the limit, shape (M,): below 0 it is unsafe; infinite where it
does not count.
"""
LEAST_SIMULATIONS = 1000
"""Fewest simulations that search for a counterexample before a value is printed as one that holds.
"""
USUAL_BUDGET = 5000
"""Simulations that search for a counterexample to a claim."""
PARENTS = 32
"""The worst cases so far, from which the next ones come."""
STEP, PULL, DIFFERENCE = 0.1, 0.5, 0.7
"""Step of a mutation, as a share of the way to a random value; share of the way to a worse parent;
factor on the difference of two parents (F of differential evolution; Storn and Price 1997).
"""
OTHER_WORLD = 0.1
"""Share of children that drive in another world than their parents."""


class Space(NamedTuple):
    """All cases between two ends, each of shape (n + 1 + k,): n values of a vehicle, the number of
    a world, and k places from 0 to 1.

    Attributes
    ----------
    size
        The number n of a vehicle's values.
    center
        The vehicle from which a case may differ in one value alone, shape (n,); None if in all.
    """

    lower: FloatArray
    upper: FloatArray
    size: int
    center: FloatArray | None = None

    @property
    def width(self) -> FloatArray:
        """The widths of the vehicle's values; infinite where there is only one."""
        width = (self.upper - self.lower)[: self.size]
        return np.where(width > 0, width, np.inf)

    def of_vehicles(
        self,
        lower: FloatArray,
        upper: FloatArray,
    ) -> Space:
        """The cases of other vehicles in the same worlds and places."""
        return self._replace(
            lower=np.concatenate([lower, self.lower[self.size :]]),
            upper=np.concatenate([upper, self.upper[self.size :]]),
        )

    def draw(
        self,
        number: int,
        rng: Generator,
    ) -> FloatArray:
        """Random cases, with half of the vehicles' values at ends."""
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
        """Cases moved into the space."""
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
        """Half of them mix two parents, and change about one value; half move towards a worse
        parent, and by a difference of two others. The worst parents come first.
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

        # A place has no meaning in another world.
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
        """Cases of which about one value is random, a step towards that, or an end."""
        ends = np.where(rng.random(cases.shape) < 0.5, self.lower, self.upper)
        number_open = max(int(np.count_nonzero(self.lower < self.upper)), 1)
        lot = rng.random(cases.shape) * number_open
        steps = cases + STEP * (random - cases)
        return np.select(
            [lot < 0.4, lot < 0.8, lot < 1.2], [random, steps, ends], cases
        )


class SearchPlan(NamedTuple):
    """How a search for counterexamples goes: the largest number of cases, those of a generation,
    and the generations that follow the first with an unsafe case.
    """

    budget: int
    generation: int = 512
    sequel: int = 2


class Counterexamples(NamedTuple):
    """What a search met: the worst cases, worst first, with all unsafe ones, shape (K, n + 1 + k);
    what they leave, shape (K,); and the number of all.
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
        """What the worst case leaves; infinite without one that counts."""
        return float(self.robustness.min(initial=np.inf))

    def after(
        self,
        cases: FloatArray,
        robustness: FloatArray,
    ) -> Counterexamples:
        """With the worst of further cases."""
        counts = np.isfinite(robustness)
        every_case = np.concatenate([self.cases, cases[counts]])
        values = np.concatenate([self.robustness, robustness[counts]])
        number = max(PARENTS, np.count_nonzero(values < 0))
        worst = np.argsort(values, kind="stable")[:number]
        return Counterexamples(
            every_case[worst], values[worst], self.simulated + len(cases)
        )


CaseSearch = Callable[[Space, FloatArray], Counterexamples]
"""Searches a space for unsafe cases, from known ones on, shape (K, n + 1 + k)."""
Generations = Steps[FloatArray, FloatArray, Counterexamples]
"""The generations of a search, which takes what the cases of each leave."""


def search_cases(
    judge: CaseJudge,
    space: Space,
    start: FloatArray,
    plan: SearchPlan,
    rng: Generator,
) -> Counterexamples:
    """Search a space for the cases that leave least, from known ones on, in generations; it ends
    soon after a case is unsafe.
    """
    return search_side_by_side(judge, [generations_of(space, start, plan, rng)])[0]


def search_side_by_side(
    judge: CaseJudge,
    searches: Sequence[Generations],
) -> list[Counterexamples]:
    """Several searches: a generation of all meets the judge in one batch, as few large batches cost
    less than many small ones.
    """
    results = dict[int, Counterexamples]()
    judged: dict[int, Any] = dict.fromkeys(range(len(searches)))
    while judged:
        generations = dict[int, FloatArray]()
        for number, robustness in judged.items():
            try:
                generations[number] = searches[number].send(robustness)
            except StopIteration as end:
                results[number] = end.value
        if not generations:
            break
        ends = np.cumsum(list(map(len, generations.values())))[:-1]
        robustness = judge(np.concatenate([*generations.values()]))
        parts = np.split(robustness, ends)
        judged = dict(zip(generations, parts, strict=True))
    return [results[number] for number in range(len(searches))]


def generations_of(
    space: Space,
    start: FloatArray,
    plan: SearchPlan,
    rng: Generator,
) -> Generations:
    """The generations of a search of a space."""
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
