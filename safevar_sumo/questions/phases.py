"""The phase of an encounter: a driving system decides once in a step, so what a vehicle leaves to
the limit depends on when between two decisions the encounter begins. Claims meet the worst phase.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.scenarios import PHASES
from safevar_sumo.study import PHASE, PHASE_DECIMALS, RANGES, Domain, Study, axis_of
from safevar_sumo.study.encounters import Axes
from safevar_sumo.sumo.batch import reason_against_scenes
from safevar_sumo.sumo.encounters import encounter
from safevar_sumo.sumo.system import System

if TYPE_CHECKING:
    from safevar_sumo.questions.falsify import Judge
    from safevar_sumo.questions.models import Model

NEAR = 3.0
"""Ways of a step up to which a phase can take clearance away: what the vehicle covers in a step."""
PARTS, ROUNDS = 10, 3
"""Into how many parts an interval of phases is divided, and how often: to 0.1 % of a step."""
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


def meet_worst_phases(
    model: Model,
    judge: Judge,
    settings: FloatArray,
    left: FloatArray,
    is_open: BoolArray,
) -> tuple[FloatArray, FloatArray]:
    """M settings of a model, shape (M, n), whose last value is the phase, at their worst phases,
    and what they leave there by the judge, shape (M,).

    `left` is what they leave at phase 0: those that fail there, are not open, or leave more than
    `NEAR` lengths of a step stay.

    Notes
    -----
    What is left rises or falls slowly over the phases, and jumps where a decision moves to another
    step: the worst phase is beside a jump. Of the phases that divide an interval the worst one is
    the end of the next interval, which begins at the one before: it holds the jump.
    """
    settings, left = settings.copy(), left.copy()
    is_open = is_open & (left >= 0)
    steps = _lengths_of_step(model, settings)

    # At first a whole step; its end, phase 1, is phase 0 again.
    low, high = np.zeros(len(left)), np.ones(len(left))
    shares = np.arange(1, PARTS)[:, np.newaxis] / PARTS
    for _ in range(ROUNDS):
        # Within a part of a step, a phase can take away a part of the clearance.
        near = np.flatnonzero(is_open & (left < NEAR * steps * (high - low)))
        if not len(near):
            break

        # All of them at all phases that divide their intervals, in one batch.
        phases = np.round(low[near] + shares * (high - low)[near], PHASE_DECIMALS)
        rows = np.tile(settings[near], (len(phases), 1))
        rows[:, -1] = phases.ravel()
        values = np.vstack([judge(rows).reshape(phases.shape), left[near]])

        # The interval that ends at the worst of them.
        ends = np.vstack([low[near], phases, high[near]])
        worst, each = np.argmin(values, axis=0), np.arange(len(near))
        low[near], high[near] = ends[worst, each], ends[worst + 1, each]
        left[near] = values[worst, each]
    settings[is_open, -1] = high[is_open] % 1
    return settings, left


def _lengths_of_step(model: Model, settings: FloatArray) -> FloatArray:
    """The most that each of M vehicles covers in a step at the start of an encounter that counts
    [m], shape (M,); infinite where the limit is of no distance.
    """
    unsafe = model.unsafe
    if unsafe.bound is not None or unsafe.limit < 0:
        return np.full(len(settings), np.inf)
    system = model.evaluator.system
    values = system.characteristics.scenario.columns(system.split(settings)[1])
    points = (encounter(point, values) for point in system.points)
    speeds = [np.zeros(len(settings)) + point.scenario.start_speed for point in points]
    return np.asarray(system.step * np.maximum.reduce(speeds))


def at_worst_phases(
    claim: Model, judge: Judge, settings: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """M settings, shape (M, n - 1), with their worst phases behind them, and what they leave there
    by the judge; `claim` is the model with phases.
    """
    rows = np.column_stack([settings, np.zeros(len(settings))])
    return meet_worst_phases(
        claim, judge, rows, judge(rows), np.ones(len(rows), dtype=bool)
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
