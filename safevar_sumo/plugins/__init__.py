"""Other people's code: looked up by name, held to a contract, called through one guard."""

from safevar_sumo.plugins.contract import Contract, takes
from safevar_sumo.plugins.digests import DIGITS, Files, changes, digest_of, digests, located, named_files
from safevar_sumo.plugins.guard import Guard, read_only_copy
from safevar_sumo.plugins.lookup import (
    Lookup,
    Member,
    check_parameters,
    forget_foreign,
    inherit_reachable,
    made,
    make_reachable,
    reachable,
)
from safevar_sumo.plugins.own_modules import OwnModules
from safevar_sumo.plugins.process_state import guard_process_state
from safevar_sumo.plugins.reading import noted_reading

__all__ = [
    "DIGITS",
    "Contract",
    "Files",
    "Guard",
    "Lookup",
    "Member",
    "OwnModules",
    "changes",
    "check_parameters",
    "digest_of",
    "digests",
    "forget_foreign",
    "guard_process_state",
    "inherit_reachable",
    "located",
    "made",
    "make_reachable",
    "named_files",
    "noted_reading",
    "reachable",
    "read_only_copy",
    "takes",
]
