"""Carries out a study: its runs, dealt out in shares to the workers of a pool (`pool.py` defines the words).

A search is a generator that requests evaluations of settings. The run of the search looks each setting up in its
journal and memory, has new settings evaluated, journals the evaluations and sends them to the search; a resumed run
replays its journal. A worker carries a share of the runs: its batches gather new settings of all of them. A worker that
dies is replaced, and the next one continues from the journals; no result depends on the worker or on other settings in
the batch. Questions ask the same pool for single batches.
"""

from safevar_sumo.campaign.campaign import (
    Campaign as Campaign,
    Forecast as Forecast,
    Observer as Observer,
    forecast as forecast,
    run_campaign as run_campaign,
)
from safevar_sumo.campaign.run import (
    RunKey as RunKey,
    RunProgress as RunProgress,
    algorithm_of as algorithm_of,
    all_runs as all_runs,
    random_generator_of as random_generator_of,
)
