"""Carries out a study: many runs at once, with a journal for each, on a pool of workers.

A search is a generator that knows nothing of this. Its run answers requests from its journal and memory, has new settings
evaluated, journals their evaluations and sends them in: a resumed run is a replayed one. New settings of all runs are gathered
into batches for a pool: a lost worker costs a batch, and no result depends on the worker or the other settings in a batch.
"""

from safevar_sumo.campaign.campaign import Campaign, run_campaign
from safevar_sumo.campaign.forecast import Forecast, forecast
from safevar_sumo.campaign.keys import RunKey, algorithm_member, algorithm_of, all_runs, read_by_algorithms, run_generator
from safevar_sumo.campaign.run import Observer

__all__ = [
           "Campaign",
           "Forecast",
           "Observer",
           "RunKey",
           "algorithm_member",
           "algorithm_of",
           "all_runs",
           "forecast",
           "read_by_algorithms",
           "run_campaign",
           "run_generator",
]
