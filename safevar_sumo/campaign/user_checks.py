"""Checks of user code on which results rely: `check_code` before the first batch, and repetitions
in other processes.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import msgspec
import numpy as np
import platformdirs

from safevar_sumo.campaign.evaluation import (
    Selection,
    Task,
    carry_out,
    evaluate_settings,
    reproduction_command,
    system_of,
)
from safevar_sumo.campaign.inputs import manifest_now
from safevar_sumo.campaign.pool import Pool, open_pool
from safevar_sumo.errors import UserCodeError
from safevar_sumo.plugins import record_opened
from safevar_sumo.plugins.process import REPRODUCED_BY
from safevar_sumo.records import FloatArray, differences
from safevar_sumo.results import identity_digest
from safevar_sumo.study import Study, user_code_names, without_skipping
from safevar_sumo.sumo.kept import KEPT
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.vehicles import region_of

if TYPE_CHECKING:
    from safevar_sumo.check.trials import Finding


SAME_ELSEWHERE = "the same, to the bit; or repeats = N in [scenario]"
"""The expected behaviour of a simulator in another process, in the words of an error."""


def check_code(study: Study, pool: Pool) -> list[str]:
    """Check the user code of a study in a worker, and return the names of the files that the code
    opened there.

    The check is skipped if the same code has passed before. If simulations are limited, the check
    takes at most a tenth of them.

    Raises
    ------
    UserCodeError
        If user code makes results wrong; the error has the file, the line and advice.
    """
    if not user_code_names(study):
        return []
    digest = identity_digest(manifest_now(study, system_of(study)))
    marker = platformdirs.user_cache_path("safevar_sumo") / "checks" / f"{digest}.json"
    with suppress(OSError, msgspec.MsgspecError):
        return msgspec.json.decode(marker.read_bytes(), type=list[str])
    limit = None if pool.spare is None else pool.spare.check
    job = (Task(study=study), limit)
    opened: list[str]
    ((opened, pool.checked),) = carry_out(_refuse_defects, [job], pool)
    if pool.spare is not None:
        return opened
    # If the marker cannot be written, the next process checks the code again.
    with suppress(OSError):
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.write_bytes(msgspec.json.encode(opened))
    return opened


def repeat_elsewhere(study: Study, pool: Pool) -> None:
    """Simulate three settings in two processes. In the second process the points are in another
    order.

    Raises
    ------
    UserCodeError
        If a result differs.
    """
    system = system_of(study)
    rows = np.concatenate(
        [system.characteristics.original_settings, random_settings(study)]
    )
    backwards = Selection(points=tuple(range(len(system.points)))[::-1])
    jobs = [(Task(study=study), rows), (Task(study=study, selection=backwards), rows)]
    # The second process must be new: what it has simulated before might change its results.
    if pool.workers > 1:
        evaluations, repeated = carry_out(evaluate_settings, jobs, pool)
    else:
        (evaluations,) = carry_out(evaluate_settings, jobs[:1], pool)
        pool.close()
        (repeated,) = carry_out(evaluate_settings, jobs[1:], pool)
    for row, difference in differences(repeated.results, evaluations.results):
        command = reproduction_command(study, rows[row])
        problem = f"{difference} in another process, or with points in another order"
        raise UserCodeError(
            study.source, f"{problem}{REPRODUCED_BY}{command}", SAME_ELSEWHERE
        )


def random_settings(study: Study) -> FloatArray:
    """Two feasible settings of a study, drawn uniformly, shape (2, n)."""
    region = region_of(study)
    characteristics = region.characteristics
    rng = np.random.default_rng(study.search.seed)

    def draw(count: int) -> FloatArray:
        return rng.uniform(
            characteristics.lower, characteristics.upper, (count, len(characteristics))
        )

    return np.resize(region.draw_feasible(draw, 2), (2, len(characteristics)))


def find_in_new_process(study: Study) -> list[Finding]:
    """Find a result of a simulator of the user's own that is wrong, or that differs, in a new
    process, for the original vehicle or both ends of the domains. Nothing is compared if the study
    states `repeats`.
    """
    study = without_skipping(study)
    system = system_of(study)
    if system.mover.is_exact or system.repeats > 1:
        return []
    members = system.characteristics
    settings = system.region.repaired(
        np.stack([members.original, members.lower, members.upper])
    )
    # This import is slow, and rarely needed.
    from safevar_sumo.check.trials import Finding

    # The new process simulates first, because a simulator may end the present process.
    try:
        with open_pool(1) as pool:
            (repeated,) = carry_out(
                evaluate_settings, [(Task(study=study), settings)], pool
            )
    except UserCodeError as error:
        place = error.place or study.source
        expected = error.legal or "no exception"
        return [Finding("contract", error.problem, expected, where=place)]
    evaluations = drive_and_score(replace(system, points=system.points[::-1]), settings)
    for row, difference in differences(evaluations.results, repeated.results):
        words = f"{difference} in a new process"
        command = reproduction_command(study, settings[row])
        return [Finding("repetition", words, SAME_ELSEWHERE, study.source, command)]
    return []


def _refuse_defects(task: Task, limit: int | None = None) -> tuple[list[str], int]:
    """Check user code in this process. Return the names of the files that user code opened, and the
    number of simulations in a simulator.
    """
    # This import is slow, and rarely needed.
    from safevar_sumo.check import refuse_defects

    start = KEPT.simulated
    with record_opened(task.study.origin.places) as opened:
        refuse_defects(task.study, limit)
    return opened, KEPT.simulated - start
