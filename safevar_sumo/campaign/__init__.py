"""Carries out a study. The study's runs are divided into shares, and each worker of a pool gets
shares.

A search is a generator that asks for evaluations of settings. The run of the search looks up each
setting in its journal and memory. New settings are evaluated, written to the journal, and sent to
the search. A resumed run reads its journal instead. A worker carries out a share of the runs at the
same time: its batches gather new settings of all these runs. If a worker dies, its share is carried
out once more, and continues from the journals. No result depends on the worker, or on other
settings in the batch. Questions ask the same pool for single batches.

- A task says what is computed with every setting: the study, the engine, and a selection of points.
- A batch is a group of settings that are evaluated together with one task.
- A run is one search of a study, by an algorithm and a number. A share is a group of runs that one
  worker carries out.
- A job is what a pool gives to a worker: a function with its arguments, such as a task and a share,
  or a task and a batch.
"""

from safevar_sumo.campaign.campaign import run_campaign as run_campaign
from safevar_sumo.campaign.runs import (
    RunKey as RunKey,
    all_runs as all_runs,
    check_algorithms as check_algorithms,
)
