"""Where batches are computed: processes of this machine, or a cluster."""
