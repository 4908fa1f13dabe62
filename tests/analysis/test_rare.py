"""Rare failures against analytic probabilities of limit states in standard normal space."""

from __future__ import annotations

import json
import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
import scipy

from safevar_sumo import risk
from safevar_sumo.analysis.risk import compute
from safevar_sumo.analysis.risk.answer import Risk
from safevar_sumo.errors import InputError
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study.variation import Uniform
from tests.analysis.known_regions import Plant, box, made_up_study

Limit = Callable[[FloatArray], FloatArray]


def of_normal(settings: FloatArray) -> FloatArray:
    """Standard normal variables of characteristics that are uniform from 0 to 10."""
    return np.asarray(scipy.stats.norm.ppf(np.clip(settings / 10, 1e-16, 1 - 1e-16)))


def linear(beta: float) -> Limit:
    return lambda u: beta - u.sum(axis=1) / math.sqrt(u.shape[1])


def curved(radius: float) -> Limit:
    """Failures are outside a sphere: a sum of n squares has a chi squared distribution."""
    return lambda u: radius - np.linalg.norm(u, axis=1)


def islands(beta: float) -> Limit:
    return lambda u: beta - np.abs(u[:, 0])


def rare(limit: Limit, n: int, seed: int = 1, **options: object) -> Risk:
    study = made_up_study(n)
    study = msgspec.structs.replace(
        study, search=msgspec.structs.replace(study.search, seed=seed), variation={"a": Uniform()}
    )
    plant = Plant(study, lambda settings: limit(of_normal(settings)) < 0, lambda settings: limit(of_normal(settings)))
    chosen = {"unsafe": "collision", "pool": plant, "progress": passes_no_end, "rare": True, **options}
    return risk(study, **chosen)  # type: ignore[arg-type]


def passes_no_end(stage: str, done: int, total: int) -> None:
    assert done <= total, stage


def beta_of(probability: float) -> float:
    return float(-scipy.stats.norm.ppf(probability))


def radius_of(probability: float, n: int) -> float:
    return float(math.sqrt(scipy.stats.chi2.isf(probability, n)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "shape", "n", "probability"),
    [
        ("subset_simulation", "linear", 3, 1e-4),
        ("subset_simulation", "linear", 8, 1e-6),
        ("subset_simulation", "curved", 2, 1e-4),
        ("subset_simulation", "curved", 4, 1e-6),
        ("cross_entropy", "linear", 8, 1e-6),
    ],
)
def test_analytic_probabilities_over_twenty_seeds(method: str, shape: str, n: int, probability: float) -> None:
    limit = linear(beta_of(probability)) if shape == "linear" else curved(radius_of(probability, n))
    estimates = [rare(limit, n, seed, method=method) for seed in range(20)]
    assert {one.method for one in estimates} == {method}
    assert np.mean([one.probability for one in estimates]) == pytest.approx(probability, rel=0.1)
    assert sum(one.interval[0] <= probability <= one.interval[1] for one in estimates) >= 18


@pytest.mark.slow
def test_a_rare_failure_its_interval_and_its_most_probable_point() -> None:
    """The design point of a plane at the distance beta has components beta / sqrt(n)."""
    estimate = rare(linear(beta_of(1e-5)), 3)
    assert estimate.method == "subset_simulation"
    assert estimate.interval[0] <= 1e-5 <= estimate.interval[1]
    assert estimate.remark == ""
    assert estimate.design_point is not None
    point = of_normal(np.array([list(estimate.design_point.values())]))[0]
    assert np.linalg.norm(point) == pytest.approx(beta_of(1e-5), rel=0.05)
    assert point == pytest.approx(beta_of(1e-5) / math.sqrt(3), rel=0.25)
    record = estimate.to_dict()
    assert json.loads(json.dumps(record, allow_nan=False)) == record
    assert set(record) >= {"method", "simulations", "coefficient_of_variation", "design_point", "remark"}
    assert estimate.of_fleet(1000) == pytest.approx(1 - (1 - estimate.probability) ** 1000)
    assert rare(linear(beta_of(1e-5)), 3).to_dict() == record


def test_two_islands_are_told() -> None:
    estimate = rare(islands(beta_of(5e-5)), 2)
    assert estimate.interval[0] <= 1e-4 <= estimate.interval[1]
    assert "2 islands" in estimate.remark


def test_where_no_failure_is_within_reach_a_number_comes_out_all_the_same() -> None:
    """OpenTURNS raises an error for a probability below the smallest that it estimates, and for samples without any
    failure.
    """
    beyond = rare(linear(9.0), 2, method="subset_simulation")
    assert (beyond.method, beyond.probability) == ("subset_simulation", 0)
    assert "no failure was found" in beyond.remark
    lost = rare(lambda u: np.where(u[:, 0] > 9.0, -1.0, 5.0 + 0.001 * u[:, 1]), 2, method="cross_entropy")
    assert (lost.method, lost.failures) == ("monte_carlo", 0)
    assert "lost all failures" in lost.remark


def test_a_plateau_and_a_frequent_failure_are_left_to_monte_carlo() -> None:
    plateau = rare(lambda u: np.where(u[:, 0] > beta_of(1e-3), -1.0, 2.0), 2)
    assert plateau.method == "monte_carlo"
    assert "plateau" in plateau.remark
    frequent = rare(linear(beta_of(0.05)), 2)
    assert frequent.method == "monte_carlo"
    assert frequent.samples == 10_000
    assert "plain Monte Carlo" in frequent.remark


def test_a_pilot_that_cannot_be_simulated_is_not_called_unsafe() -> None:
    study, calls = made_up_study(2), 0

    def first_call(settings: FloatArray) -> BoolArray:
        nonlocal calls
        calls += 1
        return np.full(len(settings), calls * len(settings) <= 1000)

    study = msgspec.structs.replace(study, search=msgspec.structs.replace(study.search, seed=1))
    plant = Plant(study, box, failing=first_call)
    estimate = risk(study, unsafe="collision", pool=plant, rare=True, samples=2000)
    assert (estimate.method, estimate.samples, estimate.errors) == ("monte_carlo", 1000, 1000)
    assert estimate.remark == "none of the first 1000 vehicles could be simulated: plain Monte Carlo is used"


def test_the_limit_of_rare_failures_has_one_owner(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compute, "RARE_BELOW", 0.02)
    monkeypatch.setattr(compute, "find_spec", lambda name: None)
    assert rare(linear(beta_of(1e-3)), 2, rare=False).remark.startswith(
        "fewer than 2 % of the first vehicles are unsafe; "
    )


def test_a_share_of_the_domain_is_counted_whatever_is_installed() -> None:
    """Without [variation] it is no probability, and the shares of `risk`, `rules` and a report are counted on the same
    vehicles.
    """
    study = made_up_study(2)
    assert (
        risk(study, unsafe="collision", pool=Plant(study, lambda rows: rows[:, 0] > 9.99), samples=3000).method
        == "monte_carlo"
    )


@pytest.mark.slow
def test_auto_chooses_and_monte_carlo_stays_where_it_is_asked_for() -> None:
    assert rare(linear(beta_of(1e-4)), 2, rare=False).method == "subset_simulation"
    assert rare(linear(beta_of(1e-4)), 2, rare=False, method="monte_carlo").method == "monte_carlo"
    many = rare(linear(beta_of(5e-3)), 2, rare=False, samples=100_000)
    assert (many.method, many.samples) == ("monte_carlo", 100_000), "so many show 500 failures by themselves"
    with pytest.raises(InputError, match="method"):
        rare(linear(3.0), 2, method="subset")
