"""Carries out a study: its runs, dealt out in shares to the workers of a pool.

A search is a generator that asks for evaluations of settings. The run of the search looks each
setting up in its journal and memory, has new settings evaluated, journals the evaluations and sends
them to the search; a resumed run replays its journal. A worker carries a share of the runs: its
batches gather new settings of all of them. The share of a worker that dies is carried out once more
and continues from the journals; no result depends on the worker or on other settings in the batch.
Questions ask the same pool for single batches.

- A task is what is computed with every setting of a study: the study, the engine, a selection of
  points.
- A batch is settings that are evaluated together with one task.
- A run is one search of a study, by an algorithm and a number; a share is the runs that one worker
  carries out.
- A job is what a pool gives to a worker: a function with its arguments, such as a task and a share
  or a batch.
"""

from safevar_sumo.campaign.campaign import (
    Campaign as Campaign,
    run_campaign as run_campaign,
)
from safevar_sumo.campaign.runs import (
    RunKey as RunKey,
    all_runs as all_runs,
    check_algorithms as check_algorithms,
)
