"""Results of campaigns: journalled, written, and read back."""

from safevar_sumo.results.imported import UNKNOWN, write_imported
from safevar_sumo.results.journal import Journal, JournalBusy
from safevar_sumo.results.load import Results, load
from safevar_sumo.results.store import ResultsDirectory, evaluations_frame, make_directory, record, solutions_frame, write_whole

__all__ = ["UNKNOWN", "Journal", "JournalBusy", "Results", "ResultsDirectory", "evaluations_frame", "load", "make_directory", "record",
           "solutions_frame", "write_imported", "write_whole"]
