"""Results of campaigns: journalled, written, and read back."""

from safevar_sumo.results.files import make_directory, write_whole
from safevar_sumo.results.frames import SPARE
from safevar_sumo.results.imported import UNKNOWN, write_imported
from safevar_sumo.results.inputs import begun_and_now, places_of, read_later
from safevar_sumo.results.journal import Journal, JournalBusy
from safevar_sumo.results.load import Failure, Results, failure_lines, load
from safevar_sumo.results.manifest import RESULTS, differences_now, fixed, manifest_of, read_manifest
from safevar_sumo.results.solution_id import CHOICES, HALF, SolutionId, chosen_handle, handles, position_of, unsafe_rows
from safevar_sumo.results.status import RunStatus, Status, status
from safevar_sumo.results.store import ORIGINAL, ResultsDirectory, evaluations_frame, record, solutions_frame

__all__ = [
    "CHOICES",
    "HALF",
    "ORIGINAL",
    "RESULTS",
    "SPARE",
    "UNKNOWN",
    "Failure",
    "Journal",
    "JournalBusy",
    "Results",
    "ResultsDirectory",
    "RunStatus",
    "SolutionId",
    "Status",
    "begun_and_now",
    "chosen_handle",
    "differences_now",
    "evaluations_frame",
    "failure_lines",
    "fixed",
    "handles",
    "load",
    "make_directory",
    "manifest_of",
    "places_of",
    "position_of",
    "read_later",
    "read_manifest",
    "record",
    "solutions_frame",
    "status",
    "unsafe_rows",
    "write_imported",
    "write_whole",
]
