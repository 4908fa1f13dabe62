"""The same limits in all encounters in the ranges of the study, which hold its tests."""

from __future__ import annotations

from safevar_sumo.errors import InputError, warn
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.counterexamples import Failure, describe
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.falsify import Falsification
from safevar_sumo.questions.models import Models, judges_of, limit_criterion, models_of
from safevar_sumo.questions.reach import falsify_limits
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.scope import scope_of
from safevar_sumo.questions.tables import Column, Columns, Rows
from safevar_sumo.questions.tolerance.asked import Asked
from safevar_sumo.questions.tolerance.together import LimitsTogether
from safevar_sumo.scenarios import SPEED_DIMENSION
from safevar_sumo.scenarios.declared import with_ranges
from safevar_sumo.study import Study

RANGES_STAGE = "counterexamples in the ranges"
NEW_SETTINGS = 384
"""Number of settings with which the attack begins in a parameter set."""
SLOWNESS = 2.5
"""How much longer a simulation takes there, as benchmarks/progress.py showed for `wear`: fewer of
them are simulated at a time.
"""
IN_RANGES: Columns = {
    "scope": "what they cover",
    "kept": "whether the limits above hold there in every parameter set",
    "verdict": "what a search for counterexamples found there",
    "fails_at": Column("", "the vehicle that fails first, and its encounter", is_shown=False),
    "simulate": Column("", "the command that simulates it", is_detail=True),
}


def study_in_ranges(study: Study) -> Study | None:
    """The study in its ranges; None if it states none beside its listed encounters."""
    return None if study.ranges or not study.states_ranges else with_ranges(study)


def usual_settings(evaluator: Evaluator, budget: int, sets: int) -> float:
    """Usual number of settings, each at as many points as the evaluator's, that the attack in the
    ranges simulates in so many parameter sets.
    """
    study = study_in_ranges(evaluator.study)
    if study is None:
        return 0.0
    there = evaluator.for_study(study).system.points
    number = budget + NEW_SETTINGS * sets
    return number * len(there) / len(evaluator.system.points)


def rows_in_ranges(asked: Asked, together: LimitsTogether | None) -> Rows:
    """The row of `IN_RANGES` for a study that states ranges: an attack on the limits together
    there, or without such limits on the specified ones.
    """
    evaluator = asked.evaluator
    budget = asked.budget
    study = study_in_ranges(evaluator.study)
    if study is None or together is None or (together.box is None and not asked.limits):
        return []
    other = evaluator.for_study(study)
    try:
        original = other.evaluate_original()
    except InputError as error:
        warn(f"the limits are not tried in the ranges of the study: {error.problem}")
        return []
    unsafe = limit_criterion(other, study, asked.criterion, asked.margin, original)
    models = models_of(other, unsafe, asked.fits)
    limits = together.specified if together.box is None else together.box
    box = limits.in_encounters_of(other.region)
    judges = judges_of(models.members, RANGES_STAGE)
    with evaluator.phases.stage(RANGES_STAGE, usual_settings(evaluator, budget, len(judges))):
        found = falsify_limits(box, judges, budget, (study.search.seed, Stream.WIDER_SCOPE))
    verdict, failure = _verdict(models, box, found)
    fails_at = None if failure is None else other.characteristics.named(failure.setting)
    command = None if failure is None else failure.command
    return [(scope_of(study), not found.failures, verdict, fails_at, command)]


def _verdict(models: Models, box: Box, found: Falsification) -> tuple[str, Failure | None]:
    """What the falsification found, in words: of several failures that at the lowest speed."""
    if not len(found.robustness):
        return f"none of {found.simulated:,} simulations met an encounter that counts.", None
    model = models.members[int(found.judges[0])]
    if not found.failures:
        keeps = model.unsafe.value_in_words(model.unsafe.value(found.robustness[0]))
        simulated = f"{found.simulated:,} simulations that search for a counterexample"
        return f"the limits hold: the worst of {simulated} {keeps}.", None
    names = model.characteristics.names
    axes = model.characteristics.scenario.names
    column = names.index(SPEED_DIMENSION if SPEED_DIMENSION in axes else axes[0])
    failing = [(judge, row) for judge, rows in found.failures.items() for row in rows]
    judge, setting = min(failing, key=lambda pair: float(pair[1][column]))
    described = [*describe(models.members[judge], {"": setting}, box).values()]
    first = described[0].words if described else "a car within them is unsafe"
    return f"they do not hold: {first}.", described[0] if described else None
