"""Study files are read strictly: every error names file, key, value and what is legal."""

from __future__ import annotations

import shutil
from pathlib import Path

import msgspec
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.shipped import STUDIES
from safevar_sumo.study import load_study, study_names


@pytest.mark.parametrize("name", study_names())
def test_every_shipped_study_loads_under_its_own_name(name: str) -> None:
    assert load_study(name).name == name


def test_the_published_settings_are_searched_as_published() -> None:
    for name, population, evaluations, threshold in (("sun", 50, 5000, 1.5), ("rain", 50, 5000, 1.5), ("lgsvl", 30, 3000, 3.0)):
        study = load_study(name)
        assert (study.search.population, study.search.evaluations, study.search.runs) == (population, evaluations, 30)
        assert study.metrics.ttc_threshold == threshold
        assert len(study.vehicle.characteristics) == 12


def test_rain_differs_from_sun_in_weather_alone() -> None:
    sun, rain = load_study("sun"), load_study("rain")
    assert rain.weather != sun.weather
    same = {"name": sun.name, "title": sun.title, "published": sun.published, "calibration": sun.calibration}
    assert msgspec.structs.replace(rain, weather=sun.weather, **same) == sun
    assert set(rain.calibration) == {"weather.road_friction", "weather.recognition_delay"}


def variant(tmp_path: Path, old: str, new: str) -> str:
    text = (STUDIES / "sun.toml").read_text()
    assert old in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new, 1))
    return str(path)


@pytest.mark.parametrize(("old", "new", "told"), [
    ("runs = 30", "runs = 30\ntime_limit = inf", "search.time_limit = inf"),
    ("runs = 30", "runs = 30\ntime_limit = 0", "search.time_limit = 0"),
    ("ttc_threshold = 1.5", "ttc_threshold = 1.5\nttc = 2", "metrics: Object contains unknown field `ttc`"),
    ("ttc_threshold = 1.5", "ttc_threshold = '1.5'", "metrics.ttc_threshold = '1.5'"),
    ("ttc_threshold = 1.5", "ttc_threshold = nan", "metrics.ttc_threshold = nan"),
    ("ttc_threshold = 1.5", "ttc_threshold = -1", "metrics.ttc_threshold = -1"),
    ("population = 50", "population = 1", "search.population = 1"),
    ("population = 50", "population = 50.5", "search.population = 50.5"),
    ("runs = 30", "", "search: Object missing required field `runs`"),
    ("lower = 4200, upper = 7000", "lower = 7000, upper = 4200", "vehicle.characteristics.max_rpm: lower = 7000.0 and upper = 4200.0"),
    ("lower = 4200, upper = 7000", "lower = 5900, upper = 7000", "vehicle.characteristics.max_rpm.original = 5800.0"),
    ("original = 5800", "original = nan", "vehicle.characteristics.max_rpm.original = nan"),
    ("original = 5800", "original = 'many'", "vehicle.characteristics.max_rpm.original = 'many'"),
    ("original = 0.15, lower = 0.1", "original = 0, lower = -1", "vehicle.characteristics.dampRateFullT.original = 0"),
    ("[ads]", "[ads", "is not TOML"),
    ('name = "sun"', 'name = "../sun"', "name = '../sun'"),
    ('name = "sun"', 'name = "sun"\nextends = "nothing"', "nothing"),
])
def test_a_bad_study_is_refused_with_file_key_and_value(tmp_path: Path, old: str, new: str, told: str) -> None:
    path = variant(tmp_path, old, new)
    with pytest.raises(InputError) as caught:
        load_study(path)
    message = str(caught.value)
    assert told in message
    assert path in message or "extends" in new
    assert len(message.splitlines()) <= 2


def test_a_study_may_extend_a_file_beside_it(tmp_path: Path) -> None:
    shutil.copy(STUDIES / "sun.toml", tmp_path / "base.toml")
    (tmp_path / "mine.toml").write_text('extends = "base.toml"\nname = "mine"\n[search]\nruns = 3\n')
    study = load_study(str(tmp_path / "mine.toml"))
    assert (study.name, study.search.runs, study.search.population) == ("mine", 3, 50)


def test_a_study_that_extends_itself_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('extends = "b.toml"\n')
    (tmp_path / "b.toml").write_text('extends = "a.toml"\n')
    with pytest.raises(InputError, match="leads back"):
        load_study(str(tmp_path / "a.toml"))


def test_an_unknown_study_is_told_which_there_are() -> None:
    with pytest.raises(InputError, match="sun"):
        load_study("sum")
