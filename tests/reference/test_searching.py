"""Races of searches: who goes on, with how many trials, and that they find the bottom of a bowl."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from safevar_sumo.records import FloatArray
from safevar_sumo.reference.fit import Search


class Bowl:
    """Studies are their places; what they cost is how far they are from a place squared, and whether they are in the wrong half."""

    def __init__(self) -> None:
        self.tried = 0

    def at(self, shares: FloatArray) -> Any:
        return shares

    def costs(self, studies: Sequence[Any]) -> list[float]:
        self.tried += len(studies)
        return [float(((place - 0.2) ** 2).sum() + (place[0] > 0.5)) for place in studies]


class Runner:
    """Has found what it has found, and counts its trials."""

    def __init__(self, lowest: float) -> None:
        self.lowest, self.rounds = lowest, list[int]()

    def go_on(self, trials: int) -> None:
        self.rounds.append(trials)


def silent(cost: float, best: Any) -> None:
    pass


def test_the_worse_half_gives_up_after_every_round() -> None:
    runners = [Runner(lowest) for lowest in (5.0, 1.0, 4.0, 2.0, 3.0)]
    Search(Bowl(), 1, 300, silent).race(runners)  # type: ignore[arg-type]
    # Rounds of 5, 3 and 2 searches with 100 trials each; the winner gets what remains, which these runners never take.
    assert [runner.rounds for runner in runners] == [[20], [20, 33, 50, 300], [20], [20, 33, 50], [20, 33]]


@pytest.mark.parametrize(("starts", "trials"), [(1, 7), (3, 100), (6, 500), (40, 30)])
def test_no_trial_is_lost_and_none_too_many(starts: int, trials: int) -> None:
    bowl, told = Bowl(), list[float]()
    search = Search(bowl, 6, trials, lambda cost, best: told.append(cost))
    searches = [search.begun(np.full(2, 0.9), 0.3, seed) for seed in range(1, starts + 1)]
    search.race(searches)
    assert bowl.tried == trials == len(told)
    assert search.left == 0
    assert told == sorted(told, reverse=True)


def test_a_race_finds_the_bottom_from_whatever_half() -> None:
    search = Search(Bowl(), 8, 1200, silent)
    search.race([search.begun(np.array([place, 0.9]), 0.1, 3) for place in (0.9, 0.8, 0.1, 0.7)])
    assert search.best == pytest.approx([0.2, 0.2], abs=0.01)
