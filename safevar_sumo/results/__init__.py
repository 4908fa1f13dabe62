"""Results of campaigns: journalled, written, and read back."""

from safevar_sumo.results.identity import (
    RESULTS as RESULTS,
    changed_values as changed_values,
    evaluation_keys as evaluation_keys,
    identity_digest as identity_digest,
    manifest_differences as manifest_differences,
    manifest_of as manifest_of,
)
from safevar_sumo.results.journal import (
    Journal as Journal,
    JournalReader as JournalReader,
    journal_head as journal_head,
)
from safevar_sumo.results.load import (
    CHOICES as CHOICES,
    SolutionId as SolutionId,
    choose_handle as choose_handle,
    failure_lines as failure_lines,
    handles_of as handles_of,
    load_runs as load_runs,
    row_of_handle as row_of_handle,
)
from safevar_sumo.results.manifest import (
    FILES as FILES,
    MANIFEST as MANIFEST,
    SOLUTIONS as SOLUTIONS,
    folders_of as folders_of,
    journal_file as journal_file,
    make_directory as make_directory,
    read_manifest as read_manifest,
    run_name as run_name,
    write_whole as write_whole,
)
from safevar_sumo.results.store import (
    NO_RUN as NO_RUN,
    UNKNOWN as UNKNOWN,
    ResultsDirectory as ResultsDirectory,
    RunName as RunName,
    evaluations_frame as evaluations_frame,
    in_order as in_order,
    record as record,
    solutions_frame as solutions_frame,
    write_imported as write_imported,
)
