"""Many settings of a study evaluated: what designs of experiments are built on."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from rich.console import Console

from safevar_sumo.api.simulation import assembled
from safevar_sumo.errors import InputError, unknown
from safevar_sumo.metrics import METRICS
from safevar_sumo.progress import counted
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import evaluations_frame
from safevar_sumo.study import Study, StudyLike
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.batches import evaluate_all
from safevar_sumo.workers.local import available_cores, local_pool

LEGAL = "a pandas.DataFrame with a column of numbers for each characteristic that is changed, or an array of numbers, shape (M, n)"

if TYPE_CHECKING:
    import pandas as pd


def evaluate(study: StudyLike, settings: pd.DataFrame | npt.ArrayLike, *, filtered: bool = True, beyond: bool = False,
             jobs: int | None = None, progress: bool = False) -> pd.DataFrame:
    """Simulate many settings of a study in worker processes.

    Parameters
    ----------
    study
        A study, or what `load_study` makes one of.
    settings
        A frame with a column for each characteristic that is changed, the others are the original's; or an array of shape
        (M, n), n characteristics in the study's order. In the characteristics' table units.
    filtered
        Put changes that are smaller than their thresholds back to the original, as every search does.
    beyond
        Take values outside the domains too.
    jobs
        Worker processes, by default the cores of this machine.
    progress
        Show a bar.

    Returns
    -------
    pandas.DataFrame
        One row per setting, in their order and with a frame's index: the characteristics as simulated, f_safe [m or -m/s],
        f_diff [fraction], f_num_diff, the metrics in their units (NaN where undefined), collision_speed [m/s], outcome.
        A setting that cannot be simulated has the outcome simulator-error, one that leaves a test's speed before the system acts
        invalid-test: neither is a failure or a success, and neither has metrics.

    Raises
    ------
    InputError
        If the study, a column or a value cannot be used.
    SafevarError
        If nothing can be simulated.
    """
    chosen, system = assembled(study)
    characteristics = system.characteristics
    asked, index = _table(settings, characteristics)
    _check(asked, characteristics, beyond)
    rows = characteristics.filter(asked) if filtered else asked
    return _described(characteristics, evaluated(chosen, rows, jobs, progress)).set_axis(index)


def evaluated(study: Study, rows: FloatArray, jobs: int | None = None, progress: bool = False) -> Evaluations:
    """Simulate settings, shape (M, n), in worker processes."""
    if not len(rows):
        return Evaluations.none(rows.shape[1], METRICS)
    showing: Any = counted(Console(stderr=True), "settings", len(np.unique(rows, axis=0))) if progress else nullcontext(_silent)
    with local_pool(jobs or available_cores(), study.search.time_limit) as pool, showing as done:
        return evaluate_all(study, rows, pool, done)


def _table(settings: pd.DataFrame | npt.ArrayLike, characteristics: CharacteristicSet) -> tuple[FloatArray, Any]:
    """Settings as an array of shape (M, n), and the index of their rows."""
    import pandas as pd

    names = list(characteristics.names)
    if isinstance(settings, Mapping):
        raise InputError("settings", f"is a {type(settings).__name__}", LEGAL)
    if isinstance(settings, pd.DataFrame):
        for name in settings.columns:
            if name not in names:
                raise unknown("settings", f"column {name!r} is no characteristic", name, names)
        if settings.columns.has_duplicates:
            raise InputError("settings", "a column is there twice", "each characteristic once")
        table = pd.DataFrame(dict(zip(names, characteristics.original, strict=True)), index=settings.index)
        return _numbers(table.assign(**{str(name): settings[name] for name in settings.columns})), settings.index
    array = _numbers(settings)
    if array.ndim != 2 or array.shape[1] != len(names):
        raise InputError("settings", f"an array of shape {array.shape}", f"shape (M, {len(names)}): {', '.join(names)}")
    return array, pd.RangeIndex(len(array))


def _numbers(settings: Any) -> FloatArray:
    try:
        return np.array(settings, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError("settings", str(error), LEGAL) from None


def _check(asked: FloatArray, characteristics: CharacteristicSet, beyond: bool) -> None:
    legal = np.column_stack([one.is_legal(values, beyond=beyond) for one, values in zip(characteristics, asked.T, strict=True)])
    for row, column in np.argwhere(~legal)[:1]:
        characteristics.members[column].check(float(asked[row, column]), f"settings, row {row}", beyond=beyond)


def _described(characteristics: CharacteristicSet, found: Evaluations) -> pd.DataFrame:
    frame = evaluations_frame(characteristics.names, [(("", 0), found)]).drop(columns=["algorithm", "run"])
    frame.insert(len(frame.columns) - 1, "collision_speed", found.collision_speed)
    return frame


def _silent(number: int) -> None:
    """Tells nobody."""
