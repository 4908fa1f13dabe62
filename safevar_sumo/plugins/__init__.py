"""User code: looked up by name, checked against a contract, called through a guard."""

from safevar_sumo.plugins.files import DIGITS, Files, changed_files, digest_of, digests, located, named_files, noted_reading
from safevar_sumo.plugins.guard import Contract, Guard, accepts, guard_process_state, read_only_copy
from safevar_sumo.plugins.lookup import (
    Lookup,
    Member,
    ModuleCopies,
    check_parameters,
    inherit_reachable,
    instance_of,
    make_reachable,
    reachable,
    unload_user_modules,
)

__all__ = [
    "DIGITS", "Contract", "Files", "Guard", "Lookup", "Member", "ModuleCopies", "accepts", "changed_files", "check_parameters",
    "digest_of", "digests", "guard_process_state", "inherit_reachable", "instance_of", "located", "make_reachable", "named_files",
    "noted_reading", "reachable", "read_only_copy", "unload_user_modules"]
