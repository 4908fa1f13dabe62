"""What happened in one simulation, step by step, and what the ADS saw of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from safevar_sumo.ads import Ads
from safevar_sumo.metrics import time_to_collision
from safevar_sumo.records import STANDSTILL, TIME_DECIMALS, Command, Drives, Nominal, Observation

if TYPE_CHECKING:
    import pandas as pd

SEEN = {"speed": "seen speed [m/s]", "gap": "seen gap [m]", "closing_speed": "seen closing speed [m/s]", "lateral": "seen lateral [m]",
        "lateral_speed": "seen lateral speed [m/s]"}


class Witness:
    """An ADS whose observations of its only vehicle are kept."""

    def __init__(self, ads: Ads) -> None:
        self._ads = ads
        self.observations: list[Observation] = []

    def start(self, n: int, nominal: Nominal, step: float) -> Any:
        self.observations.clear()
        return self._ads.start(n, nominal, step)

    def drive(self, seen: Observation, memory: Any) -> tuple[Command, Any]:
        self.observations.append(Observation(*(np.copy(value) for value in seen)))  # type: ignore[arg-type]
        return self._ads.drive(seen, memory)


def trace_frame(drives: Drives, witness: Witness) -> pd.DataFrame:
    """One row per step of the only vehicle while its simulation counts.

    Where the obstacle was (`gap` along the vehicle's path, `lateral` from the middle of its lane) and what the ADS saw of
    it; `ttc` is empty while nothing is closing, as a standing vehicle is not, a gap while there is no obstacle ahead.
    """
    import pandas as pd  # takes longer to load than the simulation

    trace = drives.trace
    shown = trace.active[:, 0]
    closing = np.where(trace.speed > STANDSTILL, time_to_collision(drives), np.inf)
    columns = {
        "time [s]": trace.time, "position [m]": trace.position[:, 0], "speed [m/s]": trace.speed[:, 0],
        "acceleration [m/s^2]": np.diff(trace.speed[:, 0], prepend=trace.speed[:1, 0]) / trace.step, "gap [m]": trace.gap[:, 0],
        "ttc [s]": closing[:, 0], "throttle [-]": trace.throttle[:, 0], "brake [-]": trace.brake[:, 0],
        "gear [-]": trace.gear[:, 0], "lateral [m]": trace.lateral[:, 0], "lateral speed [m/s]": trace.lateral_speed[:, 0]}
    frame = pd.DataFrame({name: values[shown] for name, values in columns.items()})
    seen = pd.DataFrame([{"time [s]": round(float(one.time), TIME_DECIMALS),
                          **{head: float(getattr(one, name)[0]) for name, head in SEEN.items()}} for one in witness.observations])
    return frame.merge(seen, how="left", on="time [s]").replace([np.inf, -np.inf], np.nan)
