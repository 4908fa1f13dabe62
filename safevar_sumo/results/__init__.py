"""Results of campaigns: journalled, written, and read back."""

from safevar_sumo.results.handle import CHOICES, HALF, Handle, chosen_handle, handles, position_of, unsafe_rows
from safevar_sumo.results.imported import UNKNOWN, write_imported
from safevar_sumo.results.journal import Journal, JournalBusy
from safevar_sumo.results.load import Results, load
from safevar_sumo.results.store import (
    ResultsDirectory,
    evaluations_frame,
    make_directory,
    read_manifest,
    record,
    solutions_frame,
    write_whole,
)

__all__ = ["CHOICES", "HALF", "UNKNOWN", "Handle", "Journal", "JournalBusy", "Results", "ResultsDirectory", "chosen_handle",
           "evaluations_frame", "handles", "load", "make_directory", "position_of", "read_manifest", "record",
           "solutions_frame", "unsafe_rows", "write_imported", "write_whole"]
