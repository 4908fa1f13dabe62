"""Search algorithms by name."""

from collections.abc import Mapping

from safevar_sumo.search.base import (
    Algorithm as Algorithm,
    Problem as Problem,
    Search as Search,
)
from safevar_sumo.search.baselines import RandomSearch, SafeFuzzer
from safevar_sumo.search.genetic import Nsga2
from safevar_sumo.search.pymoo import (
    PYMOO_ALGORITHMS as PYMOO_ALGORITHMS,
    pymoo_algorithm as pymoo_algorithm,
)
from safevar_sumo.search.surrogate import Surrogate
from safevar_sumo.study import PYMOO

ALGORITHMS: Mapping[str, type[Algorithm]] = {
    "nsga2": Nsga2,
    "rs": RandomSearch,
    "safe_fuzzer": SafeFuzzer,
    "surrogate": Surrogate,
}
_PYMOO_NAMES = ", ".join(name.removeprefix(PYMOO) for name in PYMOO_ALGORITHMS)
DESCRIPTIONS = {
    **{
        name: (algorithm.__doc__ or "").partition("\n")[0]
        for name, algorithm in ALGORITHMS.items()
    },
    "pymoo:NAME": f"An algorithm of pymoo (extra `pymoo`): {_PYMOO_NAMES}.",
}
"""The names of algorithms that a study may state, with a description for users."""
