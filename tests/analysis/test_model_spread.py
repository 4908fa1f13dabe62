"""The vehicle model's own uncertainty is what its parameter sets make of a setting."""

from __future__ import annotations

import numpy as np
import pytest

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.model_spread import compute_model_spreads, prediction_band, with_values
from safevar_sumo.analysis.tolerance import scans
from safevar_sumo.analysis.tolerance.scans import OneAtATimeScan, scan_with_sets
from safevar_sumo.metrics import Unsafe
from safevar_sumo.study import Study, load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import assemble
from tests.in_process import InlinePool

GAP = "ads.parameters.brake_gap"
OWN = float(load_study("sun").ads.parameters["brake_gap"])


def test_a_band_holds_nine_tenths_of_the_sets_and_of_the_repeats() -> None:
    lower, upper = prediction_band(np.column_stack([np.linspace(0, 1, 101), np.full(101, np.nan)]), 0.1)
    assert (lower[0], upper[0]) == pytest.approx((0.05 - 0.1645, 0.95 + 0.1645))
    assert np.isnan([lower[1], upper[1]]).all()


def test_the_models_error_makes_the_band_wider_with_the_distance_from_the_original_vehicle() -> None:
    """Three quarters of one domain and half of another: sqrt(13/16) domains away, by Pythagoras. The original counts as
    0.3 away.
    """
    sets = {"spread": {GAP: [OWN, OWN]}, "repeatability": {"safety_degree": 1e-9}}
    bare, study = (load_study("sun", **sets, model_error=error) for error in ({}, {"safety_degree": 0.4}))
    ch = assemble(study).characteristics
    settings = np.stack([ch.original, ch.original])
    for name, share in (("tireFric", -0.75), ("dampRateZeroT_CE", -0.5)):
        i = list(ch.names).index(name)
        settings[1, i] += share * (ch.upper[i] - ch.lower[i])
    for here, wide, more in zip(
        compute_model_spreads(bare, settings),
        compute_model_spreads(study, settings),
        (0.4 * 0.3, 0.4 * 0.8125**0.5),
        strict=True,
    ):
        assert here.lower is not None
        assert here.upper is not None
        assert (wide.lower, wide.upper) == pytest.approx((here.lower - more, here.upper + more), abs=1e-9)


def test_the_sets_are_simulated_one_by_one() -> None:
    study = load_study(
        "sun", spread={GAP: [OWN, OWN - 1, OWN + 1]}, repeatability={"safety_degree": 1e-9}, model_error={}
    )
    setting = assemble(study).characteristics.setting({"tireFric": 1.3}, "a test")[np.newaxis]
    alone = [
        evaluate(assemble(load_study("sun", ads={"parameters": {"brake_gap": gap}})), setting)
        for gap in (OWN, OWN - 1, OWN + 1)
    ]
    (band,) = compute_model_spreads(study, setting)
    degrees = [float(one.f_safe[0]) for one in alone]
    assert (band.lower, band.upper) == pytest.approx(np.quantile(degrees, [0.05, 0.95]).tolist(), abs=1e-6)
    assert (band.sets, band.collisions) == (3, sum(int(one.collided[0]) for one in alone))


def test_another_vehicle_or_driver_has_no_spread() -> None:
    other = load_study(load_study("sun", spread={GAP: [OWN, 5.0]}), ads={"model": "full_braking"})
    assert not other.spread
    assert not other.model_error


def test_the_ends_over_fits_are_those_of_each_fitted_study(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scans, "SCAN_VALUES", 21)
    friction = list(load_study("sun").vehicle.characteristics).index("tireFric")
    gap, gaps = "ads.parameters.brake_gap", [6.8978, 6.4, 7.4]
    study = load_study("sun", spread={gap: gaps}, ads={"parameters": {"brake_gap": gaps[0]}})

    def ends(one: Study, fits: int) -> OneAtATimeScan:
        return scan_with_sets(Evaluator(one, InlinePool()), [friction], Unsafe(below=1.5), fits)[0]

    of_each = [ends(with_values(study, {gap: value}), 0).safe for value in gaps]
    low, high = zip(*(interval for interval in of_each if interval), strict=True)
    assert len({*low}) > 1, "the fits differ"
    assert ends(study, 8).across_fits == (len(low), ((min(low), max(low)), (min(high), max(high))))
