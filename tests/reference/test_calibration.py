"""The fit itself, in this process, on rows that this package makes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from safevar_sumo.analysis.parameters import value_of
from safevar_sumo.errors import InputError
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.reference import FitSubject, ReferenceData, calibrate, calibrate_together, with_values
from safevar_sumo.reference.calibration import _refining_population
from safevar_sumo.reference.effects import Effect, Regression, error_beyond_spread, measure_coverage
from safevar_sumo.reference.fit_space import FitSpace
from safevar_sumo.reference.loss import MAX_DEVIATION, ROW_NOISE, ReferenceLoss, original_loss, original_residuals
from safevar_sumo.reference.parameters import FittedParameter, free_parameters
from safevar_sumo.reference.profiles import Profiles
from safevar_sumo.reference.search import Misfit, SearchRace
from safevar_sumo.study import FitTable, FreeParameter, Study, load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import assemble
from tests.in_process import InlinePool

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


@pytest.mark.slow
def test_a_fit_from_scratch_finds_the_truth_and_forgets_what_the_study_says(data: ReferenceData) -> None:
    truth = load_study("sun").ads.parameters["brake_gap"]
    fits = [calibrate(mine(gap, starts=1, trials=36), {"mine": data}, InlinePool(), from_scratch=True) for gap in (0.4, 1.5)]
    assert fits[0].values == fits[1].values == {GAP: pytest.approx(truth, rel=0.05)}
    assert fits[0].reached == [fits[0].loss]
    assert (fits[0].used["mine"].rows, fits[0].held_back["mine"].rows) == (12, 12)


def test_what_counts_for_nothing_in_the_study_costs_nothing(data: ReferenceData) -> None:
    """With all weights zero but that of the original vehicle, the rows have no part in the loss."""
    study = mine(1.1, trials=1, rank=0.0, collisions=0.0, weights={"tet": 0.0})
    assert calibrate(study, {"mine": data}, InlinePool()).loss == 0.0
    alone = mine(1.1, trials=1, original=2.0)
    assert calibrate(alone, {}, InlinePool()).loss == pytest.approx(2 * calibrate(mine(1.1, trials=1), {}, InlinePool()).loss)


def test_a_fit_is_refused_that_could_not_mean_anything(data: ReferenceData) -> None:
    with pytest.raises(InputError, match=r"fit\.starts = 0"):
        calibrate(mine(1.0), {"mine": data}, InlinePool(), from_scratch=True)
    with pytest.raises(InputError, match=r"fit\.weights\.speed is no metric"):
        calibrate(mine(1.0, weights={"speed": 1.0}), {"mine": data}, InlinePool())


HESITATION = "ads.parameters.hesitation"


@pytest.mark.slow
def test_studies_that_are_fitted_together_share_what_is_not_their_own(data: ReferenceData) -> None:
    """Both find the gap that the rows of both were made with, and the one that hesitates how late it does."""
    truth = load_study("sun").ads.parameters["brake_gap"]
    own = FreeParameter(lower=0.0, upper=0.3, unit="s", meaning="pause", own=True)
    sun, late = mine(0.95, trials=49), with_hesitation(mine(0.95), 0.15)
    late = msgspec.structs.replace(late, name="late", calibration={HESITATION: own})
    settings = data.settings
    there = dict(evaluate(assemble(with_hesitation(load_study("sun"), 0.2)), settings).metrics)
    subjects = [FitSubject(sun, {"mine": data}), FitSubject(late, {"theirs": ReferenceData(settings, there, 0)})]
    dry, wet = calibrate_together(subjects, InlinePool())
    assert dry.values[GAP] == wet.values[GAP] == pytest.approx(truth, rel=0.05)
    assert wet.values[HESITATION] == pytest.approx(0.2, abs=0.04)
    assert set(dry.values) == {GAP}
    assert (dry.shared, wet.shared) == ({GAP}, {GAP})
    assert dry.loss == wet.loss


@pytest.mark.slow
def test_from_scratch_an_ensemble_finds_the_region_and_a_search_the_truth(data: ReferenceData) -> None:
    """Two studies share a gap; one hesitates. Their own values play no part."""
    truth = load_study("sun").ads.parameters["brake_gap"]
    own = FreeParameter(lower=0.0, upper=0.3, unit="s", meaning="pause", own=True)
    there = dict(evaluate(assemble(with_hesitation(load_study("sun"), 0.2)), data.settings).metrics)
    fits, steps = [], list[float]()
    for gap in (0.4, 1.5):
        sun = mine(gap, trials=100, starts=1, ensemble=10)
        late = msgspec.structs.replace(with_hesitation(mine(gap), 0.1), name="late", calibration={HESITATION: own})
        subjects = [FitSubject(sun, {"mine": data}), FitSubject(late, {"theirs": ReferenceData(data.settings, there, 0)})]
        fits.append(calibrate_together(subjects, InlinePool(), lambda loss, best: steps.append(loss), from_scratch=True))
    dry, wet = fits[0]
    assert len(steps) == 200
    assert steps[50] < steps[9] / 2, "the ensemble moves"
    assert dry.values[GAP] == wet.values[GAP] == pytest.approx(truth, rel=0.05)
    assert wet.values[HESITATION] == pytest.approx(0.2, abs=0.04)
    assert [fit.values for fit in fits[0]] == [fit.values for fit in fits[1]]


def test_a_search_by_logarithm_has_the_geometric_mean_in_the_middle_and_stays_in_its_bounds() -> None:
    bounds = FreeParameter(lower=0.3, upper=30.0, unit="m", meaning="gap", log=True)
    linear = msgspec.structs.replace(bounds, log=False)
    trial = FitSpace([FittedParameter(GAP, (0,), bounds), FittedParameter(HESITATION, (0,), linear)], [])
    assert trial.values(np.array([[0.5, 0.5], [0.75, 0.0]])) == pytest.approx(np.array([[3.0, 15.15], [3 * 10**0.5, 0.3]]))
    assert trial.values(np.ones(2)).max() <= 30.0
    assert trial.values(np.full(2, 1 / 7)).tolist() == [0.579209, 4.54286], "six digits, as in the study file"
    study = msgspec.structs.replace(mine(1.0), calibration={GAP: msgspec.structs.replace(bounds, lower=0.0)})
    with pytest.raises(InputError, match="log = true and lower = 0"):
        free_parameters([study])


def with_hesitation(study: Study, hesitation: float) -> Study:
    ads = msgspec.structs.replace(study.ads, parameters={**study.ads.parameters, "hesitation": hesitation})
    return msgspec.structs.replace(study, ads=ads)


def test_what_another_study_gives_another_value_is_not_shared() -> None:
    near, far = mine(0.8), mine(1.2)
    assert [free.study_indices for free in free_parameters([near, near])] == [(0, 1)]
    assert [free.study_indices for free in free_parameters([near, far])] == [(0,), (1,)]
    assert [free.study_indices for free in free_parameters([near, load_study("lgsvl")]) if free.key == GAP] == [(0,)]


def test_errors_count_in_repeats_and_effects_in_the_safety_degrees(data: ReferenceData) -> None:
    """All of the loss is sum(w error / repeatability): a repeatability of 2 halves what one of 1 makes of it."""
    only = FitTable(original=0.0, rank=0.0, collisions=0.0, weights={"safety_degree": 1.0})
    def loss(unit: float, **fit: float) -> float:
        study = msgspec.structs.replace(mine(0.8), repeatability={"safety_degree": unit}, fit=msgspec.structs.replace(only, **fit))
        here = evaluate(assemble(study), data.settings)
        return ReferenceLoss(data, study).of(here)

    error = np.abs(evaluate(assemble(mine(0.8)), data.settings).f_safe - data.metrics["safety_degree"]).mean()
    assert loss(1.0) == pytest.approx(error)
    assert loss(2.0) == pytest.approx(error / 2)


def test_each_collision_on_one_side_alone_costs_its_share_of_the_rows(data: ReferenceData) -> None:
    """Four there and four here, three of them the same: two rows of six differ."""
    first, safety = np.arange(24) < 6, np.array([-2.0, -2.0, -2.0, 0.5, -1.5, 2.0])
    there = data.take(first)._replace(metrics={"safety_degree": np.array([-1.0, -2.0, -3.0, -1.0, 0.5, 2.0])})
    here = Evaluations(settings=there.settings, outcome=np.where(safety < 0, Outcome.COLLISION.value, Outcome.STOPPED.value),
                       collision_speed=np.where(safety < 0, -safety, np.nan), metrics={"safety_degree": safety}, f_diff=0 * safety,
                       f_num_diff=0 * safety)
    study = msgspec.structs.replace(mine(0.8), fit=FitTable(rank=0.0, collisions=6.0, weights={}))
    assert ReferenceLoss(there, study).of(here) == pytest.approx(6 * 2 / 6)


@pytest.mark.parametrize(("reference", "nearest", "too_far"), [
    (1.0, 1.19, 1.21), (-1.0, -0.81, -0.79), (0.2, 0.29, 0.31), (0.0, -0.09, 0.11)])
def test_effects_agree_within_a_fifth_or_a_tenth_of_a_metre(reference: float, nearest: float, too_far: float) -> None:
    assert [Effect("mass", reference, here).agrees for here in (nearest, too_far, None)] == [True, False, None]


def test_a_linear_response_has_the_effects_that_it_was_made_with() -> None:
    characteristics = assemble(load_study("sun")).characteristics
    width, rng = characteristics.upper - characteristics.lower, np.random.default_rng(1)
    settings = rng.uniform(characteristics.lower, characteristics.upper, (200, 12))
    settings[:, 3] = characteristics.original[3]
    slopes = np.arange(12) - 5.0
    effects = Regression.over(settings, characteristics).effects(1.0 + ((settings - characteristics.original) / width) @ slopes)
    assert np.delete(effects, 3) == pytest.approx(np.delete(slopes, 3))
    assert np.isnan(effects[3]), "it does not vary"
    assert np.isnan(Regression.over(settings[:20], characteristics).effects(np.ones(20))).all(), "too few rows"


PUBLISHED = {"safety_degree": 2.0, "tet": 1.0}
FIT = FitTable(tolerance=0.05, original=0.5, weights={"safety_degree": 1.0, "tet": 0.3})


def loss(safety_degree: float, tet: float) -> float:
    one = np.ones(1)
    original = Evaluations(settings=np.ones((1, 2)), outcome=np.array([Outcome.STOPPED.value]), collision_speed=one * np.nan,
                           metrics={"safety_degree": one * safety_degree, "tet": one * tet}, f_diff=0 * one, f_num_diff=0 * one)
    return original_loss(original, PUBLISHED, FIT)


def test_a_miss_costs_nothing_within_the_tolerance_and_in_proportion_beyond() -> None:
    assert loss(2.0, 1.0) == loss(2.09, 0.96) == 0.0
    assert loss(2.3, 1.0) == pytest.approx(0.5 * 2 * (3 - 1) / 2), "three tolerances; the mean of two metrics counts half"
    assert loss(2.0, 0.85) == pytest.approx(0.5 * 0.3 * 2 * (3 - 1) / 2), "on the other side, with that metric's weight"
    assert loss(20.0, 1.0) == loss(np.nan, 1.0) == pytest.approx(0.5 * 2 * (10 - 1) / 2), "farther than ten is as far as that"


def test_residuals_count_in_deviations_of_the_noise_with_the_weight_of_their_metric(data: ReferenceData) -> None:
    """The sum of squares is that of rows whose noise is a share of the reference's scatter, and of tolerances for the original vehicle."""
    study = mine(0.8, weights={"safety_degree": 1.0, "tit": 0.25})
    here = evaluate(assemble(study), data.settings)
    there = data._replace(metrics={**data.metrics, "tit": np.where(np.arange(24) < 3, np.nan, data.metrics["tit"])})
    expected = [(here.f_safe - there.metrics["safety_degree"]) / (ROW_NOISE * there.metrics["safety_degree"].std()),
                0.5 * np.nan_to_num(here.metrics["tit"] - there.metrics["tit"]) / (ROW_NOISE * np.nanstd(there.metrics["tit"]))]
    loss = ReferenceLoss(there, study)
    assert loss.residuals(here) == pytest.approx(np.concatenate(expected))
    lost = here.outcome.copy()
    lost[5] = Outcome.SIMULATOR_ERROR.value
    residuals = loss.residuals(replace(here, outcome=lost))
    assert residuals[[5, 29]] == pytest.approx([MAX_DEVIATION, 0.5 * MAX_DEVIATION])
    one = np.ones(1)
    original = Evaluations(settings=np.ones((1, 2)), outcome=np.array([Outcome.STOPPED.value]), collision_speed=one * np.nan,
                           metrics={"safety_degree": one * 2.3, "tet": one * np.nan}, f_diff=0 * one, f_num_diff=0 * one)
    assert original_residuals(original, PUBLISHED, FIT) == pytest.approx([3.0, 0.3**0.5 * MAX_DEVIATION])
    assert original_residuals(original, PUBLISHED, msgspec.structs.replace(FIT, original=0.0)).size == 0


class Bowl:
    """Studies are their places; their loss is the squared distance from a place, and more in the wrong half."""

    def __init__(self) -> None:
        self.tried = 0

    def studies_at(self, shares: FloatArray) -> Any:
        return shares

    def misfits(self, studies: Sequence[Any]) -> list[Misfit]:
        self.tried += len(studies)
        return [Misfit(float(((place - 0.2) ** 2).sum() + (place[0] > 0.5)), place - 0.2) for place in studies]


class Runner:
    """Has found what it has found, and counts its trials."""

    def __init__(self, lowest: float) -> None:
        self.lowest_loss, self.population, self.rounds = lowest, 1, list[int]()

    def advance(self, trials: int) -> None:
        self.rounds.append(trials)


def silent(loss: float, best: Any) -> None:
    pass


def test_the_worse_half_gives_up_after_every_round() -> None:
    runners = [Runner(lowest) for lowest in (5.0, 1.0, 4.0, 2.0, 3.0)]
    SearchRace(Bowl(), 1, 300, silent).run(runners)  # type: ignore[arg-type]
    # Rounds of 5, 3, 2 and 1 searches with 75 trials each; the winner gets what remains, which these runners never take.
    assert [runner.rounds for runner in runners] == [[15], [15, 25, 37, 75, 300], [15], [15, 25, 37], [15, 25]]


def test_a_search_around_known_values_has_smaller_generations() -> None:
    class Counted(Bowl):
        def misfits(self, studies: Sequence[Any]) -> list[Misfit]:
            generations.append(len(studies))
            return super().misfits(studies)

    generations = list[int]()
    search = SearchRace(Counted(), 12, 100, silent)
    search.run([search.begin(np.full(3, 0.5), 0.1, 1, _refining_population(12, 3))])
    # 4 + 3 ln 3 = 7.3, the usual population, is more than a third of 12.
    assert generations == [7] * 14 + [2]
    assert (_refining_population(80, 26), _refining_population(6, 2)) == (26, 6)


def test_the_models_error_covers_nine_tenths_of_rows_each_file_counted_alike(data: ReferenceData) -> None:
    """Rows of one file lie in the middle of the band, those of the other beyond it: 1 to 24 distances from the original, at least 0.3."""
    sets = {GAP: [value_of(mine(1.0), GAP)] * 2}
    study = msgspec.structs.replace(mine(1.0), spread=sets, repeatability={"safety_degree": 1e-9})
    ch = assemble(study).characteristics
    away = np.maximum(np.sqrt((((data.settings - ch.original) / (ch.upper - ch.lower)) ** 2).sum(axis=1)), 0.3)
    far = data._replace(metrics={"safety_degree": data.metrics["safety_degree"] + away * np.arange(1, 25)})
    # Of 24 rows alone the 23rd: ceil(0.9 * 25). Beside 24 rows without a miss, 0.9 * 49 / 48 of the weight: the 21st (20.1 of 24 misses).
    assert error_beyond_spread(study, {"far": far}) == pytest.approx(23, abs=1e-6)
    assert error_beyond_spread(study, {"near": data, "far": far}) == pytest.approx(21, abs=1e-6)
    # A file of 8 rows without a miss counts as much as one of 24: again the 21st (20.6 of 24); row by row it would be the 22nd.
    assert error_beyond_spread(study, {"near": data.take(np.arange(24) < 8), "far": far}) == pytest.approx(21, abs=1e-6)
    assert measure_coverage(far, msgspec.structs.replace(study, model_error={"safety_degree": 21.000001})).all_rows == 21 / 24


def test_a_file_too_short_to_hold_rows_back_says_so(data: ReferenceData) -> None:
    study = msgspec.structs.replace(mine(1.0), spread={GAP: [value_of(mine(1.0), GAP)] * 2}, repeatability={"safety_degree": 1e-3})
    short = data.take(np.arange(len(data.settings)) < study.fit.hold_out - 1)
    coverage = measure_coverage(short, study)
    assert coverage.held_back is None
    assert "none of them held back" in str(coverage)
    assert "the rows held back" not in str(coverage)
    assert "of the rows held back" in str(measure_coverage(data, study))


@pytest.mark.parametrize(("starts", "trials", "ensemble"), [(1, 1, 5), (3, 2, 5), (2, 9, 2), (2, 33, 4), (1, 25, 50)])
def test_a_fit_from_scratch_has_as_many_trials_as_it_may(data: ReferenceData, starts: int, trials: int, ensemble: int) -> None:
    losses = list[float]()
    study = mine(0.9, trials=trials, starts=starts, ensemble=ensemble)
    calibrate(study, {"mine": data.take(np.arange(24) < 6)}, InlinePool(), lambda loss, best: losses.append(loss), from_scratch=True)
    assert len(losses) == trials


@pytest.mark.parametrize(("starts", "trials"), [(1, 7), (3, 100), (6, 500), (40, 30)])
def test_no_trial_is_lost_and_none_too_many(starts: int, trials: int) -> None:
    bowl, losses = Bowl(), list[float]()
    search = SearchRace(bowl, 6, trials, lambda loss, best: losses.append(loss))
    searches = [search.begin(np.full(2, 0.9), 0.3, seed) for seed in range(1, starts + 1)]
    search.run(searches)
    assert bowl.tried == trials == len(losses)
    assert search.trials_left == 0
    assert losses == sorted(losses, reverse=True)


def test_a_race_finds_the_bottom_from_whatever_half() -> None:
    search = SearchRace(Bowl(), 8, 1200, silent)
    search.run([search.begin(np.array([place, 0.9]), 0.1, 3) for place in (0.9, 0.8, 0.1, 0.7)])
    assert search.best == pytest.approx([0.2, 0.2], abs=0.01)


class Basin(Bowl):
    """A bowl whose bottom is at one, on [0, 1] x [0, 10]: within 4 % of it is what is 0.2 from the bottom."""

    def misfits(self, studies: Sequence[Any]) -> list[Misfit]:
        return [misfit._replace(loss=1 + misfit.loss) for misfit in super().misfits(studies)]

    def values(self, shares: FloatArray) -> FloatArray:
        return np.asarray(shares * np.array([1.0, 10.0]))


def test_what_fits_as_well_is_an_interval_and_sets_that_are_far_apart() -> None:
    basin = Basin()
    search = SearchRace(basin, 8, 800, silent, alike=0.04)
    search.run([search.begin(np.array([place, 0.6]), 0.3, 3) for place in (0.3, 0.5)])
    assert search.best is not None
    bounds = FreeParameter(lower=0, upper=1, unit="-", meaning="place")
    profiles = Profiles.of([FittedParameter("a", (0,), bounds), FittedParameter("b", (1,), bounds)], basin, search, np.asarray(search.best))
    for (low, high), whole in ((profiles.interval(0), 0.4), (profiles.interval(1), 4.0)):
        assert 0 <= low < 0.3 * whole, "no more than what is as good, and most of it"
        assert 0.7 * whole < high <= whole
    assert list(profiles.spread(1)) == ["b"]
    sets = profiles.spread(0)["a"]
    assert len(sets) == 20
    assert sets[0] == pytest.approx(0.2, abs=0.001)
    assert (min(sets), max(sets)) == pytest.approx(profiles.interval(0), abs=0.1)
