"""Results of campaigns: journalled, written, and read back."""

from safevar_sumo.results.journal import Journal, JournalBusy
from safevar_sumo.results.load import Results, load
from safevar_sumo.results.store import ResultsDirectory, evaluations_frame, record, solutions_frame

__all__ = ["Journal", "JournalBusy", "Results", "ResultsDirectory", "evaluations_frame", "load", "record", "solutions_frame"]
