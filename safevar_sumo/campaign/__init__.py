"""A study carried out: many runs at once, their batches computed elsewhere, their journals kept.

A search is a generator that knows nothing of this. A run answers it from its journal and its memory, asks for what is
new, journals the answers and sends them in: so a resumed run is a replayed one. What all runs ask for is gathered into
batches for a pool: a lost worker costs a batch, and no result depends on who computed what with whom.
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
