"""The contract of a search algorithm, and checks of users' algorithms. This module depends neither
on SUMO nor on processes and files.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, ClassVar

import moocore
import numpy as np

from safevar_sumo.errors import subject
from safevar_sumo.metrics import PUBLISHED_SCORING, Scoring
from safevar_sumo.plugins import (
    Contract,
    Legal,
    Returned,
    UserCode,
    quoted,
    read_only,
    user_errors,
)
from safevar_sumo.records import BoolArray, Evaluations, FloatArray
from safevar_sumo.vehicles import CharacteristicSet, FeasibleRegion

Search = Generator[FloatArray, Evaluations, Evaluations]
"""A generator that yields k filtered settings of n characteristics, shape (k, n), and receives
their evaluations. At its end, the generator returns the result of the run.
"""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """The problem that a search solves.

    Attributes
    ----------
    region
        The settings that satisfy the study's constraints; without constraints, all settings.
        Settings must be in this region after the filter.
    original
        The evaluation of the original vehicle.
    evaluations
        Number of evaluations that the search may request.
    population
        Number of settings in a generation, for algorithms with generations.
    scoring
        The objectives, and the rule which evaluated settings are valid.
    """

    region: FeasibleRegion
    original: Evaluations
    evaluations: int
    population: int
    scoring: Scoring = PUBLISHED_SCORING

    @property
    def characteristics(self) -> CharacteristicSet:
        """The characteristics that the search varies."""
        return self.region.characteristics

    def uniform(self, number: int, rng: np.random.Generator) -> FloatArray:
        """Draw unfiltered settings uniformly in the domains, shape (number, n). The settings are
        feasible after the filter.
        """
        lower = self.characteristics.lower
        upper = self.characteristics.upper

        def draw(count: int) -> FloatArray:
            return rng.uniform(lower, upper, (count, len(lower)))

        # Without constraints, every setting is feasible.
        if not self.region:
            return draw(number)
        return self.region.draw_feasible(draw, number, filtered=True)

    def feasible(self, settings: FloatArray) -> BoolArray:
        """Return which settings, shape (k, n), satisfy the study's constraints after the filter,
        shape (k,).
        """
        return self.region.feasible(self.characteristics.filter(settings))

    def repaired(self, settings: FloatArray) -> FloatArray:
        """Move settings towards the original until they are feasible after the filter, shape (k,
        n).
        """
        return self.region.repaired(settings)

    def nondominated(self, evaluations: Evaluations) -> Evaluations:
        """The valid evaluations that no other valid evaluation dominates."""
        valid = evaluations.take(self.scoring.valid(evaluations))
        return valid.take(
            moocore.is_nondominated(self.scoring.values(valid), keep_weakly=True)
        )


def check_search(
    code: UserCode, method: str, search: Any, problem: Problem, rng: np.random.Generator
) -> Search:
    """Wrap a user's search: the wrapped generator checks the settings and the result."""
    if not hasattr(search, "send"):
        raise code.wrong(
            method,
            quoted(search),
            "a generator: a method that yields settings and returns its result",
        )
    yielded = set[bytes]()
    budget = problem.evaluations
    answer = None
    while True:
        with code.modules.active(), user_errors(subject()), np.errstate():
            try:
                output = search.send(answer)
            except StopIteration as end:
                return _checked_result(code, end.value, yielded, problem)
        settings = _checked_settings(code, output, problem, budget)
        budget -= len(settings)
        yielded.update(setting.tobytes() for setting in settings)
        answer = read_only((yield settings))


def _checked_settings(
    code: UserCode, output: Any, problem: Problem, budget: int
) -> FloatArray:
    """Check an array of settings that a user's search yields, and return it as floats."""
    characteristics = problem.characteristics
    n = len(characteristics)
    if not (
        isinstance(output, np.ndarray)
        and output.ndim == 2
        and output.shape[1] == n
        and 1 <= len(output) <= budget
    ):
        raise code.wrong(
            "search",
            f"settings = {quoted(output)}",
            f"an array of shape (k, {n}) with k from 1 to the {budget} evaluations that are left",
        )
    for characteristic, values in zip(characteristics, output.T, strict=True):
        code.check_numbers(
            "search",
            characteristic.name,
            values,
            (len(output),),
            Legal(characteristic.lower, characteristic.upper),
        )

    settings: FloatArray = output.astype(float)
    if (characteristics.filter(settings) != settings).any():
        raise code.wrong(
            "search", "unfiltered settings", "problem.characteristics.filter(settings)"
        )
    problem.region.check(
        settings,
        otherwise=(
            f", for every setting that {code.name} yields:"
            " problem.characteristics.filter(problem.repaired(settings))"
        ),
    )
    return settings


def _checked_result(
    code: UserCode, result: Any, yielded: set[bytes], problem: Problem
) -> Evaluations:
    """Check that the result consists of settings that the search yielded. Not all of them need be
    valid.
    """
    if not yielded:
        raise code.wrong(
            "search",
            "no settings",
            f"a generator that yields from 1 to {problem.evaluations} settings",
        )
    if not isinstance(result, Evaluations) or not yielded.issuperset(
        setting.tobytes() for setting in result.settings
    ):
        raise code.wrong(
            "search",
            quoted(result),
            "an Evaluations of settings that it was sent, such as evaluations.take(rows)",
        )
    return result


class Algorithm:
    """A search algorithm. The fields of its class are the parameters that a study states in a table
    such as [search.nsga2].

    Attributes
    ----------
    title
        Name of the algorithm in tables and legends; "" for its name in the study.
    stops_by_itself
        Whether the algorithm may end before it has used its budget. If another algorithm does, the
        end of the study and tables say so.
    RETURNS
        What the method of a user's class must return.
    """

    __slots__ = ()
    title: str = ""
    stops_by_itself: ClassVar[bool] = False
    RETURNS: ClassVar[Contract] = {"search": Returned(like=0, then=check_search)}

    @abstractmethod
    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        """Carry out one run, which requests at most `problem.evaluations` evaluations.

        All random numbers must come from `rng`. A resumed run gets the evaluations of its journal,
        and then yields the same settings again. Yielded settings are in the domains, and filtered.

        The result consists of evaluations that the run received. Evaluations that are not valid
        (`problem.scoring.valid`) are no solutions; the command `study` counts them.
        """

    def try_out(self, problem: Problem) -> None:
        """Refuse parameters with which a search would fail, by an `InputError`; by default none."""
