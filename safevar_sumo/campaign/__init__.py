"""A study carried out: many runs at once, their batches computed elsewhere, their journals kept.

A search is a generator that knows nothing of this. A run answers it from its journal and its memory, hands what is
new to a pool in batches, journals the answers and sends them in: so a resumed run is a replayed one, a lost worker
costs a batch, and no result depends on who computed what.
"""

from safevar_sumo.campaign.carry_out import RUNS_PER_WORKER, Campaign, carry_out
from safevar_sumo.campaign.forecast import Forecast, forecast
from safevar_sumo.campaign.keys import RunKey, algorithm_of, all_runs, run_generator
from safevar_sumo.campaign.run import Observer

__all__ = ["RUNS_PER_WORKER", "Campaign", "Forecast", "Observer", "RunKey", "algorithm_of", "all_runs", "carry_out", "forecast",
           "run_generator"]
