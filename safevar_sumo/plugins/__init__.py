"""Code from outside the package: looked up by name, held to a contract, called through one guard."""

from safevar_sumo.plugins.files import DIGITS, Files, changed_files, digest_of, digests, located, named_files, noted_reading
from safevar_sumo.plugins.guard import Contract, Guard, accepts, guard_process_state, read_only_copy
from safevar_sumo.plugins.lookup import (
    Lookup,
    Member,
    OwnModules,
    check_parameters,
    forget_foreign,
    inherit_reachable,
    instance_of,
    make_reachable,
    reachable,
)

__all__ = [
    "DIGITS", "Contract", "Files", "Guard", "Lookup", "Member", "OwnModules", "accepts", "changed_files", "check_parameters", "digest_of",
    "digests", "forget_foreign", "guard_process_state", "inherit_reachable", "instance_of", "located", "make_reachable", "named_files",
    "noted_reading", "reachable", "read_only_copy"]
