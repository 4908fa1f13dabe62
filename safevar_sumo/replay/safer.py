"""Where a change of the vehicle looks safer, and why."""

from __future__ import annotations

import numpy as np
import pandas as pd

from safevar_sumo.api.simulation import Simulation
from safevar_sumo.questions.braking import brake_onset
from safevar_sumo.study import SAFETY_DEGREE
from safevar_sumo.vehicles import CharacteristicSet


def why_safer(simulation: Simulation) -> list[str]:
    """Why a changed vehicle has a higher safety degree than an original that does not collide, in a
    sentence; none if it has not, or if neither pedals nor frames explain it.
    """
    gain = simulation.metrics[SAFETY_DEGREE] - simulation.original.metrics[SAFETY_DEGREE]
    if not (gain > 0 and simulation.original.metrics[SAFETY_DEGREE] > 0):
        return []

    # Where and how fast each begins to brake, and how hard its driving system brakes.
    runs = simulation.pair.runs
    trace = runs.trace
    rows = range(len(simulation.pair.evaluations))
    onsets = [brake_onset(runs, row) for row in rows]
    if None in onsets:
        return []
    gaps = [float(trace.gap[onset, row]) for onset, row in zip(onsets, rows, strict=True)]
    speeds = [float(trace.speed[onset, row]) for onset, row in zip(onsets, rows, strict=True)]
    brakes = [float(np.max(trace.brake[trace.active[:, row], row])) for row in rows]
    if round(100 * brakes[-1]) > round(100 * brakes[0]):
        return [
            "The driving system brakes the changed vehicle harder: with up to"
            f" {100 * brakes[-1]:.0f} instead of {100 * brakes[0]:.0f} % of the pedal."
        ]
    if round(speeds[-1], 2) < round(speeds[0], 2):
        return [
            f"The changed vehicle arrives more slowly: it begins to brake at {speeds[-1]:.2f}"
            f" instead of {speeds[0]:.2f} m/s."
        ]

    # A frame moves the start of braking by up to the way that the vehicle covers in it.
    way = max(speeds) * trace.step
    if not 0 < gaps[-1] - gaps[0] <= way:
        return []
    return [
        f"It begins to brake {gaps[-1] - gaps[0]:.2f} m earlier, which is less than a frame: the"
        f" driving system decides once in {trace.step:g} s, in which the vehicle travels"
        f" {way:.2f} m. So this gain does not show that the change helps."
    ]


def rises_again(frame: pd.DataFrame, name: str, characteristics: CharacteristicSet) -> bool:
    """Whether the safety degree rises and falls with the distance from the original value, on one
    of its sides.
    """
    original = characteristics.original[characteristics.names.index(name)]
    for side in (frame[frame[name] <= original], frame[frame[name] >= original]):
        steps = np.sign(np.diff(side.sort_values(name)[SAFETY_DEGREE].dropna()))
        if (steps > 0).any() and (steps < 0).any():
            return True
    return False
