import numpy as np

from safevar_sumo.metrics import Measure


def largest_jerk(runs, thresholds):
    """The largest change of the acceleration per time [m/s^3]."""
    trace = runs.trace
    acceleration = np.diff(trace.speed, axis=0) / trace.step
    jerk = np.abs(np.diff(acceleration, axis=0)) / trace.step
    return np.max(np.where(trace.active[2:], jerk, 0.0), axis=0)


JERK = Measure(
    name="jerk",
    title="jerk",
    unit="m/s^3",
    more_is_unsafe=True,
    description="Largest change of acceleration.",
    function=largest_jerk,
)
