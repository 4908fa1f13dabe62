"""Carries out a study: many runs at once on a pool of workers, each run with its journal.

A search is a generator that requests evaluations of settings. The run of the search looks each setting up in its journal and memory,
has new settings evaluated, journals the evaluations and sends them to the search; a resumed run replays its journal. Batches gather new
settings of all runs for the pool: a lost worker costs a batch, and no result depends on the worker or on other settings in the batch.
"""

from safevar_sumo.campaign.campaign import Campaign, run_campaign
from safevar_sumo.campaign.forecast import Forecast, forecast
from safevar_sumo.campaign.keys import RunKey, algorithm_class, algorithm_of, all_runs, files_read_by_algorithms, random_generator_of
from safevar_sumo.campaign.run import Observer

__all__ = [
    "Campaign",
    "Forecast",
    "Observer",
    "RunKey",
    "algorithm_class",
    "algorithm_of",
    "all_runs",
    "files_read_by_algorithms",
    "forecast",
    "random_generator_of",
    "run_campaign",
]
