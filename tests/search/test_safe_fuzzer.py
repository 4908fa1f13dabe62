"""SafeFuzzer: its schedule, its ranges, its score."""

from __future__ import annotations

import numpy as np
import pytest

from safevar_sumo.records import Evaluations
from safevar_sumo.vehicles import Characteristic, CharacteristicSet
from tests.search.problems import SUN, evaluated, searched, sphere


def test_a_generation_is_fifty_and_changes_between_one_and_all() -> None:
    _, asked = searched("safe_fuzzer", 1, 500)
    assert [len(settings) for settings in asked] == [50] * 10
    changed = np.concatenate([SUN.number_changed(settings) for settings in asked])
    assert set(changed) == set(range(1, 13)), "k is uniform in 1..n before the first update"
    assert np.bincount(changed.astype(int))[1:].min() > 500 / 12 / 2


def test_values_are_uniform_outside_the_filters_band() -> None:
    _, asked = searched("safe_fuzzer", 2, 500)
    mass = np.concatenate(asked)[:, SUN.names.index("mass")]
    drawn = mass[mass != 2404]
    assert np.all(np.abs(drawn - 2404) >= 13.2)
    below = (2404 - 13.2 - 2040) / (2700 - 2040 - 26.4)
    assert np.mean(drawn < 2404) == pytest.approx(below, abs=0.1)


def test_it_ends_after_five_generations_without_improvement() -> None:
    single = CharacteristicSet((Characteristic(name="c", unit="-", original=5.0, lower=4.0, upper=6.0),))

    def constant(characteristics: CharacteristicSet, settings: np.ndarray) -> Evaluations:
        return evaluated(characteristics, np.full_like(settings, 6.0), np.ones(len(settings)))

    _, asked = searched("safe_fuzzer", 4, 5000, single, constant)
    assert sum(len(settings) for settings in asked) == 500 + 5 * 50


def test_an_improvement_begins_the_count_of_generations_without_one_anew() -> None:
    single = CharacteristicSet((Characteristic(name="c", unit="-", original=5.0, lower=4.0, upper=6.0),))
    generations = iter(range(1, 100))

    def better_in_the_thirteenth(characteristics: CharacteristicSet, settings: np.ndarray) -> Evaluations:
        safety = 0.5 if next(generations) == 13 else 1.0
        return evaluated(characteristics, np.full_like(settings, 6.0), np.full(len(settings), safety))

    _, asked = searched("safe_fuzzer", 4, 5000, single, better_in_the_thirteenth)
    assert len(asked) == 13 + 5


def test_a_range_inside_the_filters_band_does_not_hang_it() -> None:
    """The mean of the unsafe values lies so near the original that nothing outside the band is left."""
    narrow = CharacteristicSet((Characteristic(name="c", unit="-", original=5.0, lower=4.95, upper=7.0),))
    found, asked = searched("safe_fuzzer", 5, 1500, narrow)
    assert len(found) == 50
    assert sum(len(settings) for settings in asked) <= 1500


def test_the_result_is_the_fifty_best_scores() -> None:
    found, asked = searched("safe_fuzzer", 6, 1000)
    everything = sphere(SUN, np.concatenate(asked))
    safety = everything.f_safe
    scores = (6 * (safety - safety.min()) / np.ptp(safety) + everything.f_diff + (everything.f_num_diff - 1) / 11) / 8
    assert np.array_equal(found.settings, everything.settings[np.argsort(scores, kind="stable")[:50]])
