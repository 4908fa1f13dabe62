"""The phase of an encounter: a driving system decides once in a step, so what a vehicle leaves to
the limit depends on when between two decisions the encounter begins. Claims meet the worst phase.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.scenarios import PHASES
from safevar_sumo.study import PHASE, RANGES, Domain, Study, axis_of
from safevar_sumo.study.encounters import Axes
from safevar_sumo.sumo.batch import reason_against_scenes
from safevar_sumo.sumo.system import System

if TYPE_CHECKING:
    from safevar_sumo.questions.models import Model

AT_ONE_PHASE = (
    "Every encounter began at the same moment of a step (the time between two decisions of the"
    " driving system)."
)
"""What to know of encounters without phases."""
COUNTS_STEPS = (
    "In this study, an encounter that begins one step later ends differently, because the driving"
    " system or a sensor counts steps. Only encounters that begin within one step were simulated."
)
"""What to know of a driving system whose cycle is longer than a step."""
SAME = 1e-6
"""Difference up to which what is left at two phases is the same."""
DOMAIN = Domain(unit=PHASES[PHASE].unit, original=0.0, lower=0.0, upper=1.0)
"""All phases: an encounter that begins a whole step later is the same one."""


def in_phases(study: Study, system: System) -> Study:
    """A study that searches the phase, too, as its last parameter; itself where the encounters of
    some point have none, as bodies do not move on tracks.
    """
    has_phases = all(point.scenario.has_phase for point in system.points)
    if (
        not has_phases
        or reason_against_scenes(system)
        or PHASE in system.characteristics.names
    ):
        return study
    base = study if study.ranges else study.listed().all_count
    over: Axes = {**base.scenario.over, PHASE: axis_of(DOMAIN)}
    return replace_in(
        base, encounters=RANGES, scenario=replace_in(base.scenario, over=over)
    )


def remark_on_phases(claim: Model | None) -> str:
    """What to know of claims without phases, or in whose model the original vehicle ends otherwise
    in its own encounter, if that begins a whole step later; else "".
    """
    if claim is None:
        return AT_ONE_PHASE
    rows = np.repeat(claim.characteristics.original_settings, 2, axis=0)
    rows[1, -1] = 1.0
    at_begin, at_end = claim.robustness(rows, "phases of the original")
    return "" if np.isclose(at_begin, at_end, atol=SAME) else COUNTS_STEPS
