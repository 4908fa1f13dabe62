"""What would do in place of limits that are not kept: the nearest value of each with which all of
them hold.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from safevar_sumo.questions.box import Box
from safevar_sumo.questions.falsify import LEAST_SIMULATIONS
from safevar_sumo.questions.models import Models, judges_of
from safevar_sumo.questions.reach import reach
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.study import Limit

STAGE = "limits that would do"


def nearest_limits(
    models: Models, limits: Mapping[str, Limit]
) -> list[tuple[str, str, float, float | None]]:
    """Rows of name, unit, specified value and the nearest one at which the specified limits hold in
    all models, the others as specified; None where they do not hold even with the original's value.
    """
    members = models.own.evaluator.characteristics
    seed = models.own.evaluator.study.search.seed
    judges = judges_of(models.members, STAGE)
    # The specified limits in all encounters, all other characteristics as in the original.
    ends = [
        np.where(members.of_vehicle, members.original, last)
        for last in (members.lower, members.upper)
    ]
    stated = list[tuple[int, int, float]]()
    for name, limit in limits.items():
        column = members.names.index(name)
        for side, value in enumerate((limit.at_least, limit.at_most)):
            if value is not None:
                ends[side][column] = value
                stated.append((side, column, value))
    box = Box(models.own.evaluator.region, ends[0], ends[1])
    rows = list[tuple[str, str, float, float | None]]()
    for side, column, value in stated:
        item = members.members[column]
        stream = seed, Stream.NEAREST_LIMIT, side, column
        found = reach(box, (side, column), item.original, judges, LEAST_SIMULATIONS, stream)
        rows.append((item.name, item.unit, value, found.value))
    return rows
