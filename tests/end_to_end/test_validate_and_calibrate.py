"""validate and calibrate as a user types them, on small files that are made here."""

from __future__ import annotations

import errno
import json
import os
import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from safevar_sumo.analysis.parameters import with_values
from safevar_sumo.cli import calibrate
from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError
from safevar_sumo.reference.calibration import FitSubject
from safevar_sumo.study import Study, load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import assemble
from tests.in_process import refused, run

COLUMNS = {"safety_degree": "SaftyDegree", "tet": "TET", "tit": "TIT", "ave_dece": "Dece"}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Forty settings of the study sun in the published format, with the metrics that this package finds."""
    system = assemble(load_study("sun"))
    characteristics = system.characteristics
    settings = np.random.default_rng(3).uniform(characteristics.lower, characteristics.upper, (40, 12))
    filtered = np.where(
        np.abs(settings - characteristics.original) > 1.2 * characteristics.threshold,
        settings,
        characteristics.original,
    )
    result = evaluate(system, filtered)
    frame = pd.DataFrame(filtered, columns=list(characteristics.names))
    for name, column in COLUMNS.items():
        frame[column] = np.nan_to_num(result.metrics[name])
    path = tmp_path_factory.mktemp("data") / "mine.csv"
    frame.to_csv(path, index=False)
    return path


@pytest.mark.slow
def test_validate_agrees_perfectly_with_itself(data: Path, in_tmp: Path) -> None:
    output = json.loads(
        run("validate", "sun", str(data), "--json", "--plot", "plot.png", "--totals", "kept.toml").stdout
    )
    assert list(output) == [
        "rows",
        "spearman",
        "mean_absolute_error",
        "bias",
        "collisions",
        "original",
        "precision",
        "recall",
        "collision_speed",
        "in_repeats",
        "undecided",
        "by_predicted",
    ]
    assert output["rows"] == 40
    for name in COLUMNS:
        assert output["spearman"][name] == pytest.approx(1.0)
        assert output["mean_absolute_error"][name] == pytest.approx(0.0, abs=1e-12)
        assert set(output["original"][name]) == {"reference", "here"}
    assert output["collisions"]["reference"] == output["collisions"]["here"] == output["collisions"]["both"]
    assert (in_tmp / "plot.png").stat().st_size > 50_000
    kept = tomllib.loads((in_tmp / "kept.toml").read_text())["sun"]["mine.csv"]
    assert (kept["rows"], kept["collisions"]) == (40, output["collisions"])
    assert kept["spearman"]["safety_degree"] == pytest.approx(1.0)


def test_validate_warns_of_rows_outside_the_domains(data: Path, in_tmp: Path) -> None:
    frame = pd.read_csv(data)
    frame.loc[:4, "tireFric"] = 9.0
    frame.to_csv("outside.csv", index=False)
    done = run("validate", "sun", "outside.csv", "--json")
    assert json.loads(done.stdout)["rows"] == 35
    assert "5 rows" in done.stderr


@pytest.mark.slow
def test_calibrate_finds_back_what_was_changed(data: Path, in_tmp: Path) -> None:
    """A study that starts from another brake gap comes nearer to the one that the data was made with."""
    Path("mine.toml").write_text(
        'extends = "sun"\nname = "mine"\n[ads.parameters]\nbrake_gap = 8.0\n'
        '[calibration]\n"ads.parameters.brake_gap" = { lower = 6, upper = 12, unit = "m", meaning = "gap" }\n'
    )
    truth = load_study("sun").ads.parameters["brake_gap"]
    done = run("calibrate", "mine.toml", str(data), "--trials", "37", "--seed", "3", "--out", "found.toml")
    result = tomllib.loads(Path("found.toml").read_text())
    assert abs(result["ads"]["parameters"]["brake_gap"] - truth) < 0.5 * abs(8.0 - truth)
    assert "held back" in done.stdout
    head = Path("found.toml").read_text().split("\n\n")[0]
    for word in ("CMA-ES", "seed 3", "mine.csv, SHA-256", "Loss"):
        assert word in head
    assert load_study("found.toml").vehicle.characteristics == load_study("mine.toml").vehicle.characteristics
    contents = set()
    for _ in range(2):
        run("calibrate", "mine.toml", str(data), "--trials", "7", "--seed", "3", "--out", "again.toml")
        contents.add(Path("again.toml").read_bytes())
    assert len(contents) == 1


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("vehicle.characteristics.mass.original", ("vehicle.characteristics.mass.original",)),
        ("ads.parameters.nothing", ("ads.parameters.nothing",)),
        ("weather.name", ("weather.name",)),
        ("ads.parameters.throttle.00", ("ads.parameters.throttle.00",)),
    ],
)
def test_calibrate_touches_nothing_but_parameters(key: str, expected: tuple[str, ...], in_tmp: Path) -> None:
    Path("mine.toml").write_text(
        f'extends = "sun"\nname = "mine"\n[calibration]\n"{key}" = {{ lower = 1, upper = 2, unit = "-", '
        f'meaning = "none" }}\n'
    )
    refused("calibrate", "mine.toml", "--trials", "1", "--out", "x.toml", message=expected)


@pytest.mark.parametrize(
    ("key", "lower", "upper", "expected"),
    [
        ("weather.road_friction", -3, 3, ("weather.road_friction", "lower = -3", "> 0")),
        ("weather.road_friction", 0.5, 3, ("weather.road_friction", "upper = 3", "<= 1.5")),
        ("vehicle.parameters.camera_height", 0.01, 3, ("camera_height", "lower = 0.01", "0.1")),
    ],
)
def test_calibrate_refuses_bounds_that_the_models_do_not_take(
    key: str, lower: float, upper: float, expected: tuple[str, ...], in_tmp: Path
) -> None:
    Path("mine.toml").write_text(
        f'extends = "sun"\nname = "mine"\n[calibration]\n'
        f'"{key}" = {{ lower = {lower}, upper = {upper}, unit = "-", meaning = "none" }}\n'
    )
    refused("calibrate", "mine.toml", "--trials", "13", "--out", "x.toml", message=expected)


def test_calibrate_does_not_write_over_what_it_starts_from(data: Path, in_tmp: Path) -> None:
    refused("calibrate", "sun", str(data), "--trials", "1", "--out", str(data), message=("--out", data.name))
    assert data.read_text().startswith("max_rpm")


def test_calibrate_does_not_write_over_a_study_that_its_study_extends(in_tmp: Path) -> None:
    Path("base.toml").write_text('extends = "sun"\n')
    Path("child.toml").write_text('extends = "base.toml"\nname = "child"\n')
    refused(
        "calibrate",
        "child.toml",
        "--trials",
        "1",
        "--out",
        "base.toml",
        message=("--out", "base.toml", "an input of the command"),
    )
    assert Path("base.toml").read_text() == 'extends = "sun"\n'


def small_fit() -> tuple[str, ...]:
    """Write a study with a free parameter, and return the command that fits it in few trials."""
    Path("mine.toml").write_text(
        'extends = "sun"\nname = "mine"\n[ads.parameters]\nbrake_gap = 8.0\n'
        '[calibration]\n"ads.parameters.brake_gap" = { lower = 6, upper = 12, unit = "m", meaning = "gap" }\n'
    )
    return "calibrate", "mine.toml", "--trials", "5", "--out", "found.toml"


def test_a_picture_that_fails_does_not_lose_the_fit(in_tmp: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: object) -> None:
        raise InputError("plot", "no space is left")

    monkeypatch.setattr(calibrate, "plot_profiles", failing)
    refused(*small_fit(), "--plot", "plot.png", message=("--plot", "no space is left"))
    assert 6 <= load_study("found.toml").ads.parameters["brake_gap"] <= 12


def test_a_full_disk_loses_neither_the_old_file_nor_the_fit(in_tmp: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace = os.replace

    def full(source: Path, target: Path) -> None:
        if target.name == "found.toml":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target)

    Path("found.toml").write_text("old")
    monkeypatch.setattr(os, "replace", full)
    done = run(*small_fit(), expect=2)
    assert "cannot write found.toml: No space left on device" in done.stderr
    assert re.search(r"brake_gap +. +m +. +[\d.]+ ", done.stdout), "what was found is printed first"
    assert Path("found.toml").read_text() == "old"
    assert sorted(path.name for path in in_tmp.iterdir()) == ["found.toml", "mine.toml"]


def test_the_best_so_far_is_saved_now_and_then(in_tmp: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(
        subjects: Sequence[FitSubject], pool: object, done: Callable[[float, tuple[Study]], None], *, from_scratch: bool
    ) -> None:
        done(1.0, (with_values(subjects[0].study, {"ads.parameters.brake_gap": 5.5}),))
        raise SystemExit

    monkeypatch.setattr(calibrate, "calibrate", killed)
    monkeypatch.setattr(calibrate, "SECONDS_BETWEEN_SAVES", 0.0)
    CliRunner().invoke(commands, ["calibrate", "sun", "--trials", "9", "--out", "best.toml"])
    assert "Best of 1 of 9 trials, while more are tried" in Path("best.toml").read_text()
    assert load_study("best.toml").ads.parameters["brake_gap"] == 5.5


@pytest.mark.slow
def test_settings_that_cannot_be_simulated_are_told(data: Path, in_tmp: Path, worker_processes: None) -> None:
    Path("hasty.toml").write_text('extends = "sun"\nname = "hasty"\n[search]\ntime_limit = 0.001\n')
    pd.read_csv(data).head(1).to_csv("one.csv", index=False)
    assert (
        "the original vehicle cannot be simulated either" in run("validate", "hasty.toml", "one.csv", expect=1).stderr
    )


def test_an_interrupted_calibration_leaves_the_best_so_far(in_tmp: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(
        subjects: Sequence[FitSubject], pool: object, done: Callable[[float, tuple[Study]], None], *, from_scratch: bool
    ) -> None:
        done(2.0, (subjects[0].study,))
        done(1.0, (with_values(subjects[0].study, {"ads.parameters.brake_gap": 5.5}),))
        raise KeyboardInterrupt

    monkeypatch.setattr(calibrate, "calibrate", interrupted)
    CliRunner().invoke(commands, ["calibrate", "sun", "--trials", "9", "--out", "best.toml"])
    assert "Best of 2 of 9 trials" in Path("best.toml").read_text()
    assert load_study("best.toml").ads.parameters["brake_gap"] == 5.5


@pytest.mark.slow
def test_several_studies_are_fitted_together(data: Path, in_tmp: Path) -> None:
    free = '[calibration]\n"ads.parameters.brake_gap" = { lower = 6, upper = 12, unit = "m", meaning = "gap" }\n'
    Path("mine.toml").write_text(f'extends = "sun"\nname = "mine"\n{free}')
    Path("late.toml").write_text(f'extends = "sun"\nname = "late"\n[ads.parameters]\nhesitation = 0.1\n{free}')
    Path("late_rows.csv").write_bytes(data.read_bytes())
    words = ("calibrate", "mine.toml", "late.toml", f"mine={data}", "late_rows.csv", "--trials", "15")
    refused(*words, "--out", "nowhere", message=("--out", "nowhere"))
    Path("fitted").mkdir()
    lines = run(*words, "--out", "fitted").stdout.splitlines()
    row = next(line for line in lines if "brake_gap *" in line)
    assert "6 to 12" in row, "a table of the usual width breaks no number"
    assert "* shared with late" in lines
    fitted = [tomllib.loads(Path(f"fitted/{name}-calibrated.toml").read_text()) for name in ("mine", "late")]
    assert fitted[0]["ads"]["parameters"]["brake_gap"] == fitted[1]["ads"]["parameters"]["brake_gap"]
    assert "hesitation" not in fitted[0]["ads"]["parameters"]
    heads = [Path(f"fitted/{name}-calibrated.toml").read_text().split("\n\n")[0] for name in ("mine", "late")]
    assert "together with 'late'" in heads[0]
    assert "late_rows.csv, SHA-256" in heads[1]
    assert "late_rows.csv" not in heads[0]
    Path("rows.csv").write_bytes(data.read_bytes())
    refused(
        "calibrate",
        "mine.toml",
        "late.toml",
        "rows.csv",
        "--trials",
        "1",
        message=("rows.csv", "mine, late", "STUDY=FILE.csv"),
    )


def test_validate_tells_effects_when_asked(in_tmp: Path) -> None:
    system = assemble(load_study("sun"))
    characteristics = system.characteristics
    settings = np.random.default_rng(5).uniform(characteristics.lower, characteristics.upper, (160, 12))
    frame = pd.DataFrame(settings, columns=list(characteristics.names)).assign(
        SaftyDegree=evaluate(system, settings).f_safe + 0.3 * settings[:, 0] / 2800, TIT=0.0, TET=0.0
    )
    frame.to_csv("rows.csv", index=False)
    effects = json.loads(run("validate", "sun", "rows.csv", "--json", "--effects").stdout)["effects"]
    assert list(effects) == list(characteristics.names)
    assert effects["mass"]["agrees"] is True
    assert effects["max_rpm"]["reference"] - effects["max_rpm"]["here"] == pytest.approx(0.3, abs=0.05)
    assert "max_rpm" in run("validate", "sun", "rows.csv", "--effects").stdout
