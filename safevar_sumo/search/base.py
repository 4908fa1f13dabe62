"""The contract of a search algorithm, and checks of users' algorithms; independent of SUMO,
processes and files.
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
"""A generator that yields k filtered settings of n characteristics, shape (k, n), receives their
evaluations, and so on; at its end it returns the run's result.
"""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """The characteristics to vary, the original vehicle's evaluation and the budget of evaluations.

    `population` is the number of settings of a generation, for algorithms with generations;
    `scoring` defines the objectives, and which evaluated settings are feasible. `region` is the
    feasible region of a study with constraints: yielded settings must lie in this region after the
    filter.
    """

    characteristics: CharacteristicSet
    original: Evaluations
    evaluations: int
    population: int
    scoring: Scoring = PUBLISHED_SCORING
    region: FeasibleRegion | None = None

    def uniform(self, number: int, rng: np.random.Generator) -> FloatArray:
        """Unfiltered settings, drawn uniformly in the domains and feasible after the filter; shape
        (number, n).
        """
        lower = self.characteristics.lower
        upper = self.characteristics.upper

        def draw(count: int) -> FloatArray:
            return rng.uniform(lower, upper, (count, len(lower)))

        if not self.region:
            return draw(number)
        return self.region.draw_feasible(draw, number, filtered=True)

    def feasible(self, settings: FloatArray) -> BoolArray:
        """Which settings, shape (k, n), satisfy the study's constraints after the filter; shape
        (k,).
        """
        filtered = self.characteristics.filter(settings)
        if not self.region:
            return np.ones(len(filtered), bool)
        return self.region.feasible(filtered)

    def repaired(self, settings: FloatArray) -> FloatArray:
        """Settings moved towards the original until they are feasible after the filter; shape (k,
        n).
        """
        if not self.region:
            return settings
        return self.region.repaired(settings)

    def nondominated(self, evaluations: Evaluations) -> Evaluations:
        """The valid evaluations that no other one of them dominates."""
        valid = evaluations.take(self.scoring.valid(evaluations))
        return valid.take(
            moocore.is_nondominated(self.scoring.values(valid), keep_weakly=True)
        )


def check_search(
    code: UserCode, method: str, search: Any, problem: Problem, rng: np.random.Generator
) -> Search:
    """A user's search, whose settings and result are checked."""
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
        with user_errors(subject()), np.errstate():
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
    characteristics = problem.characteristics
    shape = (
        f"shape (k, {len(characteristics)}) with k from 1 to the {budget}"
        " evaluations that are left"
    )
    is_matrix = isinstance(output, np.ndarray) and output.ndim == 2
    if (
        not is_matrix
        or output.shape[1] != len(characteristics)
        or not 1 <= len(output) <= budget
    ):
        raise code.wrong(
            "search", f"settings = {quoted(output)}", f"an array of {shape}"
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
    if problem.region:
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
    """The result, whose settings were yielded; not all need be valid."""
    if not yielded:
        raise code.wrong(
            "search",
            "no settings",
            f"a generator that yields from 1 to {problem.evaluations} settings",
        )
    if not isinstance(result, Evaluations) or any(
        setting.tobytes() not in yielded for setting in result.settings
    ):
        raise code.wrong(
            "search",
            quoted(result),
            "an Evaluations of settings that it was sent, such as evaluations.take(rows)",
        )
    return result


class Algorithm:
    """A search algorithm. Its fields are the parameters that a study gives in a table such as
    [search.nsga2].

    `title` is its name in tables and legends, by default its name in the study. `stops_by_itself`
    says that it may end before it has used its budget: of others that do, the study's end and
    tables say so. `RETURNS` is what the method of a user's class must return.
    """

    __slots__ = ()
    title: str = ""
    stops_by_itself: ClassVar[bool] = False
    RETURNS: ClassVar[Contract] = {"search": Returned(like=0, then=check_search)}

    @abstractmethod
    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        """One run, which requests at most `problem.evaluations` evaluations.

        All randomness comes from `rng`, so that a run which is resumed, with the evaluations of its
        journal, yields the same settings again. Yielded settings are in the domains and filtered.
        The result consists of evaluations that the run received. Those that are not valid
        (`problem.scoring.valid`) are no solutions, and the command `study` counts them.
        """

    def try_out(self, problem: Problem) -> None:
        """Refuse, by an `InputError`, parameters with which a search fails; by default none."""
