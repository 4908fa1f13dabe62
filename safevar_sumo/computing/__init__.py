"""Where batches are computed: processes of this machine, or a cluster."""

from safevar_sumo.computing.base import Pool, PoolLostError, WorkerLostError, evaluate_batch, packed
from safevar_sumo.computing.cluster import cluster_pool
from safevar_sumo.computing.identity import identity_of
from safevar_sumo.computing.interrupts import first_of, result_of
from safevar_sumo.computing.isolation import check_isolation, refuse_difference
from safevar_sumo.computing.local import available_cores, local_pool
from safevar_sumo.computing.many import evaluate_all
from safevar_sumo.computing.persistent import PersistentPool, reproducing
from safevar_sumo.computing.sources import inputs_of, sources_of

__all__ = ["PersistentPool", "Pool", "PoolLostError", "WorkerLostError", "available_cores", "check_isolation",
           "cluster_pool", "evaluate_all", "evaluate_batch", "first_of", "identity_of", "inputs_of", "local_pool", "packed",
           "refuse_difference", "reproducing", "result_of", "sources_of"]
