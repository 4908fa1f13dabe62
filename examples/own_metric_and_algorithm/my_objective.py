import numpy as np

from safevar_sumo.metrics import Measure


def mean_change(settings, characteristics):
    """The mean relative change over all characteristics."""
    share = np.abs(settings - characteristics.original) / characteristics.original
    return np.add.accumulate(share, axis=1)[:, -1] / len(characteristics)


MEAN = Measure(
    name="mean_change", title="mean change", unit="fraction", of="settings", function=mean_change
)
