"""How a simulation ends, sample by sample, in a world that is made up."""

from __future__ import annotations

import numpy as np
import pytest

from safevar_sumo.records import Outcome
from safevar_sumo.sumo.batch import _Verdict


def judged(*samples: tuple[float, bool, float | None]) -> tuple[str, list[bool], float]:
    """Outcome, which samples are active, and the collision's speed of one vehicle: (speed, encounter over, speed of a collision)."""
    verdict, active = _Verdict(1), []
    for i, (speed, over, crash) in enumerate(samples):
        collisions = {} if crash is None else {0: crash}
        told = verdict.judge(np.array([speed]), np.array([over]), collisions, last=i == len(samples) - 1)
        active.append(bool(told[0]))
    assert not verdict.open.any()
    return str(verdict.outcome()[0]), active, float(verdict.collision_speed[0])


@pytest.mark.parametrize(("samples", "outcome"), [
    (((0, False, None), (2, False, None), (2, False, None)), Outcome.TIMEOUT),
    (((0, False, None), (0, False, None), (0, False, None)), Outcome.NEVER_MOVED),
    (((0, False, None), (0, False, None), (0, True, None)), Outcome.NEVER_MOVED),
    (((0, False, None), (2, False, None), (0, False, None)), Outcome.STOPPED),
    (((0, False, None), (2, False, None), (2, True, None), (2, False, None)), Outcome.PASSED),
    (((0, False, None), (2, False, None), (2, False, 1.5), (0, False, None)), Outcome.COLLISION),
    (((0, False, None), (0, False, 0.0), (0, False, None)), Outcome.COLLISION)])
def test_an_ending_has_its_outcome(samples: tuple[tuple[float, bool, float | None], ...], outcome: Outcome) -> None:
    assert judged(*samples)[0] == outcome


def test_who_stands_from_the_start_has_not_stopped_yet() -> None:
    assert judged((0, False, None), (0, False, None), (3, False, None), (3, False, None))[0] == Outcome.TIMEOUT


def test_the_sample_of_a_collision_counts_and_none_after_it() -> None:
    _, active, speed = judged((3, False, None), (3, False, 2.5), (1, False, 0.5), (0, False, None))
    assert active == [True, True, False, False]
    assert speed == 2.5, "the first report is the collision's"


def test_no_sample_counts_once_the_encounter_is_over_but_a_collision_in_that_moment() -> None:
    assert judged((3, False, None), (3, True, None), (3, False, None))[1] == [True, False, False]
    assert judged((3, False, None), (3, True, 3.0), (3, False, None))[1:] == ([True, True, False], 3.0)


def test_the_last_sample_counts() -> None:
    assert judged((3, False, None), (3, False, None))[1] == [True, True]
    assert judged((3, False, None), (0, False, None))[0] == Outcome.STOPPED
