"""Algorithms of pymoo (Blank and Deb 2020) as algorithms of this package. A study names an
algorithm as `pymoo:NSGA3`. pymoo's algorithm asks for settings, and is told their objectives.
"""

from __future__ import annotations

import copy
import importlib
import inspect
import math
from types import SimpleNamespace
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType
from numpy.random import Generator, default_rng

from safevar_sumo.errors import InputError, check_name, describe_error, missing_extra
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.search.base import Algorithm, Problem, Search
from safevar_sumo.study import PYMOO, Table, label_of
from safevar_sumo.study.encounters import Parameters

MODULES = {
    "moo.age": "AGEMOEA",
    "moo.age2": "AGEMOEA2",
    "moo.cmopso": "CMOPSO",
    "moo.ctaea": "CTAEA",
    "moo.gde3": "GDE3 GDE3MNN GDE32NN GDE3PCD",
    "moo.moead": "MOEAD ParallelMOEAD",
    "moo.mopso_cd": "MOPSO_CD",
    "moo.nsde": "NSDE",
    "moo.nsder": "NSDER",
    "moo.nsga2": "NSGA2",
    "moo.nsga3": "NSGA3",
    "moo.omni": "OmniOptimizer",
    "moo.rnsga2": "RNSGA2",
    "moo.rnsga3": "RNSGA3",
    "moo.rvea": "RVEA",
    "moo.sms": "SMSEMOA",
    "moo.spea2": "SPEA2",
    "moo.unsga3": "UNSGA3",
    "soo.nonconvex.brkga": "BRKGA",
    "soo.nonconvex.cmaes": "CMAES SimpleCMAES BIPOPCMAES",
    "soo.nonconvex.de": "DE",
    "soo.nonconvex.direct": "DIRECT",
    "soo.nonconvex.es": "ES",
    "soo.nonconvex.g3pcx": "G3PCX",
    "soo.nonconvex.ga": "GA",
    "soo.nonconvex.ga_niching": "NicheGA",
    "soo.nonconvex.isres": "ISRES",
    "soo.nonconvex.nelder": "NelderMead",
    "soo.nonconvex.nrbo": "NRBO",
    "soo.nonconvex.pattern": "PatternSearch",
    "soo.nonconvex.pso": "PSO",
    "soo.nonconvex.pso_ep": "EPPSO",
    "soo.nonconvex.sres": "SRES",
}
"""The names of pymoo's algorithms for real numbers, by their modules. Modules of `moo` have
algorithms for several objectives, modules of `soo` for one objective.
"""
PYMOO_ALGORITHMS = {
    PYMOO + name: module for module, names in MODULES.items() for name in names.split()
}
"""The module of each algorithm, by the algorithm's name in a study.

Left out are pymoo's second random search, and algorithms for problems that change over time
(DNSGA2, KGB), for bits (BGA), and for a person who decides (PINSGA2).
"""
PARTITIONS = 12
"""Partitions of each objective in the reference directions of Das and Dennis (1998), if a study
states no number.
"""
MAX_DIRECTIONS = 100_000
"""Largest number of reference directions, and of individuals in a population."""
DirectionCount = Annotated[int, Meta(ge=1, le=MAX_DIRECTIONS)]
TYPES: Parameters = {
    "ref_dirs": DirectionCount | list[list[float]],
    "ref_points": list[list[float]],
    "pop_per_ref_point": DirectionCount,
    "pop_size": DirectionCount,
    "n_offsprings": DirectionCount,
    "weights": list[float],
    "F": float | list[float],
}
"""Types of arguments whose default value in pymoo does not show the type."""
HIDDEN_ARGUMENTS = {
    "verb_log",
    "cmaes_verbose",
    "maxfevals",
    "n_diffs",
    "advance_after_initial_infill",
}
"""Arguments that a study cannot state, because they write files, print, or have nothing to
choose.
"""
LEAST_POPULATION = 4
"""Least size of a population. With fewer individuals, GDE3 and NSDE draw random numbers for
ever.
"""
FAILED = 1e9
"""The objectives and the violation that pymoo is told for a setting that could not be scored."""


class PymooAlgorithm(Algorithm, Table, frozen=True, kw_only=True):
    """An algorithm of pymoo. Its fields are the arguments of pymoo's class that are plain values.

    If pymoo's class has a default size of its population, the study's population replaces this
    size. `ref_dirs` are reference directions, or the number of partitions in Das and Dennis's
    method. The search varies the unfiltered values of the characteristics. An algorithm for one
    objective minimises the first objective.

    The result is pymoo's optimum. If the budget ends within a generation, the settings of this
    generation count, too. A setting that could not be scored is infeasible.
    """

    name: ClassVar[str]

    def search(self, problem: Problem, rng: Generator) -> Search:
        randomness = _Randomness(self.name, rng)

        budget = problem.evaluations
        batches = [problem.original.take([])]
        with randomness:
            from pymoo.core.individual import Individual
            from pymoo.core.population import Population
            from pymoo.util.optimum import filter_optimum

            algorithm = self.begin(problem, randomness.seed)
            optimum = Population()

        while budget > 0 and algorithm.has_next():
            with randomness:
                infills = algorithm.ask()
            group = infills
            if isinstance(infills, Individual):
                group = [infills]
            if group is None or len(group) == 0:
                break
            new = [individual for individual in group if not individual.evaluated]
            batch = Population.create(*new[:budget])
            budget -= len(new)
            if new:
                evaluations = yield _settings(batch, problem)
                batches.append(evaluations)
                _score(batch, evaluations, problem, algorithm)
            with randomness:
                if budget >= 0:
                    algorithm.tell(infills=infills)
                    optimum = algorithm.opt
                else:
                    optimum = filter_optimum(
                        Population.merge(optimum, batch), least_infeasible=True
                    )
        evaluations = Evaluations.concatenate(batches)
        rows = {
            setting.tobytes(): row for row, setting in enumerate(evaluations.settings)
        }
        optimal_rows = [
            rows[setting.tobytes()] for setting in _settings(optimum, problem)
        ]
        result = evaluations.take(optimal_rows)
        return result.take(problem.scoring.valid(result))

    def try_out(self, problem: Problem) -> None:
        """Refuse arguments that pymoo refuses when its algorithm is created."""
        size = getattr(self, "pop_size", UNSET)
        if size is not UNSET and size > problem.evaluations:
            raise InputError(
                self.name,
                f"pop_size = {size}",
                f"at most the {problem.evaluations} evaluations of a run",
            )
        with _Randomness(self.name, default_rng(0)):
            self.begin(problem, 0)

    def begin(self, problem: Problem, seed: int) -> Any:
        """Create pymoo's algorithm, before its first request."""
        from pymoo.core.problem import Problem as PymooProblem

        # The user's arguments win over the study's population, which wins over pymoo's defaults.
        objectives = 1
        if PYMOO_ALGORITHMS[self.name].startswith("moo."):
            objectives = len(problem.scoring.objectives)
        defaults = _plain_arguments(self.name)
        arguments = Parameters()
        if isinstance(defaults.get("pop_size"), int):
            arguments["pop_size"] = problem.population
        for name in defaults:
            value = getattr(self, name)
            if isinstance(value, list) and name != "F":
                value = np.array(value)
            if value is not UNSET:
                arguments[name] = value
        if arguments.get("pop_size", LEAST_POPULATION) < LEAST_POPULATION:
            raise ValueError(
                f"pop_size = {arguments['pop_size']} is below {LEAST_POPULATION}"
            )
        if "ref_dirs" in defaults:
            partitions = arguments.get("ref_dirs", PARTITIONS)
            arguments["ref_dirs"] = _reference_directions(partitions, objectives)
            number = len(arguments["ref_dirs"])
            if arguments.get("pop_size", np.inf) < number:
                raise ValueError(
                    f"pop_size is less than the {number} reference directions"
                )
        lower = problem.characteristics.lower
        upper = problem.characteristics.upper
        # MOEAD raises an error for problems with constraints.
        task = PymooProblem(
            len(lower),
            objectives,
            n_ieq_constr=int(not self.name.endswith("MOEAD")),
            xl=lower,
            xu=upper,
        )
        # pymoo's classes have default objects that runs would share: each run gets a copy.
        algorithm = copy.deepcopy(_class_of(self.name)(**arguments))
        return algorithm.setup(
            task, termination=("n_eval", problem.evaluations), seed=seed
        )


def _reference_directions(partitions: Any, objectives: int) -> Any:
    """The reference directions for a number of partitions of each objective; directions that the
    user has stated stay.
    """
    from pymoo.util.ref_dirs import get_reference_directions

    if not isinstance(partitions, int):
        return partitions
    if math.comb(partitions + objectives - 1, partitions) > MAX_DIRECTIONS:
        raise ValueError(
            f"ref_dirs = {partitions} are more than {MAX_DIRECTIONS:,} reference directions"
        )
    return get_reference_directions("das-dennis", objectives, n_partitions=partitions)


def _settings(population: Any, problem: Problem) -> FloatArray:
    """The filtered settings of a population of pymoo, shape (k, n)."""
    characteristics = problem.characteristics
    values = population.get("X").astype(float).reshape(-1, len(characteristics))
    values = np.clip(values, characteristics.lower, characteristics.upper)
    return characteristics.filter(problem.repaired(values))


def _score(
    population: Any, evaluations: Evaluations, problem: Problem, algorithm: Any
) -> None:
    """Write objectives and violations into the individuals of a population."""
    scoring = problem.scoring
    valid = scoring.valid(evaluations)
    violations = scoring.violation(evaluations)
    values = np.where(
        valid[:, np.newaxis],
        scoring.values(evaluations)[:, : algorithm.problem.n_obj],
        FAILED,
    )
    violations = np.where(
        valid | (violations > 0), np.minimum(violations, FAILED), FAILED
    )
    population.set("F", values, "G", violations[:, np.newaxis])
    population.apply(lambda individual: individual.evaluated.update("FGH"))
    algorithm.evaluator.n_eval += len(evaluations)


class _Randomness:
    """Within its blocks, pymoo draws the random numbers of one run, and errors of pymoo become
    errors about the user's arguments.

    pymoo and pycma draw from numpy's global state, and from generators without a seed. Therefore a
    block sets numpy's global state, and replaces `default_rng` in pymoo.
    """

    def __init__(self, name: str, rng: Generator) -> None:
        self._name = name
        self._unseeded = rng.spawn(1)[0]
        self.seed = int(rng.integers(2**31))
        self._inside = np.random.RandomState(self.seed).get_state()

    def default_rng(self, seed: int | None) -> Generator:
        """The function that replaces `numpy.random.default_rng` in pymoo."""
        if seed is None:
            return self._unseeded
        return default_rng(seed)

    def __enter__(self) -> None:
        import pymoo.util

        self._outside = np.random.get_state()
        np.random.set_state(self._inside)
        pymoo.util.np = SimpleNamespace(random=self)

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        import pymoo.util

        self._inside = np.random.get_state()
        np.random.set_state(self._outside)
        pymoo.util.np = np
        if isinstance(error, Exception):
            raise InputError(
                self._name, describe_error(error), "other arguments or objectives"
            ) from error


def pymoo_algorithm(name: str) -> type[PymooAlgorithm]:
    """Make the class of an algorithm of pymoo, by the algorithm's name in a study.

    Raises
    ------
    InputError
        If pymoo is not installed, or has no such algorithm.
    """
    check_name("", f"search.algorithms = {name!r}", name, PYMOO_ALGORITHMS)
    fields = list[Any]()
    for argument, default in _plain_arguments(name).items():
        kind = TYPES.get(argument, type(default))
        if default is inspect.Parameter.empty and argument != "ref_dirs":
            fields.append((argument, kind))
        else:
            fields.append((argument, kind | UnsetType, UNSET))
    namespace = {"name": name, "title": f"{name.removeprefix(PYMOO)} (pymoo)"}
    algorithm: Any = msgspec.defstruct(
        label_of(name), fields, bases=(PymooAlgorithm,), namespace=namespace
    )
    return algorithm  # type: ignore[no-any-return]


def _class_of(name: str) -> Any:
    """The class of an algorithm in pymoo. Raise an InputError if pymoo is not installed."""
    try:
        from pymoo.config import Config
    except ImportError:
        raise missing_extra(
            name, "pymoo, the library of search algorithms, is not installed", "pymoo"
        ) from None
    Config.warnings["not_compiled"] = False
    from pymoo.functions import FunctionLoader

    # The compiled crowding distance of GDE3PCD ends the process in pymoo 0.6.2. Not every machine
    # has compiled functions, and results must not depend on the machine.
    FunctionLoader.get_instance().is_compiled = False
    return getattr(
        importlib.import_module(f"pymoo.algorithms.{PYMOO_ALGORITHMS[name]}"),
        name.removeprefix(PYMOO),
    )


def _plain_arguments(name: str) -> Parameters:
    """The arguments that a study's file can state, with their default values. The arguments are
    those of the algorithm's class and of its bases.
    """
    algorithm = _class_of(name)
    arguments = dict[str, inspect.Parameter]()
    # The class DE takes its arguments from a class Variant, without naming them.
    variant = getattr(
        importlib.import_module(algorithm.__module__), "Variant", algorithm
    )
    for ancestor in (*algorithm.__mro__[:-2], variant):
        arguments = {**inspect.signature(ancestor.__init__).parameters, **arguments}

    if "ref_points" in arguments:
        arguments.pop("ref_dirs", None)
    return {
        argument: parameter.default
        for argument, parameter in arguments.items()
        if argument not in HIDDEN_ARGUMENTS
        and (
            argument in TYPES or isinstance(parameter.default, bool | int | float | str)
        )
    }
