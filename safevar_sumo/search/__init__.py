"""Search algorithms by name."""

from collections.abc import Mapping

from safevar_sumo.search.base import Algorithm, GuardedAlgorithm, Problem, Search
from safevar_sumo.search.map_elites import MapElites
from safevar_sumo.search.mocell import MoCell
from safevar_sumo.search.nsga2 import Nsga2
from safevar_sumo.search.random_search import RandomSearch
from safevar_sumo.search.safe_fuzzer import SafeFuzzer
from safevar_sumo.search.spea2 import Spea2

ALGORITHMS: Mapping[str, type[Algorithm]] = {
    "nsga2": Nsga2,
    "spea2": Spea2,
    "mocell": MoCell,
    "map_elites": MapElites,
    "rs": RandomSearch,
    "safe_fuzzer": SafeFuzzer,
}

__all__ = ["ALGORITHMS", "Algorithm", "GuardedAlgorithm", "MapElites", "MoCell", "Problem", "Search"]
