"""Where batches are computed: processes of this machine, or a cluster."""

from safevar_sumo.workers.batches import evaluate_all, inputs_of, sources_of
from safevar_sumo.workers.cluster import cluster_pool
from safevar_sumo.workers.evaluation import Pool, PoolLostError, WorkerLostError, evaluate_batch, packed
from safevar_sumo.workers.identity import identity_of
from safevar_sumo.workers.isolation import check_isolation, refuse_difference
from safevar_sumo.workers.local import available_cores, first_of, local_pool, result_of
from safevar_sumo.workers.retrying import RetryingPool, reproducing

__all__ = [
           "Pool",
           "PoolLostError",
           "RetryingPool",
           "WorkerLostError",
           "available_cores",
           "check_isolation",
           "cluster_pool",
           "evaluate_all",
           "evaluate_batch",
           "first_of",
           "identity_of",
           "inputs_of",
           "local_pool",
           "packed",
           "refuse_difference",
           "reproducing",
           "result_of",
           "sources_of",
]
