"""Study files are read strictly, limits too: every error names file, key, value and the expected values; and the
shipped JSON schema, as an editor uses it.
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import jsonschema
import msgspec
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.results.manifest import evaluation_keys
from safevar_sumo.shipped import STUDIES, STUDY_SCHEMA
from safevar_sumo.study import Limit, limits_of, load_study, study_names, tables_of, write_study
from safevar_sumo.study.file_schema import schema_text
from safevar_sumo.sumo.system import assemble


def variant(tmp_path: Path, old: str, new: str) -> str:
    text = (STUDIES / "sun.toml").read_text()
    assert old in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new, 1))
    return str(path)


REPLACEMENTS = [
    ("runs = 30", "runs = 30\ntime_limit = inf", "search.time_limit = inf"),
    ("runs = 30", "runs = 30\ntime_limit = 0", "search.time_limit = 0"),
    ("ttc_threshold = 1.5", "ttc_threshold = 1.5\nttc = 2", "metrics.ttc: there is no such key"),
    ("ttc_threshold = 1.5", "ttc_threshold = '1.5'", "metrics.ttc_threshold = '1.5'"),
    ("ttc_threshold = 1.5", "ttc_threshold = nan", "metrics.ttc_threshold = nan"),
    ("ttc_threshold = 1.5", "ttc_threshold = -1", "metrics.ttc_threshold = -1"),
    ("population = 50", "population = 1", "search.population = 1"),
    ("population = 50", "population = 50.5", "search.population = 50.5"),
    ("runs = 30", "", "search: 'runs' is a required property"),
    (
        "lower = 4200, upper = 7000",
        "lower = 7000, upper = 4200",
        "vehicle.characteristics.max_rpm: lower = 7000.0 and upper = 4200.0",
    ),
    (
        "lower = 4200, upper = 7000",
        "lower = 5800, upper = 5800",
        "vehicle.characteristics.max_rpm: lower = 5800.0 and upper = 5800.0",
    ),
    ("lower = 4200, upper = 7000", "lower = 5900, upper = 7000", "vehicle.characteristics.max_rpm.original = 5800.0"),
    ("original = 5800", "original = nan", "vehicle.characteristics.max_rpm.original = nan"),
    ("original = 5800", "original = 'many'", "vehicle.characteristics.max_rpm.original = 'many'"),
    ("original = 0.15, lower = 0.1", "original = 0, lower = -1", "vehicle.characteristics.dampRateFullT.original = 0"),
    ("[ads]", "[ads", "cannot be read as TOML"),
    ('name = "sun"', 'name = "../sun"', "name = '../sun'\nexpected: letters, digits, _, . and -"),
    ('name = "sun"', 'name = "sun"\nextends = "nothing"', "nothing"),
]
"""A text of `sun`, another text in its place, and what the error says."""


@pytest.mark.parametrize(("old", "new", "expected"), REPLACEMENTS)
def test_a_bad_study_is_refused_with_file_key_and_value(tmp_path: Path, old: str, new: str, expected: str) -> None:
    path = variant(tmp_path, old, new)
    with pytest.raises(InputError) as caught:
        load_study(path)
    message = str(caught.value)
    assert expected in message
    assert path in message or "extends" in new
    assert len(message.splitlines()) <= 2


ADDITIONS = [
    ("[search]\nruns = 1_000_000", "search.runs = 1000000"),
    ("[search]\nevaluations = 9223372036854775807", "search.evaluations"),
    (
        "[variation.mass]\ndistribution = 'normal'\ndeviation = 1e300",
        "variation.mass.deviation = 1e+300 is greater than the maximum",
    ),
    ("[variation.mass]\ndistribution = 'uniform'\nlower = 9999", "variation.mass.lower = 9999"),
    ('[calibration."ads.parameters.brake_gap"]\nlower = "a"', "calibration.'ads.parameters.brake_gap'.lower = 'a'"),
    (
        '[calibration."ads.parameters.brake_gap"]\nlow = 1',
        "calibration.'ads.parameters.brake_gap'.low: there is no such key",
    ),
    ('[published]\ntet = "much"', "published.tet = 'much'"),
    ("seed = 3", "seed: there is no such key; did you mean search.seed or fit.seed?"),
    ("[search]\nttc_threshold = 3", "search.ttc_threshold: there is no such key; did you mean metrics.ttc_threshold?"),
    (
        "[vehicle.characteristics.masss]\noriginal = 9",
        "vehicle.characteristics.masss: 'unit' is a required property; did you mean 'mass'?",
    ),
    ("[vehicle.characteristics.mass]\nupper = 1e300", "1e+300]\nexpected: numbers up to 1e+12"),
    ("[search]\nevaluatons = 5", "search.evaluatons: there is no such key; did you mean 'evaluations'?"),
    ("evaluatons = 5", "evaluatons: there is no such key; did you mean search.evaluations?"),
    ("\n".join(f"x{i} = 1" for i in range(20_000)), "more than 8 mistakes: x0: there is no such key"),
    (
        '[weather]\nname = "x"\nroad_friction = 0\nvisibility = 1',
        "weather.road_friction = 0 is less than or equal to the minimum of 0",
    ),
    ("zzz = 1", "zzz: there is no such key\nexpected: one of ads, calibration"),
    ("[origin]\nplaces = []", "origin"),
    ("[vehicle]\ncharacteristics = 3", "vehicle.characteristics = 3\nexpected: a table"),
    ("[repair.promise]\nmass = 3", "repair.promise.mass = 3\nexpected: a table of at_least, at_most, source"),
    ('[ads]\nkind = "fmuu"', "ads.kind = 'fmuu'; did you mean 'fmu'?\nexpected: one of fmu, traci"),
    (
        '[variation.mass]\ndistribution = "norml"',
        "variation.mass = {'distribution': 'norml'}\nexpected: one of fixed, lognormal",
    ),
    (
        '[metrics]\nalso = ["max_jerk", "max_jerk"]',
        "metrics.also = ['max_jerk', 'max_jerk']\nexpected: each metric once",
    ),
    ("[[constraints]]\nsum = { mass = 'a' }", "constraints[0].sum.mass = 'a' is not of type 'number'"),
    ('extends = "euro_ncap_rating"\n[rating.claims]\nCCRs = [3]', "rating.claims.CCRs[0] = 3 is not of type 'string'"),
    ('[rating.claims]\nCCRs = ["glare"]', "rating.claims: the study is not rated\nexpected: matrix.protocol"),
    ("search = 3", "search = 3"),
    ('[vehicle]\nmodel = "tesla"', "vehicle: 'characteristics' is a required property"),
    ('extends = "mine.toml"\n', "extends = 'mine.toml' leads back to "),
    ("[vehicle]\nstep = 0.001", "vehicle.step: 'carla' is no FMU\nexpected: no such key"),
    ('[vehicle.inputs]\nfoo = "bar"', "vehicle.inputs: 'carla' is no FMU"),
    ("[vehicle.sensors]\nmount = 1", "vehicle.sensors: 'carla' is no FMU"),
    ("[ads]\nstep = 0.2", "ads.step: 'world_on_rails' is no FMU"),
    ('[ads.outputs]\nfoo = "bar"', "ads.outputs: 'world_on_rails' is no FMU"),
    ('[scenario]\nkind = "fmu"', "scenario.kind: 'pedestrian_crossing' is no FMU\nexpected: no such key"),
    (
        '[calibration."ads.parameters.brake_gapp"]\nlower = 1\nupper = 2\nunit = "m"\nmeaning = "x"',
        "calibration.'ads.parameters.brake_gapp' is no parameter of the study",
    ),
    ("extends = 3\n", "extends"),
]
"""A text in a study that extends `smoke`, and what the error says."""


@pytest.mark.parametrize(("text", "expected"), ADDITIONS)
def test_an_unusable_value_is_refused_by_its_key(text: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text if text.startswith("extends") else f'extends = "smoke"\nname = "mine"\n{text}\n')
    with pytest.raises(InputError) as caught:
        load_study(str(path))
    assert expected in str(caught.value)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[model_error]\nsafety_degre = 1", "model_error.safety_degre is no metric; did you mean 'safety_degree'?"),
        ("[repeatability]\nfoo = 1", "repeatability.foo is no metric\nexpected: one of ave_dece"),
        ("[fit.weights]\ntett = 1", "fit.weights.tett is no metric; did you mean 'tet'?"),
        ("[ads.parameters]\nthrottle = [true, 0.2, 0.3]", "ads.parameters.throttle[0] = True is not of type 'number'"),
        (
            '[scenario.parameters]\nnetwork = "nope"',
            "mine.toml: scenario.parameters.network: there is no network 'nope'",
        ),
        (
            '[metrics]\nalso = ["tet"]',
            "metrics.also = ['tet']: every study has 'tet'\nexpected: one of brake_harshness",
        ),
    ],
)
def test_a_value_that_a_model_refuses_is_named(text: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(f'extends = "smoke"\n{text}\n')
    with pytest.raises(InputError) as caught:
        assemble(load_study(str(tmp_path / "mine.toml")))
    assert expected in str(caught.value)
    assert "mine.toml" in str(caught.value)


def test_all_mistakes_of_a_file_are_reported_at_once(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(
        'extends = "smoke"\nname = "mine"\n[search]\nruns = 0\npopulation = "x"\nseeds = 1\n'
        "[vehicle.characteristics.mass]\nunit = 3\n"
    )
    with pytest.raises(InputError, match="4 mistakes") as caught:
        load_study(str(path))
    for key in ("search.runs = 0", "search.population = 'x'", "search.seeds", "vehicle.characteristics.mass.unit = 3"):
        assert key in str(caught.value)


@pytest.mark.parametrize(
    ("text", "inherits"),
    [
        ('weather = "fog"', False),
        ('[ads]\nmodel = "krauss"', False),
        ("[ads.parameters]\nlatency = 0.1", True),
        ('[scenario.parameters]\nnetwork = "my_town"', False),
        ('[[matrix.tests]]\nname = "late"\n', False),
        ("[scenario.parameters]\nduration = 5.0", True),
        ("[search]\nruns = 3", True),
        ('[ads]\nmodel = "world_on_rails"', True),
    ],
)
def test_another_system_inherits_neither_title_nor_published_values(text: str, inherits: bool, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(f'extends = "sun"\n{text}\n')
    study, sun = load_study(str(tmp_path / "mine.toml")), load_study("sun")
    assert study.name == "mine", "a study without a name is called as its file"
    assert (study.title == sun.title) == inherits
    assert (study.published == sun.published) == inherits
    assert bool(study.origin.remarks) != inherits
    assert all(": has a different " in remark for remark in study.origin.remarks)
    changed = load_study("sun", weather="fog")
    assert (changed.title, changed.published) == ("sun", {})
    own = load_study("rain")
    assert own.published["safety_degree"] == 2.2
    assert not own.origin.remarks


SCHEMA = json.loads(STUDY_SCHEMA.read_text())
VALIDATOR = jsonschema.Draft7Validator(SCHEMA)
NOT_OF_FORM = (
    *("lower = ", "original = 5800.0", "original = 0", "there is no study", "nothing", "leads back", "is no FMU"),
    *("lower = 9999", "did you mean 'mass'", "up to 1e+12", "each metric once", "is not rated", "'characteristics' is"),
    "is no parameter of the study",
)
"""Mistakes that only the other keys, files or models show."""


def is_accepted(text: str) -> bool:
    """An editor has no number that is not one: it becomes null."""
    return VALIDATOR.is_valid(msgspec.json.decode(msgspec.json.encode(tomllib.loads(text))))


def test_the_shipped_schema_is_that_of_the_code_and_describes_every_key() -> None:
    assert schema_text() == STUDY_SCHEMA.read_text(encoding="utf-8")
    jsonschema.Draft7Validator.check_schema(SCHEMA)
    for table in (SCHEMA, *SCHEMA["$defs"].values()):
        assert all(key["description"] for key in table["properties"].values())
    assert "[s]" in SCHEMA["properties"]["step_length"]["description"]


@pytest.mark.parametrize("name", study_names())
def test_a_shipped_study_names_the_schema_which_accepts_it_and_all_that_it_extends(name: str, tmp_path) -> None:  # type: ignore[no-untyped-def]
    text = (STUDIES / f"{name}.toml").read_text()
    assert text.startswith(f"#:schema ./{STUDY_SCHEMA.name}\n")
    assert is_accepted(text)
    write_study(tmp_path / "whole.toml", load_study(name), "")
    whole = (tmp_path / "whole.toml").read_text()
    assert whole.startswith(f"#:schema {STUDY_SCHEMA}\n")
    assert is_accepted(whole)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        *(((STUDIES / "sun.toml").read_text().replace(old, new, 1), said) for old, new, said in REPLACEMENTS),
        *((text if text.startswith("extends") else f'extends = "smoke"\n{text}', said) for text, said in ADDITIONS),
    ],
    ids=lambda text: text[:30],
)
def test_the_schema_refuses_mistakes_of_form_and_no_others(text: str, expected: str) -> None:
    try:
        accepted = is_accepted(text)
    except tomllib.TOMLDecodeError:
        accepted = False
    said = expected.partition("\n")
    of_form = not any(part in expected for part in NOT_OF_FORM) or ".lower = '" in said[0]
    assert accepted is not of_form


ROWS = load_study("native").vehicle.characteristics


def test_a_text_replaces_a_limit_of_the_study_and_names_follow_the_study() -> None:
    stated = {"decel": Limit(at_least=5, source="workshop"), "mass": Limit(at_most=1900)}
    texts = ["decel >= 6.5", "tau<=.3", " mass >= 1.4e3", "mass <= 1800"]
    limits = limits_of(texts, ROWS, stated)
    assert list(limits) == ["mass", "decel", "tau"]
    assert limits["decel"] == Limit(at_least=6.5)
    assert limits["decel"].interval(ROWS["decel"]) == (6.5, 9.5)
    assert limits["tau"].interval(ROWS["tau"]) == (0.1, 0.3)
    assert limits["mass"].interval(ROWS["mass"]) == (1400, 1800)
    assert limits_of([], ROWS, stated) == {"mass": stated["mass"], "decel": stated["decel"]}


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ("decel", "'decel'\nexpected: \"NAME >= X\""),
        ("decel > 6", "'decel > 6'"),
        ("decel >= 6 m/s^2", "'decel >= 6 m/s^2'"),
        ("6 <= decel", "'6 <= decel'"),
        ("5 <= decel <= 6", "'5 <= decel <= 6'"),
        ("decel >= nan", "'decel >= nan'"),
        ("decel >= 1_0", "'decel >= 1_0'"),
        (">= 6", "'>= 6'"),
        ("", "''"),
        ("decl >= 6", "decl: there is no such characteristic; did you mean 'decel'?"),
        ("decel >= 6, decel >= 7", "decel >= is given twice\nexpected: each limit once"),
        ("decel >= 9, decel <= 8", "decel: at least 9 and at most 8 m/s^2\nexpected: at_least <= at_most"),
        ("decel >= 4", "decel >= 4 is outside its domain\nexpected: a number in [4.5, 9] m/s^2"),
        ("tau <= 1e999", "tau <= inf is outside its domain"),
        ("decel >= 9.2", "decel >= 9.2: the original, 9 m/s^2, does not keep it\nexpected: a number in [4.5, 9] m/s^2"),
        ("tau <= 0.15", "tau <= 0.15: the original, 0.2 s, does not keep it\nexpected: a number in [0.2, 0.6] s"),
    ],
)
def test_a_text_that_is_no_limit_is_refused(texts: str, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(f"--promise: {message}")) as caught:
        limits_of(texts.split(", "), ROWS, source="--promise")
    assert len(str(caught.value).splitlines()) <= 2


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("decl = { at_least = 6 }", "limits.decl: there is no such characteristic; did you mean 'decel'?"),
        ("decel = { source = 'x' }", "limits.decel: neither at_least nor at_most"),
        ("decel = 6", "limits.decel = 6\nexpected: a table of at_least, at_most, source"),
        ("decel = { atleast = 6 }", "limits.decel.atleast: there is no such key; did you mean 'at_least'?"),
        ("decel = { at_least = 3 }", "limits.decel.at_least = 3 is outside its domain"),
        ("decel = { at_least = 9.4 }", "limits.decel.at_least = 9.4: the original, 9 m/s^2, does not keep it"),
        ("decel = { at_least = 9, at_most = 8 }", "limits.decel: at least 9 and at most 8 m/s^2"),
        ("decel = { at_least = nan }", "limits.decel.at_least = nan"),
    ],
)
def test_a_bad_table_of_limits_is_refused(tmp_path: Path, table: str, message: str) -> None:
    (tmp_path / "mine.toml").write_text(f'extends = "native"\n[limits]\n{table}\n')
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        load_study(str(tmp_path / "mine.toml"))
    assert "mine.toml" in str(caught.value)


def test_limits_change_no_result_and_a_study_without_them_keeps_its_tables() -> None:
    study = load_study("native", limits={"decel": {"at_least": 6, "source": "workshop manual"}})
    assert evaluation_keys(study) == evaluation_keys(load_study("native"))
    assert "limits" not in tables_of(load_study("native"))
    assert load_study(tables_of(study)).limits == study.limits
