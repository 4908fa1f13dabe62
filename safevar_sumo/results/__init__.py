"""Results of campaigns: journalled, written, and read back."""

from safevar_sumo.results.files import FILES, MANIFEST, ORIGINAL, SOLUTIONS, make_directory, write_whole
from safevar_sumo.results.imported import UNKNOWN, write_imported
from safevar_sumo.results.journal import PATIENCE, SPARE_POSITION, Head, Journal, JournalBusyError
from safevar_sumo.results.load import Failure, RunStatus, Status, StoredResults, failure_lines, load_runs, status
from safevar_sumo.results.manifest import (
    LAYERS_OF_FILES,
    RESULTS,
    evaluation_keys,
    folders_of,
    manifest_of,
    read_manifest,
)
from safevar_sumo.results.solution_id import CHOICES, SolutionId, choose_handle, handles_of, row_of_handle
from safevar_sumo.results.store import ResultsDirectory, evaluations_frame, input_differences, record, solutions_frame

__all__ = [
    "CHOICES",
    "FILES",
    "LAYERS_OF_FILES",
    "MANIFEST",
    "ORIGINAL",
    "PATIENCE",
    "RESULTS",
    "SOLUTIONS",
    "SPARE_POSITION",
    "UNKNOWN",
    "Failure",
    "Head",
    "Journal",
    "JournalBusyError",
    "ResultsDirectory",
    "RunStatus",
    "SolutionId",
    "Status",
    "StoredResults",
    "choose_handle",
    "evaluation_keys",
    "evaluations_frame",
    "failure_lines",
    "folders_of",
    "handles_of",
    "input_differences",
    "load_runs",
    "make_directory",
    "manifest_of",
    "read_manifest",
    "record",
    "row_of_handle",
    "solutions_frame",
    "status",
    "write_imported",
    "write_whole",
]
