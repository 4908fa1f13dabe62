"""The fit itself, in this process, on rows that this package makes."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.reference import ReferenceData, calibrate, fitted_as, with_values
from safevar_sumo.study import FitTable, FreeParameter, Study, load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import assemble
from tests.in_process import Here

GAP = "ads.parameters.brake_gap"


@pytest.fixture(scope="module")
def data() -> ReferenceData:
    system = assemble(load_study("sun"))
    characteristics = system.characteristics
    settings = np.random.default_rng(3).uniform(characteristics.lower, characteristics.upper, (24, 12))
    return ReferenceData(settings, dict(evaluate(system, settings).metrics), 0)


def mine(gap: float, **fit: object) -> Study:
    """The study sun with another brake gap, which is all that may be fitted."""
    truth = load_study("sun").ads.parameters["brake_gap"]
    free = {GAP: FreeParameter(lower=0.3 * truth, upper=1.6 * truth, unit="m", meaning="gap")}
    study = msgspec.structs.replace(load_study("sun"), calibration=free, fit=FitTable(population=6, **fit))  # type: ignore[arg-type]
    return with_values(study, {GAP: gap * truth})


def test_a_fit_from_scratch_finds_the_truth_and_forgets_what_the_study_says(data: ReferenceData) -> None:
    truth = load_study("sun").ads.parameters["brake_gap"]
    found = [calibrate(mine(gap, starts=1, trials=36), {"mine": data}, Here(), from_scratch=True) for gap in (0.4, 1.5)]
    assert found[0].values == found[1].values == {GAP: pytest.approx(truth, rel=0.05)}
    assert found[0].alone
    assert found[0].reached == [found[0].cost]
    assert (found[0].used["mine"].rows, found[0].held_back["mine"].rows) == (12, 12)


def test_a_fit_from_scratch_with_too_few_trials_for_its_starts_knows_nothing_of_the_study_either(data: ReferenceData) -> None:
    found = [calibrate(mine(gap, starts=8, trials=2), {"mine": data}, Here(), from_scratch=True) for gap in (0.4, 1.5)]
    assert found[0].values == found[1].values


def test_what_counts_for_nothing_in_the_study_costs_nothing(data: ReferenceData) -> None:
    """With all weights zero but that of the original vehicle, the rows have no part in the cost."""
    study = mine(1.1, trials=1, rank=0.0, collisions=0.0, weights={"tet": 0.0})
    assert calibrate(study, {"mine": data}, Here()).cost == 0.0
    alone = mine(1.1, trials=1, original=2.0)
    assert calibrate(alone, {}, Here()).cost == pytest.approx(2 * calibrate(mine(1.1, trials=1), {}, Here()).cost)


def test_a_fit_is_refused_that_could_not_mean_anything(data: ReferenceData) -> None:
    with pytest.raises(InputError, match=r"fit\.starts = 0"):
        calibrate(mine(1.0), {"mine": data}, Here(), from_scratch=True)
    with pytest.raises(InputError, match=r"fit\.weights\.speed is no metric"):
        calibrate(mine(1.0, weights={"speed": 1.0}), {"mine": data}, Here())


def test_a_fitted_study_has_a_name_of_its_own() -> None:
    assert fitted_as(load_study("sun"), load_study("sun")).name == "sun-calibrated"
