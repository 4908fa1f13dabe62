"""Agreement of two sets of numbers, against values worked out by hand, and its picture."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from safevar_sumo.records import Evaluations
from safevar_sumo.reference import ReferenceData, agreement, plot_agreement
from safevar_sumo.reference.validation import rank_correlation
from safevar_sumo.study import Study, load_study
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

ONE = CharacteristicSet((Characteristic(name="c", unit="kg", original=5.0, lower=1.0, upper=9.0),))


def study(published: dict[str, float], repeatability: float | None) -> Study:
    known = {} if repeatability is None else {"safety_degree": repeatability}
    return msgspec.structs.replace(load_study("smoke"), published=published, repeatability=known)


def reference(safety: list[float], tet: list[float]) -> ReferenceData:
    values = np.array(safety)
    tet_values = np.where(values <= 0, np.nan, np.array(tet))
    return ReferenceData(np.linspace(1, 9, len(values))[:, np.newaxis],
                         {"safety_degree": values, "tet": tet_values, "tit": tet_values, "ave_dece": np.full(len(values), np.nan)}, 0)


def here(safety: list[float], tet: list[float]) -> Evaluations:
    values = np.array(safety)
    collided = values <= 0
    tet_values = np.where(collided, np.nan, np.array(tet))
    return Evaluations(settings=np.linspace(1, 9, len(values))[:, np.newaxis], outcome=np.where(collided, "collision", "stopped"),
                       collision_speed=np.where(collided, -values, np.nan), f_diff=values * 0, f_num_diff=values * 0,
                       metrics={"safety_degree": values, "tet": tet_values, "tit": tet_values, "ave_dece": np.ones(len(values))})


def test_every_number_is_what_it_says() -> None:
    told = agreement(reference([1.0, 2.0, 3.0, -1.0], [1.0, 1.2, 1.4, 0]), here([1.5, 2.0, 2.0, 1.0], [1.1, 1.2, 1.2, 9.0]),
                     study({"safety_degree": 2.7}, 0.4), here([2.5], [1.0]))
    assert told.rows == 4
    assert told.mean_absolute_error["safety_degree"] == pytest.approx((0.5 + 0 + 1 + 2) / 4)
    assert told.bias["safety_degree"] == pytest.approx((0.5 + 0 - 1 + 2) / 4)
    assert told.bias["tet"] == pytest.approx((0.1 + 0 - 0.2) / 3), "over rows without collision on either side"
    assert told.spearman["ave_dece"] is None
    assert told.mean_absolute_error["ave_dece"] is None
    assert told.collisions == {"reference": 1, "here": 0, "both": 0}
    assert told.original["safety_degree"] == {"reference": 2.7, "here": 2.5}
    assert (told.precision, told.recall) == (None, 0.0)
    assert told.in_repeats["safety_degree"] == pytest.approx(3.5 / 4 / 0.4)
    assert told.in_repeats["tet"] is None
    assert told.undecided == {"differ": 1, "within_repeats": 0}
    assert told.original["tet"] == {"reference": None, "here": 1.0}


def test_collisions_are_counted_and_those_that_repeats_may_turn_are_told() -> None:
    """Four collide there and four here, three on both sides; of the two others one is 0.05 m from a collision."""
    told = agreement(reference([-1.0, -2.0, -3.0, -1.0, 0.5, 2.0], [1.0] * 6), here([-2.0, -2.0, -2.0, 0.05, -1.5, 2.0], [1.0] * 6),
                     study({}, 0.03), here([2.5], [1.0]))
    assert (told.precision, told.recall) == (0.75, 0.75)
    assert told.collision_speed == {"reference": 2.0, "here": 2.0}
    assert told.undecided == {"differ": 2, "within_repeats": 1}


def test_bias_is_told_by_what_is_predicted() -> None:
    predicted = np.repeat(np.arange(1.0, 9.0), 5)
    told = agreement(reference((predicted - 0.1 * predicted).tolist(), [1.0] * 40), here(predicted.tolist(), [1.0] * 40),
                     study({}, None), here([2.5], [1.0]))
    assert sum(part["rows"] for part in told.by_predicted) == 40
    for part in told.by_predicted:
        assert 0.1 * part["lowest"] - 1e-9 <= part["bias"] <= 0.1 * part["highest"] + 1e-9


def test_rank_correlation_of_known_orders() -> None:
    assert rank_correlation(np.array([1.0, 2, 3]), np.array([10.0, 20, 30])) == pytest.approx(1)
    assert rank_correlation(np.array([1.0, 2, 3]), np.array([3.0, 2, 1])) == pytest.approx(-1)
    assert rank_correlation(np.array([1.0, 2, 3]), np.array([1.0, 1, 1])) is None
    assert rank_correlation(np.array([1.0]), np.array([1.0])) is None
    assert rank_correlation(np.array([]), np.array([])) is None


def test_the_picture_is_drawn_whatever_the_data(tmp_path: Path) -> None:
    for i, rows in enumerate((1, 40)):
        safety = np.linspace(-1, 3, rows).tolist()
        plot_agreement(tmp_path / f"{i}.png", "title", ONE, reference(safety, [1.0] * rows), here(safety, [1.0] * rows))
        assert (tmp_path / f"{i}.png").stat().st_size > 10_000
