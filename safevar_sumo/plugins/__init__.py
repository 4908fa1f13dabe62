"""User code: looked up by name, checked against a contract, called through a guard; `plugins.check` tries it.

`plugins.check` stands above `sumo` and `search`, which it uses; the rest of this room stands below the models, which
use it.
"""

from safevar_sumo.plugins.files import (
    Files as Files,
    changed_files as changed_files,
    code_files as code_files,
    digest_of as digest_of,
    digests as digests,
    file_by_name as file_by_name,
    files_in as files_in,
    is_shipped as is_shipped,
)
from safevar_sumo.plugins.guard import (
    FINITE as FINITE,
    POSITIVE as POSITIVE,
    SHARE as SHARE,
    TRUTH as TRUTH,
    Guard as Guard,
    Legal as Legal,
    abstract_methods as abstract_methods,
    accepts as accepts,
    check_open_runs as check_open_runs,
    open_rows as open_rows,
    read_only_copy as read_only_copy,
)
from safevar_sumo.plugins.lookup import (
    Lookup as Lookup,
    Member as Member,
    add_import_folders as add_import_folders,
    added_import_folders as added_import_folders,
    check_parameters as check_parameters,
    inherit_import_folders as inherit_import_folders,
    instance_of as instance_of,
    unload_user_modules as unload_user_modules,
)
