"""What a user may type wrongly, and what the command says in one or two lines before it ends with
code 2; whatever is in a study file is a study or an error of one kind, never a traceback.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings, strategies as st

from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.records import JsonObject
from safevar_sumo.study import Study, tables_of
from safevar_sumo.sumo.system import assemble
from tests.in_process import refused

FILES = {
    "file": "",
    "solutions.csv": "stored",
    "heavy.toml": 'extends = "smoke"\n[[constraints]]\nsum = { mass = 1 }\nat_least = 2500\n',
    "base.toml": 'extends = "sun"\n',
    "child.toml": 'extends = "base.toml"\nname = "child"\n',
    "mine.csv": "mass,radius\n1,2\n",
    "broken.py": "1 / 0\n",
    "twice.toml": (
        'extends = "euro_ncap_pedestrian"\nname = "twice"\n[[matrix.tests]]\nname = "near"\n'
        'model = "crossing"\nparameters = { speed = 20 }\nover = { speed = [30] }\n'
    ),
    "mine.py": "class Mine: ...\n",
    "other/manifest.json": '{"study": {}, "versions": {}, "original": {}}',
    "results/smoke/manifest.json": "{}",
}
TYPED = [
    ("study sum", "'sum'; did you mean 'sun'?"),
    ("study sun --out /proc/nowhere", "--out: cannot write to /proc/nowhere"),
    ("study smoke --out file", "--out"),
    ("study", "Missing argument 'STUDY'"),
    ("study smoke --algorithms rs,rs --dry-run", "same name"),
    ("study smoke --jobs 0", "--jobs"),
    ("study smoke --out=", "--out: ''"),
    ("study smoke --evaluations 9", "search.population = 10 is more than search.evaluations = 9"),
    ("study smoke --evaluations 99999999999999999999", "--evaluations"),
    ("study smoke --algorithms os:system", "os:system"),
    ("study smoke --algorithms mine.py:Mine", "its module: 'mine:Mine'"),
    ("study smoke --algorithms far/mine.py:Mine", "its module: 'far.mine:Mine'"),
    ("study smoke --algorithms mine.py", "package.module:Name"),
    ("study smoke --cluster nowhere", "tcp://host:8786"),
    ("study smoke --cluster tcp://127.0.0.1:9", "no scheduler answers at 'tcp://127.0.0.1:9'"),
    ("study heavy.toml", "heavy.toml: the original vehicle: violates a constraint: mass = 2404 kg"),
    ("study smoke --status --out nowhere", "nowhere: is not a results directory"),
    ("simlate rain", "did you mean 'simulate'?"),
    ("simulate rian", "did you mean 'rain'?"),
    ("simulate sun --as-it-is-now", "a study is simulated as it is now anyway"),
    ("simulate sun --set mass=5000", "[2040, 2700] kg"),
    ("simulate sun --set mass=+8", "or mass=+8% of the original, or any with --beyond"),
    ("simulate sensing --set sensorAngle=+10%", "'sensorAngle=+10%': the original is 0"),
    ("simulate sun --set weight=1", "weight"),
    (
        "simulate sun_joint --beyond --set distance=1000",
        "distance is 959.67 m longer than the lane",
    ),
    (
        "simulate sun_joint --beyond --set recognition_delay=-1",
        "a finite number from 0, up to 300 s",
    ),
    ("simulate sun --set mass=nan", "NAME=VALUE"),
    ("simulate sun --set mass=2300 --set mass=2400", "mass is set twice"),
    ("simulate sun --set mass=+50%", "mass = 3606"),
    ("simulate sun --set mass=2100..9000", "mass = 2790"),
    ("simulate sun --set mass=2100..2200:999 --set tireFric=1..2:999", "more than 10000 settings"),
    ("simulate rain --set tirefric=1", "did you mean 'tireFric'?"),
    ("simulate sun --set tireFric=1..2:1", "at least 2"),
    ("simulate sun --set mass=2100..2200 --trace x.csv", "is a sweep"),
    ("simulate sun --trace solutions.csv", "solutions.csv"),
    ("simulate sun --plot base.toml", "base.toml"),
    ("simulate sun --solution fewest", "a directory"),
    ("simulate twice.toml", "matrix.tests[0]: speed is in parameters and in over"),
    ("simulate sun --fail-if safety>1", "--fail-if: the answer has no number 'safety'"),
    ("simulate sun --fail-if drac>1", "the answer has no number 'drac'"),
    ("simulate sun --set mass=2100..2200 --fail-if sweep.mas>1", "did you mean 'sweep.mass'?"),
    ("simulate native --spread", "[spread]"),
    ("simulate sun --set tireFric=1..2 --spread", "--spread"),
    ("explain smoke --unsafe bad", "below=X"),
    ("explain smoke --solution nsga2:0:0", "has no solutions"),
    ("tolerance rain --characteristics mas", "did you mean 'mass'?"),
    ("tolerance smoke --margin -1", "a number from 0 to 100"),
    (
        "tolerance smoke --limits mas>=2100",
        "--limits: mas: there is no such characteristic; did you mean 'mass'?",
    ),
    (
        "tolerance smoke --limits mass<=2500 --characteristics radius",
        "mass does not vary with these",
    ),
    ("repair wear", "nothing is promised"),
    ("repair wear --promise treadDepth", "NAME >= X"),
    ("repair wear --promise all --change braking", "did you mean 'braking_share'?"),
    ("repair wear --promise all --margin -1", "a number from 0 to 100"),
    ("repair wear --promise all --out folder.png", "--out"),
    ("repair euro_ncap_rating --promise all", "is rated"),
    ("repair native --promise all --change headway", "no parameter 'headway'"),
    ("risk sun --confidence nan", "between 0 and 1"),
    ("risk sun --unsafe points=1", "not rated"),
    ("rating euro_ncap_rating --set treadDepth=1.6..8:3", "one value"),
    ("rating euro_ncap_rating --plot there.txt", ".png"),
    ("check mine:Nothing", "has no 'Nothing'"),
    ("check broken:Mine", "ZeroDivisionError: division by zero"),
    ("check smokee", "did you mean 'smoke'?"),
    ("tables nowhere", "nowhere: is not a results directory"),
    ("tables other", "other"),
    ("tables results/smoke --format markdown", "'latex'"),
    ("tables file --figures pictures", "file"),
    ("rating sun_joint", "searches its scenario"),
    ("broken:spread smoke", "ZeroDivisionError: division by zero"),
    ("mine:spread smoke", "has no function 'spread' with @question"),
    ("import native --out out --nsga2 mine.csv", "--original"),
    ("import lgsvl --out out --nsga2 mine.csv", "lacks the columns"),
    ("import sun --out out --nsga2 .", "Is a directory"),
    ("validate sun none.csv --jobs 1025", "a whole number from 1 to 1,024"),
    ("validate sun none.csv", "none.csv: cannot be read: No such file or directory"),
    ("evidence folder --out x.zip", "folder: is not a results directory"),
    ("evidence folder --out it.tar", ".zip"),
    ("report folder", "folder: is not a results directory"),
    ("report folder --out it.pdf", "it.pdf"),
    ("verify none.zip", "none.zip: cannot be read: No such file or directory"),
    ("export file --to carla --out x", "Missing option '--solution'"),
    ("import sun --nsga2 mine.csv", "Missing option '--out'"),
    ("import sun --out out --nsga2 mine.csv --original sd=abc", "sd=NUMBER"),
    ("list wether", "did you mean 'weathers'?"),
    ("tables results/smoke --table rq9", "there is no table 'rq9'"),
    ("check", "Missing argument 'NAME'"),
    (
        "export file --solution nsga2:0:0 --to carla --out x",
        "file: is a study and has no solutions",
    ),
    ("simulate euro_ncap_pedestrian --point CPNA", "72 points, such as CPNA, speed 10"),
]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with something wrong of every kind."""
    folder = tmp_path_factory.mktemp("bad")
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    for name in ("folder", "folder.csv", "folder.png"):
        (folder / name).mkdir()
    (folder / "__pycache__").mkdir()
    return folder


@pytest.mark.parametrize(("typed", "told"), TYPED, ids=[typed for typed, _ in TYPED])
def test_bad_input_ends_with_code_2_and_changes_no_file(
    typed: str, told: str, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(place)
    monkeypatch.setattr("safevar_sumo.campaign.cluster.CONNECT_TIMEOUT", 0.5)
    before = sorted(place.glob("[!_]*/*")), sorted(place.iterdir())
    refused(*typed.split(), message=(told,))
    assert (sorted(place.glob("[!_]*/*")), sorted(place.iterdir())) == before
    assert Path("solutions.csv").read_text() == "stored"


TABLES = tables_of(load_study("smoke"))
SCALARS = st.one_of(
    st.integers(),
    st.floats(),
    st.text(max_size=20),
    st.booleans(),
    st.dates(),
    st.datetimes(),
    st.times(),
)
ANYTHING = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=6,
)


def paths(tables: JsonObject, before: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Every key of nested tables."""
    inner = [
        path
        for key, value in tables.items()
        if isinstance(value, dict)
        for path in paths(value, (*before, key))
    ]
    return [*((*before, key) for key in tables), *inner]


def replaced(tables: JsonObject, path: tuple[str, ...], value: object) -> JsonObject:
    key, *rest = path
    return {**tables, key: value if not rest else replaced(tables[key], tuple(rest), value)}


@pytest.mark.slow
@settings(max_examples=60, suppress_health_check=list(HealthCheck))
@given(path=st.sampled_from(paths(TABLES)), value=ANYTHING)
def test_a_study_with_anything_in_one_place_is_read_or_refused(
    path: tuple[str, ...], value: object
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "mine.toml"
        try:
            file.write_text(tomli_w.dumps(replaced(TABLES, path, value)), encoding="utf-8")
        except (ValueError, UnicodeError):
            return
        try:
            study = load_study(str(file))
            assemble(study)
        except InputError:
            return
        assert isinstance(study, Study)
        numbers = list(study.vehicle.characteristics.values())
        assert all(math.isfinite(row.original) and row.lower < row.upper for row in numbers)
