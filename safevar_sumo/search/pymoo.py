"""The algorithms of pymoo (Blank and Deb 2020) by name, such as `pymoo:NSGA3`: its ask and tell
behind our contract.
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
"""pymoo's algorithms for real numbers by their module: `moo` for several objectives, `soo` for one.
"""
PYMOO_ALGORITHMS = {
    PYMOO + name: module for module, names in MODULES.items() for name in names.split()
}
"""The module of each algorithm, by its name in a study. Not here: algorithms for problems that
change over time (DNSGA2, KGB), for bits (BGA) and for a person who decides (PINSGA2), and a second
random search.
"""
PARTITIONS = 12
"""Partitions of each objective in Das and Dennis's directions (1998), where a study gives no
others.
"""
MAX_DIRECTIONS = 100_000
"""Largest number of reference directions, and of individuals."""
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
"""Types of arguments whose default value in pymoo does not tell them."""
HIDDEN = {
    "verb_log",
    "cmaes_verbose",
    "maxfevals",
    "n_diffs",
    "advance_after_initial_infill",
}
"""Arguments that write files, print, or are no choice of the user's."""
LEAST_POPULATION = 4
"""With fewer individuals GDE3 and NSDE draw for ever."""
FAILED = 1e9
"""Objectives and violation, for pymoo, of a setting that could not be scored."""


class PymooAlgorithm(Algorithm, Table, frozen=True, kw_only=True):
    """An algorithm of pymoo; its fields are those arguments of pymoo's class that are plain values.

    A population that has a size by default has the study's. `ref_dirs` are reference directions, or
    the number of partitions of Das and Dennis's. The variables are the characteristics' unfiltered
    values; an algorithm for one objective minimises the first. The result is pymoo's optimum,
    together with the settings of an incomplete last generation. A setting that could not be scored
    is infeasible.
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
            if group is None or not len(group):
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
        """Refuse arguments that pymoo refuses before its first request."""
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
        """pymoo's algorithm before its first request."""
        from pymoo.core.problem import Problem as PymooProblem
        from pymoo.util.ref_dirs import get_reference_directions

        # The user's values come before the study's population, and this before pymoo's defaults.
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
            if isinstance(partitions, int):
                if math.comb(partitions + objectives - 1, partitions) > MAX_DIRECTIONS:
                    raise ValueError(
                        f"ref_dirs = {partitions} are more than {MAX_DIRECTIONS:,} reference"
                        " directions"
                    )
                arguments["ref_dirs"] = get_reference_directions(
                    "das-dennis", objectives, n_partitions=partitions
                )
            number = len(arguments["ref_dirs"])
            if arguments.get("pop_size", np.inf) < number:
                raise ValueError(
                    f"pop_size is less than the {number} reference directions"
                )
        lower = problem.characteristics.lower
        upper = problem.characteristics.upper
        # MOEAD refuses constraints.
        task = PymooProblem(
            len(lower),
            objectives,
            n_ieq_constr=int(not self.name.endswith("MOEAD")),
            xl=lower,
            xu=upper,
        )
        # Without a copy, runs would share the defaults of pymoo's classes.
        algorithm = copy.deepcopy(_class_of(self.name)(**arguments))
        return algorithm.setup(
            task, termination=("n_eval", problem.evaluations), seed=seed
        )


def _settings(population: Any, problem: Problem) -> FloatArray:
    """The filtered settings of pymoo's individuals, shape (k, n)."""
    characteristics = problem.characteristics
    values = population.get("X").astype(float).reshape(-1, len(characteristics))
    values = np.clip(values, characteristics.lower, characteristics.upper)
    return characteristics.filter(problem.repaired(values))


def _score(
    population: Any, evaluations: Evaluations, problem: Problem, algorithm: Any
) -> None:
    """Give pymoo's individuals their objectives and violations."""
    scoring = problem.scoring
    valid = scoring.valid(evaluations)
    violations = scoring.violation(evaluations)
    values = np.where(
        valid[:, None],
        scoring.values(evaluations)[:, : algorithm.problem.n_obj],
        FAILED,
    )
    violations = np.where(
        valid | (violations > 0), np.minimum(violations, FAILED), FAILED
    )
    population.set("F", values, "G", violations[:, None])
    population.apply(lambda individual: individual.evaluated.update("FGH"))
    algorithm.evaluator.n_eval += len(evaluations)


class _Randomness:
    """Blocks in which the randomness of pymoo is that of one run, and its errors are the user's.

    pymoo and pycma draw from numpy's global state, and from generators without a seed, too.
    """

    def __init__(self, name: str, rng: Generator) -> None:
        self._name = name
        self._unseeded = rng.spawn(1)[0]
        self.seed = int(rng.integers(2**31))
        self._inside = np.random.RandomState(self.seed).get_state()

    def default_rng(self, seed: int | None) -> Generator:
        """What pymoo takes for numpy's function."""
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
    """The class of an algorithm of pymoo by its name in a study.

    Raises
    ------
    InputError
        If pymoo is not installed or has no such algorithm.
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
    """pymoo's class of an algorithm; raises an InputError if pymoo is not installed."""
    try:
        from pymoo.config import Config
    except ImportError:
        raise missing_extra(
            name, "pymoo, the library of search algorithms, is not installed", "pymoo"
        ) from None
    Config.warnings["not_compiled"] = False
    from pymoo.functions import FunctionLoader

    # Its compiled crowding distances end the process (GDE3PCD in 0.6.2), and all machines have the
    # other ones.
    FunctionLoader.get_instance().is_compiled = False
    return getattr(
        importlib.import_module(f"pymoo.algorithms.{PYMOO_ALGORITHMS[name]}"),
        name.removeprefix(PYMOO),
    )


def _plain_arguments(name: str) -> Parameters:
    """Arguments of an algorithm's class and its bases that a file can give, with their default
    values.
    """
    algorithm = _class_of(name)
    arguments = dict[str, inspect.Parameter]()
    # The arguments of DE are those of a class Variant.
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
        if argument not in HIDDEN
        and (
            argument in TYPES or isinstance(parameter.default, bool | int | float | str)
        )
    }
