"""Study files are read strictly, limits too: every error names file, key, value and the expected
values; and the shipped JSON schema, as an editor uses it.
"""

from __future__ import annotations

import json
import pickle
import re
import shutil
import tomllib
import warnings
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import pytest

from safevar_sumo.api.running import load_for_search
from safevar_sumo.errors import InputError
from safevar_sumo.questions.variation import VariationModel
from safevar_sumo.results.identity import evaluation_keys
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.shipped import STUDIES, STUDY_SCHEMA
from safevar_sumo.study import Limit, Origin, Study, limits_of, study_names, tables_of, write_study
from safevar_sumo.study.file_schema import schema_text
from safevar_sumo.sumo.system import assemble
from tests.manual import ROOT

SUN = read_study("sun").vehicle.characteristics
ALL_FIXED = "".join(
    f"[[constraints]]\nsum = {{ {name} = 1 }}\nat_least = {row.original}\nat_most ="
    f" {row.original}\n"
    for name, row in SUN.items()
)
MISTAKES = [
    ("[[constraints]]\nat_least = 2", "constraints[0]: sum is missing"),
    ("[metrics]\nttc_threshold = '1.5'", "metrics.ttc_threshold = '1.5'"),
    (
        "[vehicle.characteristics.max_rpm]\noriginal = nan",
        "vehicle.characteristics.max_rpm.original = nan",
    ),
    ("[ads", "cannot be read as TOML"),
    (
        f"files = {3000 * '['}{3000 * ']'}",
        "cannot be read as TOML: maximum recursion depth exceeded",
    ),
    ('name = "../sun"', "name = '../sun'\nexpected: letters, digits, _, . and -"),
    ('title = "x"', "name is missing"),
    (
        "[variation.mass]\ndistribution = 'normal'\ndeviation = 1e300",
        "variation.mass.deviation = 1e+300\nexpected: a number <= 1000000",
    ),
    ('[spread]\n"ads.parameters.brake_gap" = ["a"]', "spread.'ads.parameters.brake_gap'[0] = 'a'"),
    ("[repair.brake_gap]\nlow = 1", "repair.parameters.brake_gap.low: there is no such key"),
    ("seed = 3", "seed: there is no such key; did you mean 'search.seed'?"),
    ("margin = 3", "margin: there is no such key; did you mean 'scenario.margin'?"),
    (
        "[search]\nevaluatons = 5",
        "search.evaluatons: there is no such key; did you mean 'evaluations'?",
    ),
    ("evaluatons = 5", "evaluatons: there is no such key; did you mean 'search.evaluations'?"),
    (
        '[weather]\nname = "x"\nroad_friction = 0\nvisibility = 1',
        "weather.road_friction = 0\nexpected: a number > 0",
    ),
    ("zzz = 1", "zzz: there is no such key\nexpected: one of ads, constraints"),
    ("[vehicle]\ncharacteristics = 3", "vehicle.characteristics = 3\nexpected: a table"),
    ('[ads]\nkind = "fmuu"', "ads.kind = 'fmuu'; did you mean 'fmu'?\nexpected: one of fmu, traci"),
    (
        '[variation.mass]\ndistribution = "norml"',
        (
            "variation.mass.distribution = 'norml'; did you mean 'normal'?\nexpected: one of fixed,"
            " lognormal"
        ),
    ),
    (
        'extends = "native"\n[limits]\ndecel = { atleast = 6 }',
        "limits.decel.atleast: there is no such key; did you mean 'at_least'?",
    ),
    (
        "[[constraints]]\nsum = { mass = 1 }\nupper = 1",
        "constraints[0].upper: there is no such key\nexpected: one of at_least",
    ),
    ('[[correlations]]\nbetween = ["mass", "radius"]\nvalue = 1.5', "correlations"),
    ('extends = "euro_ncap_rating"\n[matrix]\nprotocol = "euro_ncap_2023"', "protocol"),
    (
        "[vehicle.characteristics.max_rpm]\nlower = 7000\nupper = 4200",
        "vehicle.characteristics.max_rpm: lower = 7000.0 and upper = 4200.0",
    ),
    (
        "[vehicle.characteristics.max_rpm]\nlower = 5900",
        "vehicle.characteristics.max_rpm: original = 5800.0",
    ),
    (
        "[vehicle.characteristics.dampRateFullT]\noriginal = 0\nlower = -1",
        "vehicle.characteristics.dampRateFullT: original = 0",
    ),
    ('extends = "nothing"', "nothing"),
    ('extends = "."', "extends = '.': '.' is a directory"),
    ('extends = "sun"\n[search]\nobjectives = ["f_safe", "f_safe"]', "'f_safe' is given twice"),
    ("[variation.mass]\ndistribution = 'uniform'\nlower = 9999", "variation.mass.lower = 9999"),
    (
        "[vehicle.characteristics.masss]\noriginal = 9",
        "vehicle.characteristics.masss: unit is missing; did you mean 'mass'?",
    ),
    (
        "[vehicle.characteristics.brakes]\noriginal = 9",
        (
            "brakes: unit is missing\nexpected: unit, original, lower, upper for what is new here;"
            " else "
        ),
    ),
    ("[vehicle.characteristics.mass]\nupper = 1e300", "1e+300]\nexpected: numbers up to 1e+12"),
    (
        '[metrics]\nalso = ["max_jerk", "max_jerk"]',
        "metrics: also = ['max_jerk', 'max_jerk']\nexpected: each metric once",
    ),
    (
        '[rating.claims]\nCCRs = ["glare"]',
        "rating.claims: the study is not rated\nexpected: matrix.protocol",
    ),
    (
        '[vehicle]\nmodel = "tesla"',
        "vehicle.model = 'tesla' has no characteristics: vehicle.characteristics is missing",
    ),
    ('[vehicle]\nmodel = "carl"', "vehicle.characteristics is missing; did you mean 'carla'?"),
    (
        "colour = 1",
        (
            "colour: there is no such key\nexpected: one of ads, constraints, correlations, limits,"
            " matrix"
        ),
    ),
    ("colour = 1", "name, published"),
    ('extends = "mine.toml"', "extends = 'mine.toml' leads back to "),
    ('[scenario]\nkind = "fmu"', "scenario.kind = 'fmu'\nexpected: no kind"),
    (
        '[spread]\n"ads.parameters.brake_gapp" = [1]',
        "spread.'ads.parameters.brake_gapp' is no parameter of the study",
    ),
    (
        "[model_error]\nsafety_degre = 1",
        "model_error.safety_degre is no metric; did you mean 'safety_degree'?",
    ),
    ("[repeatability]\nfoo = 1", "repeatability.foo is no metric\nexpected: one of ave_dece"),
    ('weather = "fogg"', "did you mean 'fog'?"),
    ('[ads]\nmodel = "world_on_rail"', "did you mean 'world_on_rails'?"),
    ("[ads.parameters]\nnothing = 3", "mine.toml: ads.parameters.nothing: there is no such key"),
    (
        '[scenario.parameters]\nnetwork = "nope"',
        "mine.toml: scenario.parameters.network: there is no network 'nope'",
    ),
    (
        '[metrics]\nalso = ["tet"]',
        "metrics.also = ['tet']: every study has 'tet'\nexpected: one of brake_harshness",
    ),
    (
        'extends = "native"\n[limits]\ndecl = { at_least = 6 }',
        "limits.decl: there is no such characteristic; did you mean 'decel'?",
    ),
    (
        "extends = \"native\"\n[limits]\ndecel = { source = 'x' }",
        "limits.decel: neither at_least nor at_most",
    ),
    (
        'extends = "native"\n[limits]\ndecel = { at_least = 3 }',
        "limits.decel.at_least = 3 is outside its domain",
    ),
    (
        'extends = "native"\n[limits]\ndecel = { at_least = 9.4 }',
        "limits.decel.at_least = 9.4: the original, 9 m/s^2, does not keep it",
    ),
    (
        'extends = "native"\n[limits]\ndecel = { at_least = 9, at_most = 8 }',
        "limits.decel: at_least = 9 and at_most = 8",
    ),
    (
        "[[constraints]]\nsum = { mass = 1 }\nat_least = 2500",
        "the original vehicle: violates a constraint: mass = 2404 kg (mass = 2404 kg)",
    ),
    (
        "[[constraints]]\nsum = { mass = 1, maxBrakeTorque = -1 }\nunit = 'kg'\nat_most = 900",
        (
            "mass - maxBrakeTorque = 904 kg (mass = 2404 kg, maxBrakeTorque = 1500 N m)\nexpected:"
            " at most 900 kg"
        ),
    ),
    (
        (
            "[[constraints]]\nsum = { mass = 1 }\nat_least = 2404\n"
            "[[constraints]]\nsum = { mass = 2, tireFric = 1 }\nunit = 'kg'\nat_most = 4800"
        ),
        "the original vehicle: violates a constraint: 2 mass + tireFric = 4811.5 kg",
    ),
    (ALL_FIXED, "fewer than 2 in 1,000 random settings satisfy them"),
    (
        (
            "[[constraints]]\nsum = { mass = 1, maxBrakeTorque = -1 }\nunit = 'kg'\nat_least ="
            " 904\nat_most = 904"
        ),
        "fewer than 2 in 1,000 random settings satisfy them: mass - maxBrakeTorque",
    ),
    (
        "[[constraints]]\nsum = { mas = 1 }\nat_least = 1",
        "constraints[0].sum.mas: there is no such characteristic; did you mean 'mass'?",
    ),
    (
        "[[constraints]]\nsum = { mass = 1 }\nat_least = 1\nunit = 't'",
        "constraints[0]: unit = 't' for the sum of mass [kg]\nexpected: one of -, kg",
    ),
    (
        "[[constraints]]\nsum = { mass = 1, radius = 1 }\nat_least = 1",
        "constraints[0]: unit = None for the sum of mass [kg], radius [cm]",
    ),
    ("[[constraints]]\nsum = { mass = 1 }", "neither at_least nor at_most"),
    (
        "[[constraints]]\nsum = { mass = 1 }\nat_least = 2\nat_most = 1",
        "at_least = 2 and at_most = 1",
    ),
    ("[variation.wings]\ndistribution = 'fixed'", "variation.wings"),
    ('extends = "euro_ncap_rating"\n[rating.claims]\nCCRx = ["Type"]', "CCRx"),
    (
        "[variation.mass]\ndistribution = 'normal'\ndeviation = 1\nmean = 9999",
        "variation.mass.mean = 9999",
    ),
    (
        "[variation.mass]\ndistribution = 'uniform'\nlower = 2600\nupper = 2100",
        "lower = 2600 and upper = 2100",
    ),
    (
        "[variation.mass]\ndistribution = 'triangular'\nlower = 2100\nmode = 2050",
        "variation.mass.mode = 2050",
    ),
    ('[[correlations]]\nbetween = ["mass", "wings"]\nvalue = 0.5', "'wings'"),
    (
        '[[correlations]]\nbetween = ["mass", "mass"]\nvalue = 0.5',
        "two characteristics, each pair once",
    ),
    (
        (
            '[[correlations]]\nbetween = ["mass", "radius"]\nvalue = 0.5\n'
            '[[correlations]]\nbetween = ["mass", "radius"]\nvalue = 0.5'
        ),
        "two characteristics, each pair once",
    ),
    (
        (
            "[[correlations]]\nbetween = ['mass', 'radius']\nvalue = -0.9\n"
            "[[correlations]]\nbetween = ['mass', 'tireFric']\nvalue = -0.9\n"
            "[[correlations]]\nbetween = ['radius', 'tireFric']\nvalue = -0.9"
        ),
        "contradict each other",
    ),
    ('extends = "euro_ncap_rating"\n[rating.claims]\nCCRs = ["Typo"]', "Typo"),
    (
        'extends = "euro_ncap_rating"\n[rating.claims]\nCCRs = ["Trajectory/Heading"]',
        "is simulated",
    ),
    (
        '[matrix]\naggregate = "worst"',
        "matrix: 0 tests and protocol = ''\nexpected: tests, or a protocol",
    ),
    ("[search.nsga2]\ntournament_size = 1", "search.nsga2.tournament_size = 1"),
    ("[search.nsga2]\ntournament_sizes = 7", "did you mean 'tournament_size'?"),
    ("[search.nsga]\ntournament_size = 7", "did you mean 'nsga2'?"),
    (
        (
            'extends = "euro_ncap_pedestrian"\n[[matrix.tests]]\nname = "x"\n[[matrix.tests]]\nname'
            ' = "x"'
        ),
        "2 points are 'x",
    ),
    (
        'extends = "euro_ncap_pedestrian"\n[[matrix.tests]]\nname = "x"\nover = { spede = [1] }',
        "spede",
    ),
    (
        'extends = "euro_ncap_pedestrian"\n[[matrix.tests]]\nname = "x"\nover = { speed = [-1] }',
        "speed",
    ),
    (
        'extends = "euro_ncap_pedestrian"\n[[matrix.tests]]\nname = "x"\nweathers = ["sunny"]',
        "sunny",
    ),
]
"""A text in a study that extends `smoke`, or a whole one, and what the error says."""
VALIDATOR = jsonschema.Draft7Validator(json.loads(STUDY_SCHEMA.read_text()))


def is_accepted(text: str) -> bool:
    """An editor has no number that is not one: it becomes null."""
    return VALIDATOR.is_valid(msgspec.json.decode(msgspec.json.encode(tomllib.loads(text))))


@pytest.mark.parametrize(("text", "told"), MISTAKES, ids=lambda text: text[:40])
def test_the_first_mistake_is_told_with_file_key_and_value(
    text: str, told: str, in_tmp: Path
) -> None:
    whole = text if text.startswith(("extends", "title")) else f'extends = "smoke"\n{text}\n'
    Path("mine.toml").write_text(whole)
    with pytest.raises(InputError) as caught:
        VariationModel(load_for_search("mine.toml")[0])
    message = str(caught.value)
    assert told in message
    assert "mine.toml" in message
    assert len(message) < 1000
    assert len(message.splitlines()) <= 2


def with_remarks(study: str, **changes: Any) -> tuple[Study, list[str]]:
    """A study, and what reading it warns of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        return read_study(study, **changes), [str(one.message) for one in caught]


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
def test_another_system_inherits_neither_title_nor_published_values(
    text: str, inherits: bool, tmp_path: Path
) -> None:
    (tmp_path / "mine.toml").write_text(f'extends = "sun"\n{text}\n')
    study, remarks = with_remarks(str(tmp_path / "mine.toml"))
    sun = read_study("sun")
    assert study.name == "mine", "a study without a name is called as its file"
    assert (study.title == sun.title) == inherits
    assert (study.published == sun.published) == inherits
    assert bool(remarks) != inherits
    assert all(": has a different " in remark for remark in remarks)


def test_a_study_without_a_title_is_called_as_itself_and_never_as_the_study_that_it_extends(
    in_tmp: Path,
) -> None:
    Path("mine.toml").write_text('extends = "sun"\n[ads]\nmodel = "krauss"\n')
    Path("metric.toml").write_text('extends = "mine.toml"\nname = "own"\n')
    Path("rash.toml").write_text('extends = "metric.toml"\n')
    Path("headed.toml").write_text('extends = "metric.toml"\ntitle = "A heading"\n')
    Path("heir.toml").write_text('extends = "headed.toml"\n')
    titles = [
        read_study(f"{name}.toml").title for name in ("mine", "metric", "rash", "headed", "heir")
    ]
    assert titles == ["mine", "own", "rash", "A heading", "A heading"]


def test_the_shipped_schema_is_that_of_the_code_and_refuses_mistakes_of_form() -> None:
    assert schema_text() == STUDY_SCHEMA.read_text(encoding="utf-8")
    VALIDATOR.check_schema(VALIDATOR.schema)
    for text in (
        "evaluatons = 5",
        '[search]\nruns = "x"',
        "[search]\nruns = 0",
        "[repair.brake_gap]\nlow = 1",
    ):
        assert not is_accepted(text), text


@pytest.mark.parametrize("name", study_names())
def test_a_shipped_study_names_the_schema_which_accepts_it_and_all_that_it_extends(
    name: str, tmp_path
) -> None:  # type: ignore[no-untyped-def]
    text = (STUDIES / f"{name}.toml").read_text()
    assert text.startswith(f"#:schema ./{STUDY_SCHEMA.name}\n")
    assert is_accepted(text)
    write_study(tmp_path / "whole.toml", read_study(name), "")
    whole = (tmp_path / "whole.toml").read_text()
    assert whole.startswith(f"#:schema {STUDY_SCHEMA}\n")
    assert is_accepted(whole)


ROWS = read_study("native").vehicle.characteristics


def test_a_text_replaces_a_limit_of_the_study_and_names_follow_the_study() -> None:
    stated = {"decel": Limit(at_least=5, source="workshop"), "mass": Limit(at_most=1900)}
    texts = ["decel >= 6.5", "actuatorLag<=.3", " mass >= 1.4e3", "mass <= 1800"]
    limits = limits_of(texts, ROWS, stated)
    assert list(limits) == ["mass", "decel", "actuatorLag"]
    assert limits["decel"] == Limit(at_least=6.5)
    assert limits["decel"].interval(ROWS["decel"]) == (6.5, 9.5)
    assert limits["actuatorLag"].interval(ROWS["actuatorLag"]) == (0.1, 0.3)
    assert limits["mass"].interval(ROWS["mass"]) == (1400, 1800)
    assert limits_of([], ROWS, stated) == {"mass": stated["mass"], "decel": stated["decel"]}


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ("decel", "'decel'\nexpected: \"NAME >= X\""),
        ("decel > 6", "'decel > 6'"),
        ("decel >= 6 m/s^2", "'decel >= 6 m/s^2'"),
        ("6 <= decel", "'6 <= decel'"),
        ("decel >= nan", "'decel >= nan'"),
        ("", "''"),
        ("decl >= 6", "decl: there is no such characteristic; did you mean 'decel'?"),
        ("decel >= 6, decel >= 7", "decel >= is given twice\nexpected: each limit once"),
        (
            "decel >= 4",
            "decel.at_least = 4 is outside its domain\nexpected: a number in [4.5, 9] m/s^2",
        ),
        ("actuatorLag <= 1e999", "actuatorLag.at_most = inf is outside its domain"),
        (
            "actuatorLag <= 0.15",
            (
                "actuatorLag.at_most = 0.15: the original, 0.2 s, does not keep it\nexpected: a"
                " number in [0.2, 0.6] s"
            ),
        ),
    ],
)
def test_a_text_that_is_no_limit_is_refused(texts: str, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        limits_of(texts.split(", "), ROWS)
    assert len(str(caught.value).splitlines()) <= 2


@pytest.mark.parametrize("name", study_names())
def test_a_study_that_another_process_received_has_the_same_tables(name: str) -> None:
    study = read_study(
        name, variation={next(iter(read_study(name).domains)): {"distribution": "triangular"}}
    )
    assert json.loads(json.dumps(tables_of(study))) == tables_of(study)
    assert tables_of(pickle.loads(pickle.dumps(study))) == tables_of(study)
    assert read_study(tables_of(study)) == msgspec.structs.replace(study, origin=Origin())


def test_limits_change_no_result_and_a_study_without_them_keeps_its_tables() -> None:
    study = read_study("native", limits={"decel": {"at_least": 6, "source": "workshop manual"}})
    assert evaluation_keys(tables_of(study)) == evaluation_keys(tables_of(read_study("native")))
    assert "limits" not in tables_of(read_study("native"))
    assert read_study(tables_of(study)).limits == study.limits


def test_a_study_drops_the_matrix_of_the_study_that_it_extends() -> None:
    scenario = {"model": "crossing", "parameters": {"test": "CPNA", "speed": 30}}
    study = read_study(
        {"extends": "wear", "name": "mine", "scenario": scenario, "matrix": {"tests": []}}
    )
    assert study.matrix is None
    assert [point.scenario.test for point in assemble(study).points] == ["CPNA"]
    assert read_study(tables_of(study)).matrix is None


@pytest.mark.parametrize(
    "scenario", [{"model": "mine:Deer"}, {"model": "along"}, {"file": "scenario.xosc"}]
)
def test_a_study_of_another_scenario_does_not_inherit_a_matrix_and_says_so(
    scenario: dict[str, str], in_tmp: Path
) -> None:
    shutil.copy(
        ROOT / "tests" / "openscenario" / "files" / "crossing_pedestrian.xosc", "scenario.xosc"
    )
    ((key, value),) = scenario.items()
    Path("mine.toml").write_text(f'extends = "wear"\n[scenario]\n{key} = "{value}"\n')
    study, remarks = with_remarks("mine.toml")
    assert study.matrix is None
    assert remarks == ["mine.toml: has a different scenario than 'wear', so not its [matrix]"]
    own, remarks = with_remarks("wear", scenario=scenario, matrix={"tests": [{"name": "own"}]})
    assert own.matrix is not None
    assert ([test.name for test in own.matrix.tests], remarks) == (["own"], [])
    same, remarks = with_remarks(
        "wear", scenario={"model": "crossing", "parameters": {"speed": 30}}
    )
    assert (same.matrix, remarks) == (read_study("wear").matrix, [])


def test_a_study_of_another_driving_system_says_all_that_it_does_not_inherit() -> None:
    study, remarks = with_remarks("wear", ads={"model": "krauss"})
    assert study.spread == {}
    assert len(remarks) == 1
    assert remarks[0].endswith("has a different ADS than 'wear', so not its [spread]")
    assert with_remarks("wear_joint")[1] == [], "a shipped study leaves keys out on purpose"


def test_an_unknown_study_is_refused_with_the_path_first() -> None:
    with pytest.raises(
        InputError,
        match=r"'nativ'; did you mean 'native'\?\nexpected: the path of a study file \(TOML\), or",
    ):
        read_study("nativ")
