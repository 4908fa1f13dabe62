"""What is shipped has no privilege: its source in a user's file gives the same results, to the
bit.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.testing import assert_array_equal

from safevar_sumo.ads import ADS
from safevar_sumo.api.simulation import load_study
from safevar_sumo.check import trials
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS, OPTIONAL_METRICS
from safevar_sumo.questions.repair.price import benign_scenes
from safevar_sumo.records import Evaluations
from safevar_sumo.results import load_runs
from safevar_sumo.scenarios import SCENARIOS
from safevar_sumo.search import ALGORITHMS
from safevar_sumo.study import Study, free_parameters
from safevar_sumo.sumo.batch import drive_all
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import VEHICLES
from tests.support.in_process import SLOW, searched, write
from tests.support.made_up import assert_same_results, drawn, system_of
from tools.manual import ROOT

BASES = {"pedestrian_crossing": "sun", "lead_vehicle_stopped": "native", "stop": "stop"}
"""A study with each scenario; all others are driven by the car of `wear`."""
FAST = ("crossing", "stop", "carla", "aeb", "fuzzy", "nsga2")
"""Those that are copied in every run of the tests; all others are slow together."""


def each(names: Iterable[str], *others: str) -> list[Any]:
    return [
        pytest.param(name, *others, marks=() if name in FAST else SLOW)
        for name in names
    ]


def copied(model: Any, folder: Path) -> str:
    """The name of a class in a copy of its source, in a user's folder."""
    source = Path(inspect.getfile(model)).read_text()
    (folder / f"copy_of_{model.__name__.lower()}.py").write_text(source)
    return f"copy_of_{model.__name__.lower()}:{model.__name__}"


def results_of(study: Study) -> Evaluations:
    system = system_of(study)
    return drive_and_score(system, drawn(system, 8, 2))


def assert_equal(ours: Study, theirs: Study) -> None:
    assert_same_results(results_of(ours), results_of(theirs))


def with_scenario(name: str, model: str, **tables: Any) -> Study:
    """A study of one scenario, and the same of its copy."""
    study = load_study(
        BASES.get(name, "wear"), scenario={"model": name}, **{"matrix": None, **tables}
    )
    return replace(study, scenario=replace(study.scenario, model=model))


@pytest.mark.parametrize("name", each(sorted(SCENARIOS.keys() - {"recorded_tracks"})))
def test_a_scenario_in_a_users_file_is_the_same_alone_in_a_matrix_and_searched(
    name: str, in_tmp: Path
) -> None:
    own = copied(SCENARIOS[name], in_tmp)
    free = free_parameters(SCENARIOS[name])
    assert_equal(with_scenario(name, name), with_scenario(name, own))
    if not free:
        return
    key, one = next(iter(free.items()))
    middle = (one.lower + one.upper) / 2
    matrix = {"tests": [{"name": "it", "over": {key: [one.lower, middle]}}]}
    assert_equal(
        with_scenario(name, name, matrix=matrix),
        with_scenario(name, own, matrix=matrix),
    )
    over = {
        key: {
            "lower": middle,
            "upper": one.upper,
            "original": one.upper,
            "unit": one.unit,
        }
    }
    base = load_study(
        BASES.get(name, "wear"),
        matrix=None,
        scenario={"model": name, "over": over},
        encounters="ranges",
    )
    assert_equal(base, replace(base, scenario=replace(base.scenario, model=own)))


DEER = """
from typing import Annotated
from msgspec import Meta, Struct


class Deer(Struct):
    speed: Annotated[float, Meta(ge=20, le=60, description="speed", extra={"unit": "km/h"})] = 40.0

    def tracks(self, times):
        return []
"""


def test_what_a_search_leaves_out_is_what_a_class_declares_a_shipped_one_as_a_users(
    in_tmp: Path,
) -> None:
    """The original is the class's default; in a matrix the class may be that of a test."""
    write("deer.py", DEER)
    for model in ("crossing", copied(SCENARIOS["crossing"], in_tmp), "deer:Deer"):
        domain = ("km/h", 40, *((20, 60) if model == "deer:Deer" else (10, 80)))
        over = {"speed": {}, "visibility": {"lower": 0.5}}
        for tables in (
            {"scenario": {"model": model, "over": over}, "matrix": None},
            {
                "scenario": {"over": over},
                "matrix": {"tests": [{"name": "it", "model": model}]},
            },
        ):
            found = load_study("wear", **tables, encounters="ranges").ranges
            speed = found["speed"]
            assert (speed.unit, speed.original, speed.lower, speed.upper) == domain, (
                model
            )
            assert (found["visibility"].lower, found["visibility"].upper) == (0.5, 1.5)
    with pytest.raises(
        InputError,
        match=r"scenario\.over\.pace: no scenario or weather declares a range of pace",
    ):
        load_study(
            "wear", matrix=None, scenario={"model": "deer:Deer", "over": {"pace": {}}}
        )


@pytest.mark.parametrize(
    "name", sorted(SCENARIOS.keys() - {"recorded_tracks", "stop"})
)  # which have no such scenes
def test_benign_scenes_of_a_scenario_in_a_users_file_are_the_same(
    name: str, in_tmp: Path
) -> None:
    names = []
    for model in (name, copied(SCENARIOS[name], in_tmp)):
        study = with_scenario(name, model)
        names.append([point.name for point in benign_scenes(study, assemble(study))])
    assert names[0] == names[1] != []


@pytest.mark.parametrize(
    ("name", "table"), [*each(VEHICLES, "vehicle"), *each(ADS, "ads")]
)
def test_a_vehicle_and_a_driving_system_in_a_users_file_are_the_same(
    name: str, table: str, in_tmp: Path
) -> None:
    base = next(
        (
            one
            for one in ("sun", "lgsvl", "native", "wear")
            if getattr(load_study(one), table).model == name
        ),
        None,
    )
    ours = load_study(
        base or "wear", matrix=None, **{} if base else {table: {"model": name}}
    )
    own = replace(getattr(ours, table), model=copied({**VEHICLES, **ADS}[name], in_tmp))
    assert_equal(ours, replace(ours, **{table: own}))


def assert_same_solutions(ours: Study, theirs: Study, folder: Path) -> None:
    """Searches of both find the same solutions; the name of a copied algorithm is another one."""
    tables = [
        load_runs(searched(study, folder / f"results{number}"))
        .solutions.drop(columns=["algorithm", "handle"], errors="ignore")
        .to_csv(index=False)
        for number, study in enumerate((ours, theirs))
    ]
    assert tables[0] == tables[1]


def short(study: str, algorithm: str) -> Study:
    """A study with a short search by one algorithm."""
    search = {"algorithms": [algorithm], "runs": 1, "population": 10, "evaluations": 40}
    return load_study(study, search=search)


@SLOW
@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_search_by_an_algorithm_in_a_users_file_finds_the_same_solutions(
    name: str, in_tmp: Path
) -> None:
    """Random numbers go with an algorithm's name, so the copy has it, too."""
    module, _, class_ = copied(ALGORITHMS[name], in_tmp).partition(":")
    write("named.py", f"from {module} import {class_}\n\n{name} = {class_}\n")
    assert_same_solutions(short("smoke", name), short("smoke", f"named:{name}"), in_tmp)


COPIES = """
from msgspec.structs import replace
from safevar_sumo.metrics import Measure

known = [one for one in list(globals().values()) if isinstance(one, Measure)]
globals().update({one.name: replace(one, name="own_" + one.name) for one in known})


def largest(settings, characteristics):
    return characteristics.largest_change(settings)


own_f_diff = Measure(
    name="own_f_diff", title="largest", unit="-", of="settings", function=largest
)
"""
"""Below the import of copied metrics: their copies have other names, as a column has one."""


def test_metrics_and_objectives_in_a_users_file_are_the_same(in_tmp: Path) -> None:
    shipped = {**METRICS, **OPTIONAL_METRICS}
    own_functions = [inspect.unwrap(one.function) for one in shipped.values()]
    functions = {inspect.getfile(one): one for one in own_functions}
    imports = ""
    for function in functions.values():
        module, _, _ = copied(function, in_tmp).partition(":")
        imports += f"from {module} import *\n"
    write("named.py", imports + COPIES)
    own = [f"named:{name}" for name in shipped]
    objectives = ["named:tit", "f_safe", "named:own_f_diff"]
    system = system_of(
        "smoke",
        metrics={"also": [*OPTIONAL_METRICS, *own]},
        search={"objectives": objectives},
    )
    found = drive_and_score(system, drawn(system, 8, 2))
    for name in shipped:
        assert_array_equal(
            found.column(f"own_{name}"), found.column(name), err_msg=name
        )
    assert_array_equal(found.column("own_f_diff"), found.f_diff)
    values = system.measuring.scoring.values(found)
    assert_array_equal(
        values, np.stack([-found.column("tit"), found.f_safe, found.f_diff], axis=1)
    )
    runs = drive_all(system, drawn(system, 8, 2))
    assert not [*trials.find_unstated_needs(system, runs)]


def test_no_module_asks_whether_something_is_a_shipped_class_of_another_one() -> None:
    shipped = {
        model.__name__: Path(inspect.getfile(model))
        for family in (SCENARIOS, VEHICLES, ADS, ALGORITHMS)
        for model in family.values()
    }
    questions = re.compile(
        rf"is(?:instance|subclass)\([^:]*?, [^:]*?\b({'|'.join(shipped)})\b"
    )
    assert questions.findall("isinstance(scenario, Crossing | Stop)"), (
        "what is looked for"
    )
    files = {
        file: questions.findall(file.read_text())
        for file in (ROOT / "safevar_sumo").rglob("*.py")
    }
    asked = [(file, name) for file, names in files.items() for name in names]
    assert [(file, name) for file, name in asked if shipped[name] != file] == []
