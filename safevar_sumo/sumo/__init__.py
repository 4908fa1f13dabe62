"""Simulation of many settings of a study at once, in recorded scenes or in SUMO."""

from safevar_sumo.sumo.batch import reason_against_scenes as reason_against_scenes
from safevar_sumo.sumo.matrix import (
    drive_and_score as drive_and_score,
    drive_worst as drive_worst,
    efficient_batch as efficient_batch,
    simulate_all_points as simulate_all_points,
    vehicle_remarks as vehicle_remarks,
)
from safevar_sumo.sumo.system import assemble as assemble
