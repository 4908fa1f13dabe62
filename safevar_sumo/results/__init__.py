"""Results of campaigns: journalled, written, and read back."""

from safevar_sumo.results.files import (
    FILES,
    MANIFEST,
    ORIGINAL,
    SOLUTIONS,
    folders_of,
    make_directory,
    read_late_files,
    write_whole,
)
from safevar_sumo.results.imported import UNKNOWN, write_imported
from safevar_sumo.results.journal import SPARE_POSITION, Journal, JournalBusyError
from safevar_sumo.results.load import Failure, RunStatus, Status, StoredResults, failure_lines, load_runs, status
from safevar_sumo.results.manifest import RESULTS, differences_now, evaluation_keys, make_inputs_comparable, manifest_of, read_manifest
from safevar_sumo.results.solution_id import CHOICES, SolutionId, choose_handle, handles_of, row_of_handle
from safevar_sumo.results.store import ResultsDirectory, evaluations_frame, record, solutions_frame

__all__ = [
    "CHOICES",
    "FILES",
    "MANIFEST",
    "ORIGINAL",
    "RESULTS",
    "SOLUTIONS",
    "SPARE_POSITION",
    "UNKNOWN",
    "Failure",
    "Journal",
    "JournalBusyError",
    "ResultsDirectory",
    "RunStatus",
    "SolutionId",
    "Status",
    "StoredResults",
    "choose_handle",
    "differences_now",
    "evaluation_keys",
    "evaluations_frame",
    "failure_lines",
    "folders_of",
    "handles_of",
    "load_runs",
    "make_directory",
    "make_inputs_comparable",
    "manifest_of",
    "read_late_files",
    "read_manifest",
    "record",
    "row_of_handle",
    "solutions_frame",
    "status",
    "write_imported",
    "write_whole",
]
