"""Evaluates many settings in one call: `sv.evaluate`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from safevar_sumo.api.simulation import load_and_assemble
from safevar_sumo.errors import InputError, about, check_name
from safevar_sumo.questions.arguments import checked
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import NO_RUN, evaluations_frame
from safevar_sumo.study import Study, StudyLike, plain_values
from safevar_sumo.terminal import Progress, open_progress, show_no_progress
from safevar_sumo.vehicles import CharacteristicSet

if TYPE_CHECKING:
    import pandas as pd

    from safevar_sumo.campaign.pool import Pool


SETTINGS_FORMAT = (
    "a list of mappings such as [{'mass': 2500}], a pandas.DataFrame with a column for each"
    " characteristic that is changed, or an array of numbers, shape (M, n)"
)
SETTINGS = "settings"
"""The argument with the settings, for errors. The phase of progress has the same name."""


@checked
def evaluate(
    study: StudyLike,
    settings: pd.DataFrame | Sequence[Mapping[str, float | None]] | npt.ArrayLike,
    *,
    filtered: bool = False,
    beyond: bool = False,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: bool | Progress = False,
) -> pd.DataFrame:
    """Simulate many settings of a study in worker processes.

    Parameters
    ----------
    study
        A study, or anything that `load_study` accepts.
    settings
        M settings, with values in the characteristics' table units, in one of these forms:

        - a list with a mapping for each setting, or a frame with a row for each setting, of the
          characteristics that are changed; a missing value (no key, None or NaN) means the
          original's value;
        - an array of shape (M, n) without missing values, with the n characteristics in the study's
          order.
    filtered
        Put changes that do not exceed their thresholds back to the original first, as every search
        does.
    beyond
        Also accept values outside the domains, and settings that violate the study's constraints.
    pool
        Pool that simulates, in place of new worker processes.
    jobs
        Worker processes, by default one for each core.
    progress
        True for a bar on the terminal, or a function called with the phase, the number of settings
        done, and of all.

    Returns
    -------
    pandas.DataFrame
        One row per setting, in the order of `settings` and with the index of a frame: the
        characteristics as simulated, f_safe [m or -m/s], f_diff [fraction] and f_num_diff (both of
        the filtered setting, as in the paper), the metrics in their units (NaN where undefined),
        collision_speed [m/s], outcome: simulator-error if a setting cannot be simulated,
        invalid-test if it leaves a test's speed before the driving system acts. These have no
        metrics, and are neither failures nor successes. If encounters are ranges,
        feasible says whether the original is safe in the same encounter.

    Raises
    ------
    InputError
        If the study, a column or a value cannot be used.
    SafevarError
        If nothing can be simulated.
    """
    loaded_study, system = load_and_assemble(study)
    characteristics = system.characteristics

    simulated, index = _read_settings(settings, characteristics, beyond)
    if filtered:
        simulated = characteristics.filter(simulated)
    if not beyond:
        with about(SETTINGS):
            system.region.check(simulated, otherwise=", or any with beyond=True")
    with open_progress(progress) as report_progress:
        evaluations = evaluate_with_workers(
            loaded_study, simulated, pool, jobs, report_progress
        )

    # The frame has columns for an algorithm and its run, which these evaluations do not have.
    frame = evaluations_frame(characteristics.names, [(NO_RUN, evaluations)])
    frame = frame.drop(columns=["algorithm", "run"])
    frame.insert(len(frame.columns) - 1, "collision_speed", evaluations.collision_speed)
    scoring = system.measuring.scoring
    if scoring.safe_original is not None:
        frame["feasible"] = scoring.feasible_rows(frame)
    return frame.set_axis(index)


def evaluate_with_workers(
    study: Study,
    settings: FloatArray,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: Progress = show_no_progress,
) -> Evaluations:
    """Simulate settings, shape (M, n), in worker processes. Settings that violate the study's
    constraints are simulated, too.
    """
    from safevar_sumo.questions.evaluator import open_evaluator

    with open_evaluator(study, pool, jobs, progress) as evaluator:
        # The only phase is the whole progress, whatever its number of settings.
        evaluator.begin({SETTINGS: 1})
        return evaluator.evaluate(settings, SETTINGS, ignore_constraints=True)


def _read_settings(
    settings: Any, characteristics: CharacteristicSet, beyond: bool
) -> tuple[FloatArray, pd.Index]:
    """Convert a user's settings into an array of shape (M, n), and the index of its rows. Refuse
    illegal values.
    """
    import pandas as pd

    if isinstance(settings, Sequence):
        settings = plain_values(settings)
        if all(isinstance(setting, Mapping) for setting in settings):
            settings = pd.DataFrame(list(settings), index=range(len(settings)))
    try:
        if isinstance(settings, pd.DataFrame):
            array = _array_of_table(settings, characteristics)
            index = settings.index
        else:
            array = _array_of_rows(settings, characteristics)
            index = pd.RangeIndex(len(array))
    except (TypeError, ValueError) as error:
        kind = type(settings).__name__
        raise InputError(SETTINGS, f"a {kind}: {error}", SETTINGS_FORMAT) from None

    are_legal = [
        characteristic.is_legal(values, beyond=beyond)
        for characteristic, values in zip(characteristics, array.T, strict=True)
    ]
    illegal_places = np.argwhere(~np.column_stack(are_legal))
    if len(illegal_places):
        row, column = illegal_places[0]
        with about(f"settings, row {row}"):
            value = float(array[row, column])
            characteristics.members[column].check(value, beyond=beyond)
    return array, index


def _array_of_table(
    table: pd.DataFrame, characteristics: CharacteristicSet
) -> FloatArray:
    """The settings of a table as an array of shape (M, n). A missing value, or a missing column,
    means the original's value.
    """
    names = list(characteristics.names)
    for name in table.columns:
        check_name("settings", f"column {name!r} is no characteristic", name, names)
        _check_numbers(name, table[name])
    values = table.reindex(columns=names).to_numpy(float, na_value=np.nan)
    return np.where(np.isnan(values), characteristics.original, values)


def _array_of_rows(settings: Any, characteristics: CharacteristicSet) -> FloatArray:
    """Settings with a value for each characteristic as an array of shape (M, n)."""
    names = characteristics.names
    _check_no_flags(settings)
    array = np.array(settings, float)
    if array.ndim != 2 or array.shape[1] != len(names):
        problem = repr(settings)
        if array.ndim:
            problem = f"an array of shape {array.shape}"
        expected = f"{SETTINGS_FORMAT}; here n = {len(names)}: {', '.join(names)}"
        raise InputError("settings", problem, expected)
    return array


def _check_no_flags(settings: Any) -> None:
    """Refuse an array with True or False, which numpy would read as the numbers 1 and 0."""
    rows = plain_values(settings)
    if not isinstance(rows, Sequence):
        return
    for number, row in enumerate(rows):
        if isinstance(row, Sequence) and any(isinstance(value, bool) for value in row):
            raise InputError(f"settings, row {number}", repr(row), "numbers")


def _check_numbers(name: str, column: pd.Series) -> None:
    """Refuse a column with a value that is neither a number nor missing, such as a list or a
    text.
    """
    # A column of floats, of integers or of unsigned integers has nothing else.
    if column.dtype.kind in "fiu":
        return
    for row, value in enumerate(column):
        if not isinstance(value, Real | None) or isinstance(value, bool):
            raise InputError(
                f"settings, row {row}", f"{name} = {value!r}", "a number, or None"
            )
