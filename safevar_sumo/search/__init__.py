"""Search algorithms by name."""

from collections.abc import Mapping

from safevar_sumo.search.base import Algorithm as Algorithm, Problem as Problem, Search as Search
from safevar_sumo.search.baselines import RandomSearch, SafeFuzzer
from safevar_sumo.search.genetic import Nsga2

ALGORITHMS: Mapping[str, type[Algorithm]] = {"nsga2": Nsga2, "rs": RandomSearch, "safe_fuzzer": SafeFuzzer}
