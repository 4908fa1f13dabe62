"""User code: its lookup by name, its contracts, and the files that it opens."""

from safevar_sumo.plugins.contract import (
    FINITE as FINITE,
    POSITIVE as POSITIVE,
    SHARE as SHARE,
    TRUTH as TRUTH,
    Contract as Contract,
    Legal as Legal,
    Returned as Returned,
    UserCode as UserCode,
    check_open_runs as check_open_runs,
    open_rows as open_rows,
    quoted as quoted,
    read_only as read_only,
    user_error_of as user_error_of,
    user_errors as user_errors,
)
from safevar_sumo.plugins.files import (
    code_files as code_files,
    digests as digests,
    file_by_name as file_by_name,
    files_in as files_in,
    is_of_shipped_network as is_of_shipped_network,
)
from safevar_sumo.plugins.lookup import (
    Lookup as Lookup,
    Member as Member,
    instance_of as instance_of,
)
from safevar_sumo.plugins.modules import (
    ONE_AT_A_TIME as ONE_AT_A_TIME,
    ImportPath as ImportPath,
    Modules as Modules,
    add_import_folders as add_import_folders,
    only_from as only_from,
    running_modules as running_modules,
)
from safevar_sumo.plugins.process import record_opened as record_opened
