"""Which drives count: a question gives the bench its rule. A failure that does not count says
nothing about what the question asks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.drives import Drives, Encounters
from safevar_sumo.questions.worlds import DrivenWorld
from safevar_sumo.records import BoolArray


class Rule(NamedTuple):
    """The rule of a question. The bench asks it only about drives that satisfy the constraints, and
    that are unsafe or cannot be simulated: all safe drives count.

    Attributes
    ----------
    counts
        Says which of M drives count, shape (M,). If it simulates for this, progress is shown for
        the stage that it is given.
    further
        The largest number of drives that it simulates to decide about one drive.
    """

    counts: Callable[[Drives, str], BoolArray]
    further: int = 0


def _count_all(drives: Drives, stage: str) -> BoolArray:
    return np.ones(len(drives), dtype=bool)


EVERY_DRIVE = Rule(_count_all)
"""The rule by which every drive counts."""


def where_original_is_safe(worlds: Sequence[DrivenWorld], unsafe: Unsafe) -> Rule:
    """The rule by which a drive counts if the original vehicle is safe in its encounter by the
    criterion `unsafe`: otherwise a failure says nothing about changes of the vehicle. Listed
    encounters count anyway. The original vehicle drives in each encounter only once.
    """
    known = dict[bytes, bool]()

    def is_safe_in(encounters: Encounters, stage: str) -> BoolArray:
        """Whether the original vehicle is safe in each of E encounters, shape (E,)."""
        is_safe = np.ones(len(encounters), dtype=bool)
        for number, rows in encounters.by_world():
            world = worlds[number]
            if world.test is not None:
                model = world.model
                original = model.characteristics.vehicle.original_settings
                drives = Drives.product(original, encounters[rows])
                runs = model.evaluator.evaluate(world.settings(drives), stage)
                is_safe[rows] = runs.valid & ~unsafe.of(runs)
        return is_safe

    def counts(drives: Drives, stage: str) -> BoolArray:
        keys = drives.encounters.identities()
        rows = {key: row for row, key in enumerate(keys) if key not in known}
        unknown = drives.encounters[np.array(list(rows.values()), dtype=np.intp)]
        known.update(zip(rows, is_safe_in(unknown, stage).tolist(), strict=True))
        return np.array([known[key] for key in keys], dtype=bool)

    has_moving_tests = any(world.test is not None for world in worlds)
    return Rule(counts, further=int(has_moving_tests))
