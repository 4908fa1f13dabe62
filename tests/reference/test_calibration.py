"""The fit itself, in this process: its loss, its searches, and the ensemble that begins a fit from scratch; and the
uncertainty that its parameter sets make of a setting.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
import pytest
from scipy.special import logit

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.model_spread import compute_model_spreads, prediction_band, value_of, with_values
from safevar_sumo.analysis.tolerance import scans
from safevar_sumo.analysis.tolerance.scans import OneAtATimeScan, scan_with_sets
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import FloatArray
from safevar_sumo.reference.calibration import FitSubject, Profiles, calibrate
from safevar_sumo.reference.effects import error_beyond_spread, linear_effects
from safevar_sumo.reference.fit_space import FitSpace, FittedParameter, reference_misfit
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.reference.search import CmaSearch, Misfit, SearchRace, invert
from safevar_sumo.study import FitTable, FreeParameter, Study, load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import assemble
from tests.in_process import InlinePool
from tests.made_up import made_up_evaluations

GAP, HESITATION = "ads.parameters.brake_gap", "ads.parameters.hesitation"
TRUTH = load_study("sun").ads.parameters["brake_gap"]


@pytest.fixture(scope="module")
def data() -> ReferenceData:
    system = assemble(load_study("sun"))
    characteristics = system.characteristics
    settings = np.random.default_rng(3).uniform(characteristics.lower, characteristics.upper, (24, 12))
    return ReferenceData(settings, dict(evaluate(system, settings).metrics), 0)


def mine(gap: float, **fit: object) -> Study:
    """The study sun with another brake gap, which is all that may be fitted."""
    free = {GAP: FreeParameter(lower=0.3 * TRUTH, upper=1.6 * TRUTH, unit="m", meaning="gap")}
    # type: ignore[arg-type]
    study = msgspec.structs.replace(load_study("sun"), calibration=free, fit=FitTable(population=6, **fit))
    return with_values(study, {GAP: gap * TRUTH})


def late(study: Study, hesitation: float) -> Study:
    """The same study, whose ADS hesitates by a time of its own."""
    own = FreeParameter(lower=0.0, upper=0.3, unit="s", meaning="pause", own=True)
    ads = msgspec.structs.replace(study.ads, parameters={**study.ads.parameters, "hesitation": hesitation})
    return msgspec.structs.replace(study, name="late", ads=ads, calibration={HESITATION: own})


@pytest.mark.slow
def test_studies_that_are_fitted_together_share_what_is_not_their_own(data: ReferenceData) -> None:
    """Both find the gap that the rows of both were made with, and the one that hesitates how late it does; from scratch
    an ensemble finds the region and a search the truth, and the studies' own values play no part.
    """
    there = dict(evaluate(assemble(late(load_study("sun"), 0.2)), data.settings).metrics)
    fits, steps = [], list[float]()
    for gap in (0.4, 1.5):
        sun = mine(gap, trials=100, starts=1, ensemble=10)
        subjects = [
            FitSubject(sun, {"mine": data}),
            FitSubject(late(sun, 0.15), {"theirs": ReferenceData(data.settings, there, 0)}),
        ]
        fits.append(calibrate(subjects, InlinePool(), lambda loss, best: steps.append(loss), from_scratch=True))
    dry, wet = fits[0]
    assert dry.values[GAP].value == wet.values[GAP].value == pytest.approx(TRUTH, rel=0.05)
    assert wet.values[HESITATION].value == pytest.approx(0.2, abs=0.04)
    assert set(dry.values) == {GAP}
    assert [dry.values[GAP].is_shared, wet.values[HESITATION].is_shared] == [True, False]
    assert dry.loss == wet.loss
    assert (dry.used["mine"].rows, dry.held_back["mine"].rows) == (12, 12)
    assert steps[50] < steps[9] / 2, "the ensemble moves"
    assert [fit.values for fit in fits[0]] == [fit.values for fit in fits[1]]


def test_a_search_by_logarithm_has_the_geometric_mean_in_the_middle_and_stays_in_its_bounds() -> None:
    bounds = FreeParameter(lower=0.3, upper=30.0, unit="m", meaning="gap", log=True)
    linear = msgspec.structs.replace(bounds, log=False)
    space = FitSpace([FittedParameter(GAP, (0,), bounds), FittedParameter(HESITATION, (0,), linear)], [])
    assert space.values(np.array([[0.5, 0.5], [0.75, 0.0]])) == pytest.approx(
        np.array([[3.0, 15.15], [3 * 10**0.5, 0.3]])
    )
    assert space.values(np.ones(2)).max() <= 30.0
    assert space.values(np.full(2, 1 / 7)).tolist() == [0.579209, 4.54286], "six digits, as in the study file"


def test_errors_count_in_repeats_and_each_collision_on_one_side_alone_its_share(data: ReferenceData) -> None:
    """All of the loss is sum(w error / repeatability): a repeatability of 2 halves what one of 1 makes of it."""
    here = evaluate(assemble(mine(0.8)), data.settings)
    error = np.abs(here.f_safe - data.metrics["safety_degree"]).mean()
    only = FitTable(original=0.0, rank=0.0, collisions=0.0, weights={"safety_degree": 1.0})
    for unit in (1.0, 2.0):
        study = msgspec.structs.replace(mine(0.8), repeatability={"safety_degree": unit}, fit=only)
        assert reference_misfit(data, study, here).loss == pytest.approx(error / unit)
    published = {"safety_degree": np.array([-1.0, -2.0, -3.0, -1.0, 0.5, 2.0])}
    there = data.take(np.arange(24) < 6)._replace(metrics=published)
    study = msgspec.structs.replace(mine(0.8), fit=FitTable(rank=0.0, collisions=6.0, weights={}))
    here = made_up_evaluations([-2.0, -2.0, -2.0, 0.5, -1.5, 2.0], settings=np.ones((6, 12)))
    loss = reference_misfit(there, study, here).loss
    assert loss == pytest.approx(6 * 2 / 6), "four there and four here, three of them the same: two rows of six differ"


def test_a_linear_response_has_the_effects_that_it_was_made_with() -> None:
    characteristics = assemble(load_study("sun")).characteristics
    width, rng = characteristics.upper - characteristics.lower, np.random.default_rng(1)
    settings = rng.uniform(characteristics.lower, characteristics.upper, (200, 12))
    settings[:, 3] = characteristics.original[3]
    slopes = np.where(np.arange(12) == 3, np.nan, np.arange(12) - 5.0)  # one does not vary
    response = 1.0 + ((settings - characteristics.original) / width) @ np.nan_to_num(slopes)
    assert linear_effects(characteristics, settings, response) == pytest.approx(slopes, nan_ok=True)
    assert np.isnan(linear_effects(characteristics, settings[:20], np.ones(20))).all(), "too few rows"


def test_the_models_error_covers_nine_tenths_of_the_rows_of_each_file(data: ReferenceData) -> None:
    """Rows of one file lie in the middle of the band, those of the other beyond it: 1 to 24 distances from the
    original, at least 0.3.
    """
    sets = {GAP: [value_of(mine(1.0), GAP)] * 2}
    study = msgspec.structs.replace(mine(1.0), spread=sets, repeatability={"safety_degree": 1e-9})
    ch = assemble(study).characteristics
    away = np.maximum(np.sqrt((((data.settings - ch.original) / (ch.upper - ch.lower)) ** 2).sum(axis=1)), 0.3)
    far = data._replace(metrics={"safety_degree": data.metrics["safety_degree"] + away * np.arange(1, 25)})
    # Of 24 rows the 23rd: ceil(0.9 * 25); another file without a miss changes nothing.
    assert error_beyond_spread(study, {"far": far}) == pytest.approx(23, abs=1e-6)
    assert error_beyond_spread(study, {"near": data, "far": far}) == pytest.approx(23, abs=1e-6)
    assert error_beyond_spread(study, {"near": data}) == 0


class Bowl:
    """The loss is the squared distance from a place, and `step` more in the wrong half, above a `bottom`, on [0, 1] x
    [0, 10].
    """

    def __init__(self, bottom: float = 0.0, step: float = 1.0) -> None:
        self.bottom, self.step, self.generations = bottom, step, list[int]()

    def misfits_at(self, places: Sequence[FloatArray]) -> list[Misfit]:
        self.generations.append(len(places))
        return [
            Misfit(float(((place - 0.2) ** 2).sum() + self.step * (place[0] > 0.5)) + self.bottom, place - 0.2)
            for place in places
        ]


def race_in(bowl: Bowl, population: int, trials: int) -> tuple[SearchRace, list[float]]:
    losses = list[float]()
    return SearchRace(bowl.misfits_at, population, trials, lambda loss, best: losses.append(loss)), losses


def test_what_fits_as_well_is_an_interval_and_sets_that_are_far_apart() -> None:
    """Above a bottom of one, within 4 % of it is what is 0.2 from the bottom."""
    race, _ = race_in(Bowl(bottom=1.0), 8, 800)
    race.run([CmaSearch(race, np.array([place, 0.6]), 0.3, 3) for place in (0.9, 0.5)])
    assert race.best_place == pytest.approx([0.2, 0.2], abs=0.01)
    parameters = [
        FittedParameter(name, (i,), FreeParameter(lower=0.0, upper=upper, unit="-", meaning="place"))
        for i, (name, upper) in enumerate((("a", 1.0), ("b", 10.0)))
    ]
    profiles = Profiles.of(parameters, FitSpace(parameters, []), [race], 0.04)
    for i, whole in enumerate((0.4, 4.0)):
        low, high = profiles.interval(i)
        assert 0 <= low < 0.3 * whole < 0.7 * whole < high <= whole, "no more than what is as good, and most of it"
    assert list(profiles.spread(1)) == ["b"]
    sets = profiles.spread(0)["a"]
    assert len(sets) == 20
    assert sets[0] == pytest.approx(0.2, abs=0.001)
    assert (min(sets), max(sets)) == pytest.approx(profiles.interval(0), abs=0.1)
    as_good, worse = (race_in(Bowl(), 8, 8)[0] for _ in range(2))
    as_good.lowest_loss, as_good.best_place = 1.01, np.array([0.23, 0.2])
    worse.lowest_loss, worse.best_place = 1.05, np.array([0.9, 0.9])
    repeated = Profiles.of(parameters, FitSpace(parameters, []), [worse, as_good, race], 0.04)
    assert repeated.spread(0)["a"][:2] == pytest.approx([0.2, 0.23], abs=0.001), "the bests of all that fit as well"
    assert 0.9 not in repeated.spread(0)["a"]


PLACE = np.array([0.7, 0.2, 0.45])


class LinearModel:
    """Residuals are linear in the places' logits, with noise of `noise`; computed elsewhere, their last digits may be
    others.
    """

    def __init__(self, noise: float, rows: int = 60, last_digits: float = 0.0) -> None:
        self.matrix, self.noise = np.random.default_rng(8).standard_normal((rows, len(PLACE))), noise
        self.places, self.last_digits = list[FloatArray](), last_digits

    def residuals(self, place: FloatArray) -> FloatArray:
        return np.asarray(self.matrix @ (logit(place) - logit(PLACE)) / self.noise * (1 + self.last_digits))

    def misfits_at(self, places: Sequence[FloatArray]) -> list[Misfit]:
        self.places.extend(places)
        return [Misfit(float((values**2).sum()), values) for values in map(self.residuals, places)]


def inversion_of(
    model: LinearModel, size: int, max_trials: int, seed: int = 1
) -> tuple[FloatArray, FloatArray, SearchRace]:
    race = SearchRace(model.misfits_at, 8, 10_000, lambda loss, best: None)
    return *invert(race, len(PLACE), size, max_trials, np.random.default_rng(seed)), race


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_linear_model_is_inverted_and_the_last_places_scatter_as_the_posterior(seed: int) -> None:
    """With weak prior knowledge the posterior of a linear model is the least-squares estimate with covariance (A.T
    A)^-1 noise^2.
    """
    model = LinearModel(noise=0.5)
    place, _, race = inversion_of(model, 400, 10_000, seed)
    assert place == pytest.approx(PLACE, abs=0.03)
    last = logit(np.array(model.places[-400:]))
    covariance = np.linalg.inv(model.matrix.T @ model.matrix) * model.noise**2
    assert last.mean(axis=0) == pytest.approx(logit(PLACE), abs=0.05)
    assert np.cov(last.T) == pytest.approx(covariance, abs=0.3 * covariance.max())
    assert race.trials_left == 10_000 - len(model.places)
    assert race.lowest_loss == float((model.residuals(place) ** 2).sum())


def test_last_digits_of_residuals_do_not_reach_the_search_that_follows() -> None:
    """Two computations of one fit, such as on two computers, try the same places, although their residuals differ in
    the last digits.
    """
    tried = []
    for model in (LinearModel(noise=0.5), LinearModel(noise=0.5, last_digits=1e-12)):
        place, axes, race = inversion_of(model, 40, 1000)
        CmaSearch(race, place, 0.05, seed=3, axes=axes).advance(160)
        tried.append(np.array(model.places))
    assert len(tried[0]) > 200
    assert (tried[0] == tried[1]).all()


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
    ranges = (min(low), max(low)), (min(high), max(high))
    assert ends(study, 8).across_fits == (len(low), ranges, len(of_each) - len(low))
