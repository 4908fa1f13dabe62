"""Computation of batches, in processes of this machine or on a cluster."""
