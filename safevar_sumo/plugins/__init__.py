"""User code: looked up by name, checked against a contract, called through a guard, interrupted after a time limit."""

from safevar_sumo.plugins.files import DIGEST_LENGTH, Files, changed_files, digest_of, digests, file_by_name, files_named_in, note_inputs
from safevar_sumo.plugins.guard import Contract, Guard, accepts, check_open_runs, guard_process_state, open_rows, read_only_copy
from safevar_sumo.plugins.lookup import (
    Lookup,
    Member,
    ModuleCopies,
    add_import_folders,
    added_import_folders,
    check_parameters,
    inherit_import_folders,
    instance_of,
    unload_user_modules,
)
from safevar_sumo.plugins.timeout import UserCodeTimeout, limit_user_code, load_factor, time_limit

__all__ = [
    "DIGEST_LENGTH", "Contract", "Files", "Guard", "Lookup", "Member", "ModuleCopies", "UserCodeTimeout", "accepts", "add_import_folders",
    "added_import_folders", "changed_files", "check_open_runs", "check_parameters", "digest_of", "digests", "file_by_name",
    "files_named_in", "guard_process_state", "inherit_import_folders", "instance_of", "limit_user_code", "load_factor", "note_inputs",
    "open_rows", "read_only_copy", "time_limit", "unload_user_modules"]
