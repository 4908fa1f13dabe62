"""The script that fits studies to published rows: its loss, its space, and a search that improves a
planted parameter; and the uncertainty that parameter sets make of a setting.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest
from msgspec.structs import replace

from calibration import fit
from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.model_spread import (
    compute_model_spreads,
    value_of,
    with_values,
)
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble
from tests.support.in_process import SLOW, write
from tests.support.made_up import (
    SUN,
    changed,
    made_up_evaluations,
    published_rows,
    system_of,
    uniform,
)

GAP = "ads.parameters.brake_gap"
OWN = float(load_study("sun").ads.parameters["brake_gap"])
PLANS = sorted((Path(fit.__file__).parent).glob("*.toml"))


@pytest.fixture(scope="module")
def data() -> ReferenceData:
    system = system_of("sun")
    characteristics = system.characteristics
    settings = uniform(characteristics, 24, 3)
    return ReferenceData(settings, dict(drive_and_score(system, settings).metrics))


@SLOW
def test_a_search_brings_a_planted_parameter_nearer_to_the_truth(
    data: ReferenceData, in_tmp: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From a gap of 8 m towards the 6.9 m that the rows were made with."""
    write(
        "mine.toml",
        'extends = "sun"\nname = "mine"\n[ads.parameters]\nbrake_gap = 8.0\n',
    )
    write(
        "plan.toml",
        "population = 4\nhold_out = 4\ntolerance = 0.045\n[[parameters]]\n"
        f'key = "{GAP}"\nlower = 6\nupper = 12\nunit = "m"\nmeaning = "gap"\n'
        '[studies."mine.toml"]\nfiles = ["rows.csv"]\noriginal = 1.0\nrank = 5.0\ncollisions ='
        " 10.0\n"
        "weights = { safety_degree = 1.0 }\n",
    )
    rows = published_rows(SUN, data.settings, data.metrics)
    rows.to_csv("rows.csv", index=False)
    for seed, number in (("1", "13"), ("2", "5")):
        fit.main(
            [
                "plan.toml",
                ".",
                "--log",
                "log.csv",
                "--trials",
                number,
                "--seed",
                seed,
                "--jobs",
                "1",
            ]
        )
    trials = pd.read_csv("log.csv")
    assert list(trials) == ["loss", GAP]
    assert len(trials) == (1 + 12) + (1 + 4), (
        "the study's own values, and whole generations"
    )
    assert trials[GAP][0] == 8.0
    best = trials.loc[trials["loss"].idxmin()]
    assert best["loss"] < trials["loss"][0]
    assert abs(best[GAP] - OWN) < abs(8.0 - OWN)
    printed = capsys.readouterr().out
    assert f'"{GAP}" = [{best[GAP]:g}' in printed
    assert "rows.csv, held back: spearman" in printed


@pytest.mark.parametrize("path", PLANS, ids=[path.stem for path in PLANS])
def test_a_plan_has_the_values_of_its_studies_within_its_bounds(path: Path) -> None:
    plan = msgspec.toml.decode(path.read_bytes(), type=fit.Plan)
    values = fit.Fit(
        plan, {name: load_study(name) for name in plan.studies}, {}
    ).own_values()
    assert all(
        row.lower <= value <= row.upper
        for row, value in zip(plan.parameters, values, strict=True)
    )


def test_errors_count_in_repeats_and_each_collision_on_one_side_alone_its_share(
    data: ReferenceData,
) -> None:
    """All of the loss is sum(w error / repeatability): a repeatability of 2 halves what one of 1
    makes of it.
    """
    nearer = with_values(load_study("sun"), {GAP: 0.8 * OWN})
    here = drive_and_score(assemble(nearer), data.settings)
    error = np.abs(here.f_safe - data.metrics["safety_degree"]).mean()
    only = fit.Target(
        [], {"safety_degree": 1.0}, original=0.0, rank=0.0, collisions=0.0
    )
    for unit in (1.0, 2.0):
        study = replace(nearer, repeatability={"safety_degree": unit})
        assert fit.loss_of_file(data, here, study, only) == pytest.approx(error / unit)
    published = {"safety_degree": np.array([-1.0, -2.0, -3.0, -1.0, 0.5, 2.0])}
    there = data.take(np.arange(24) < 6)._replace(metrics=published)
    here = made_up_evaluations(
        [-2.0, -2.0, -2.0, 0.5, -1.5, 2.0], settings=np.ones((6, 12))
    )
    collisions = fit.Target([], {}, original=0.0, rank=0.0, collisions=6.0)
    assert fit.loss_of_file(there, here, nearer, collisions) == pytest.approx(
        6 * 2 / 6
    ), "four there and four here, three of them the same: two rows of six differ"


def test_a_linear_response_has_the_effects_that_it_was_made_with() -> None:
    study = load_study("sun")
    characteristics = assemble(study).characteristics
    width = characteristics.upper - characteristics.lower
    settings = uniform(characteristics, 200, 1)
    settings[:, 3] = characteristics.original[3]
    slopes = np.where(
        np.arange(12) == 3, np.nan, np.arange(12) - 5.0
    )  # one does not vary
    response = 1.0 + ((settings - characteristics.original) / width) @ np.nan_to_num(
        slopes
    )
    assert fit.linear_effects(study, settings, response) == pytest.approx(
        slopes, nan_ok=True
    )
    assert np.isnan(fit.linear_effects(study, settings[:20], np.ones(20))).all(), (
        "too few rows"
    )


def test_the_models_error_covers_nine_tenths_of_the_rows_of_each_file(
    data: ReferenceData,
) -> None:
    """Rows of one file lie in the middle of the band, those of the other beyond it: 1 to 24
    distances from the original, at least 0.3.
    """
    sets = {GAP: [value_of(load_study("sun"), GAP)] * 2}
    study = replace(
        load_study("sun"), spread=sets, repeatability={"safety_degree": 1e-9}
    )
    ch = assemble(study).characteristics
    away = np.maximum(
        np.sqrt(
            (((data.settings - ch.original) / (ch.upper - ch.lower)) ** 2).sum(axis=1)
        ),
        0.3,
    )
    far = data._replace(
        metrics={
            "safety_degree": data.metrics["safety_degree"] + away * np.arange(1, 25)
        }
    )
    # Of 24 rows the 23rd: ceil(0.9 * 25); another file without a miss changes nothing.
    assert fit.model_error(study, [far]) == pytest.approx(23, abs=1e-6)
    assert fit.model_error(study, [data, far]) == pytest.approx(23, abs=1e-6)
    assert fit.model_error(study, [data]) == 0


def test_the_sets_are_simulated_one_by_one() -> None:
    study = load_study(
        "sun",
        spread={GAP: [OWN, OWN - 1, OWN + 1]},
        repeatability={"safety_degree": 1e-9},
        model_error={},
    )
    setting = changed(system_of(study), tireFric=1.3)
    alone = [
        drive_and_score(
            system_of("sun", ads={"parameters": {"brake_gap": gap}}), setting
        )
        for gap in (OWN, OWN - 1, OWN + 1)
    ]
    (band,) = compute_model_spreads(study, setting)
    assert (band.lower, band.upper) == pytest.approx(
        np.quantile([float(one.f_safe[0]) for one in alone], [0.05, 0.95]).tolist(),
        abs=1e-6,
    )
    assert (band.sets, band.collisions) == (
        3,
        sum(int(one.collided[0]) for one in alone),
    )
