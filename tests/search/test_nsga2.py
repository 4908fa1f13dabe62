"""NSGA-II and random search against fronts that are known, and NSGA-II against another implementation."""

from __future__ import annotations

import random

import moocore
import numpy as np
import pytest
from jmetal.algorithm.multiobjective.nsgaii import NSGAII
from jmetal.operator.crossover import SBXCrossover
from jmetal.operator.mutation import PolynomialMutation
from jmetal.problem import DTLZ2
from jmetal.util.termination_criterion import StoppingByEvaluations
from scipy.stats import mannwhitneyu

from safevar_sumo.records import Evaluations
from safevar_sumo.vehicles import Characteristic, CharacteristicSet
from tests.search.problems import POPULATION, evaluated, searched


@pytest.mark.parametrize("name", ["nsga2", "rs"])
def test_the_result_is_non_dominated(name: str) -> None:
    found = searched(name, 7, 600)[0]
    assert len(found) > 0
    assert moocore.is_nondominated(found.objectives, keep_weakly=True).all()


@pytest.mark.parametrize("name", ["nsga2", "rs"])
def test_a_longer_search_dominates_more(name: str) -> None:
    reference = np.array([12.0, 1.0, 12.0])

    def volume(evaluations: int) -> float:
        return float(np.median([moocore.hypervolume(searched(name, seed, evaluations)[0].objectives, ref=reference) for seed in range(5)]))

    assert volume(POPULATION) < volume(200) < volume(1500)


def test_nsga2_finds_the_known_front_of_one_variable() -> None:
    """Two conflicting objectives in one variable: everything between the original and the lower end is optimal."""
    single = CharacteristicSet((Characteristic(name="c", unit="-", original=5.0, lower=1.0, upper=9.0),))

    def linear(characteristics: CharacteristicSet, settings: np.ndarray) -> Evaluations:
        return evaluated(characteristics, settings, settings[:, 0].copy())

    found = searched("nsga2", 1, 1000, single, linear)[0]
    assert np.all(found.settings <= 5.0)
    assert found.settings.min() == pytest.approx(1.0, abs=1e-3)
    assert len(np.unique(found.settings)) > POPULATION / 2


class _Dtlz2(Evaluations):
    """Evaluations whose three objectives are those of the standard problem DTLZ2, not those of a vehicle."""

    @property
    def objectives(self) -> np.ndarray:
        x, rest = self.settings[:, :2] - 1, self.settings[:, 2:] - 1
        g = 1 + ((rest - 0.5) ** 2).sum(axis=1)
        angles = x * np.pi / 2
        return np.stack([g * np.cos(angles[:, 0]) * np.cos(angles[:, 1]), g * np.cos(angles[:, 0]) * np.sin(angles[:, 1]),
                         g * np.sin(angles[:, 0])], axis=1)

    def column(self, name: str) -> np.ndarray:
        return self.objectives[:, ["f_safe", "f_diff", "f_num_diff"].index(name)]

    def take(self, rows) -> Evaluations:  # type: ignore[no-untyped-def]
        return _Dtlz2(**vars(super().take(rows)))


def dtlz2(characteristics: CharacteristicSet, settings: np.ndarray) -> Evaluations:
    return _Dtlz2(**vars(evaluated(characteristics, settings, settings[:, 0])))


def test_hypervolumes_are_those_of_jmetalpy_on_dtlz2() -> None:
    """The package of the study used jMetalPy; ten runs each of the same settings do not differ significantly."""
    variables, evaluations = 7, 3000

    class Unfiltered(CharacteristicSet):
        def filter(self, settings: np.ndarray) -> np.ndarray:
            return settings

    unit = Unfiltered(tuple(Characteristic(name=f"x{i}", unit="-", original=1.5, lower=1.0, upper=2.0) for i in range(variables)))
    reference = np.full(3, 2.0)
    ours, theirs = [], []
    for seed in range(10):
        found = _Dtlz2(**vars(searched("nsga2", seed, evaluations, unit, dtlz2)[0]))
        ours.append(moocore.hypervolume(found.objectives, ref=reference))
        random.seed(seed)
        np.random.seed(seed)
        problem = DTLZ2(number_of_variables=variables)
        algorithm = NSGAII(problem=problem, population_size=POPULATION, offspring_population_size=POPULATION,
                           mutation=PolynomialMutation(probability=1 / variables, distribution_index=20),
                           crossover=SBXCrossover(probability=0.9, distribution_index=20),
                           termination_criterion=StoppingByEvaluations(max_evaluations=evaluations))
        algorithm.run()
        front = np.array([solution.objectives for solution in algorithm.result()])
        theirs.append(moocore.hypervolume(front[moocore.is_nondominated(front)], ref=reference))
    assert mannwhitneyu(ours, theirs).pvalue > 0.05, (np.median(ours), np.median(theirs))
