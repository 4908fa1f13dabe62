"""Results of campaigns: journalled, written, and read back."""

from safevar_sumo.results.files import ANSWERS, FILES, MANIFEST, ORIGINAL, SOLUTIONS, later_files, make_directory, places_of, write_whole
from safevar_sumo.results.imported import UNKNOWN, write_imported
from safevar_sumo.results.journal import SPARE, Journal, JournalBusy
from safevar_sumo.results.load import Failure, RunStatus, Status, StoredResults, failure_lines, load_runs, status
from safevar_sumo.results.manifest import RESULTS, comparable_inputs, differences_now, evaluation_keys, manifest_of, read_manifest
from safevar_sumo.results.solution_id import CHOICES, SolutionId, chosen_handle, handles, position_of
from safevar_sumo.results.store import ResultsDirectory, evaluations_frame, record, solutions_frame

__all__ = [
    "ANSWERS",
    "CHOICES",
    "FILES",
    "MANIFEST",
    "ORIGINAL",
    "RESULTS",
    "SOLUTIONS",
    "SPARE",
    "UNKNOWN",
    "Failure",
    "Journal",
    "JournalBusy",
    "ResultsDirectory",
    "RunStatus",
    "SolutionId",
    "Status",
    "StoredResults",
    "chosen_handle",
    "comparable_inputs",
    "differences_now",
    "evaluation_keys",
    "evaluations_frame",
    "failure_lines",
    "handles",
    "later_files",
    "load_runs",
    "make_directory",
    "manifest_of",
    "places_of",
    "position_of",
    "read_manifest",
    "record",
    "solutions_frame",
    "status",
    "write_imported",
    "write_whole",
]
