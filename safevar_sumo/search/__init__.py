"""Search algorithms by name; each is made with the population's size."""

from safevar_sumo.search.base import Algorithm, Search
from safevar_sumo.search.nsga2 import Nsga2

ALGORITHMS = {
    "nsga2": Nsga2,
}

__all__ = ["ALGORITHMS", "Algorithm", "Search"]
