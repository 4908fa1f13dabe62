"""The same limits in the scope of a wider study about the same car, which the study names by its key `wider`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.questions.attack import Rows, attack
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import Models, limit_criterion, models_of
from safevar_sumo.questions.scope import scope_of
from safevar_sumo.questions.tables import Column, Columns
from safevar_sumo.questions.tolerance.rows import describe
from safevar_sumo.questions.tolerance.together import LimitsTogether
from safevar_sumo.questions.words import encounter_in_words
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Limit, Study, load_study

WIDER_STAGE = "attack in the wider scope"
WIDER: Columns = {
    "study": "the wider study",
    "scope": Column("", "what it covers", is_shown=False),
    "kept": "whether the limits above hold there with every fit",
    "verdict": "what an attack found there",
}


def wider_study(study: Study) -> Study:
    """The study that a study names as its wider one: a file beside its own, or a shipped study.

    Raises
    ------
    InputError
        If there is none, or it varies other characteristics.
    """
    paths = [path for folder in study.origin.places if (path := Path(folder, study.wider)).is_file()]
    try:
        wider = load_study(str(paths[0]) if paths else study.wider)
    except InputError as error:
        raise InputError(study.source, f"wider = {study.wider!r}: {error.problem}", error.legal) from None
    own = study.vehicle.characteristics
    others = wider.vehicle.characteristics
    if {name: row.unit for name, row in own.items()} != {name: row.unit for name, row in others.items()}:
        problem = f"wider = {study.wider!r} varies {', '.join(others)}"
        raise InputError(study.source, problem, f"a study of the same characteristics: {', '.join(own)}")
    return wider


def wider_rows(
    evaluator: Evaluator,
    limits: Mapping[str, Limit],
    together: LimitsTogether | None,
    unsafe: str | None,
    margin: float | None,
    fits: int | None,
    budget: int,
) -> list[tuple[Any, ...]]:
    """The row of `WIDER` for a study that names a wider one: an attack on the limits together in the wider scope, or
    without such limits on the specified ones.
    """
    if not evaluator.study.wider or together is None or not budget:
        return []
    study = wider_study(evaluator.study)
    other = evaluator.for_study(study)
    models = models_of(other, limit_criterion(other, study, unsafe, margin, other.evaluate_original()), fits)
    if together.box is None and not limits:
        return []
    box = _box_in(models, evaluator, together.promise if together.box is None else together.box)
    judges = [partial(model.left, stage=WIDER_STAGE) for model in models.members]
    with evaluator.stage(WIDER_STAGE, budget):
        found = attack(box, judges, [], budget, np.random.default_rng((study.search.seed, 9)))
    is_kept = not (found.left < 0).any()
    return [
        (
            study.name,
            scope_of(study),
            is_kept,
            _verdict(models, found.settings, found.judges, found.left, found.simulated),
        )
    ]


def _box_in(models: Models, evaluator: Evaluator, box: Box) -> Box:
    """A box of the vehicle's characteristics in all encounters of the wider study."""
    members = models.own.evaluator.characteristics
    own = evaluator.characteristics
    lower = members.lower.copy()
    upper = members.upper.copy()
    for item in members.vehicle:
        column = members.names.index(item.name)
        column_here = own.names.index(item.name)
        lower[column] = box.lower[column_here]
        upper[column] = box.upper[column_here]
    return Box(models.own.evaluator.region, lower, upper)


def _verdict(models: Models, settings: FloatArray, judges: Rows, left: FloatArray, simulated: int) -> str:
    """What the attack found, in words."""
    if not len(left):
        return f"none of {simulated:,} simulations met an encounter that counts."
    model = models.members[int(judges[0])]
    members = model.evaluator.characteristics
    values = dict(zip(members.names, settings[0].tolist(), strict=True))
    where = encounter_in_words(members, values)
    if left[0] >= 0:
        keeps = model.unsafe.value_in_words(model.unsafe.value(left[0]))
        return f"they hold: the worst of {simulated:,} aimed at them {keeps}{where}."
    words = describe(model, {"": settings[0]})[""].words
    new_car = ", where the new car is safe" if where else ""  # other encounters of a searched scenario do not count
    return f"they do not hold: {words}{where}{new_car}."
