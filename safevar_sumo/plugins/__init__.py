"""User code: looked up by name, checked against a contract, called through a guard; `plugins.check` tries it.

`plugins.check` stands above `sumo` and `search`, which it uses; the rest of this room stands below the models, which
use it.
"""

from safevar_sumo.plugins.files import (
    DIGEST_LENGTH,
    Files,
    changed_files,
    digest_of,
    digests,
    file_by_name,
    files_named_in,
    note_inputs,
    unload_user_modules,
)
from safevar_sumo.plugins.guard import Guard, accepts, check_open_runs, open_rows, read_only_copy
from safevar_sumo.plugins.lookup import (
    Lookup,
    Member,
    add_import_folders,
    added_import_folders,
    check_parameters,
    inherit_import_folders,
    instance_of,
)

__all__ = [
    "DIGEST_LENGTH",
    "Files",
    "Guard",
    "Lookup",
    "Member",
    "accepts",
    "add_import_folders",
    "added_import_folders",
    "changed_files",
    "check_open_runs",
    "check_parameters",
    "digest_of",
    "digests",
    "file_by_name",
    "files_named_in",
    "inherit_import_folders",
    "instance_of",
    "note_inputs",
    "open_rows",
    "read_only_copy",
    "unload_user_modules",
]
