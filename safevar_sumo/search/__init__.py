"""Search algorithms by name."""

from collections.abc import Mapping

from safevar_sumo.search.base import Algorithm as Algorithm, Problem as Problem, Search as Search
from safevar_sumo.search.baselines import RandomSearch, SafeFuzzer
from safevar_sumo.search.genetic import MoCell as MoCell, Nsga2, Spea2
from safevar_sumo.search.map_elites import MapElites as MapElites

ALGORITHMS: Mapping[str, type[Algorithm]] = {
    "nsga2": Nsga2,
    "spea2": Spea2,
    "mocell": MoCell,
    "map_elites": MapElites,
    "rs": RandomSearch,
    "safe_fuzzer": SafeFuzzer,
}
