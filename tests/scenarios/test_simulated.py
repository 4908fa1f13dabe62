"""A simulator of the user's own: what it returns is checked, its runs are measured as SUMO's are,
and what it cannot do is refused.
"""

from __future__ import annotations

import os
import re
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock
from zipfile import ZipFile

import numpy as np
import pytest
import scipy
from numpy.testing import assert_array_equal

import safevar_sumo as sv
from safevar_sumo.campaign.cache import Cache, keep_simulations
from safevar_sumo.campaign.inputs import manifest_now
from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.metrics import METRICS, Unsafe
from safevar_sumo.plugins.process import this_process
from safevar_sumo.questions.evaluator import open_evaluator
from safevar_sumo.records import Evaluations
from safevar_sumo.results import manifest_differences
from safevar_sumo.study import tables_of
from safevar_sumo.sumo import kept, simulators
from safevar_sumo.sumo.matrix import drive_and_score, simulate_all_points
from safevar_sumo.sumo.simulators import joined
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.sumo.without_effect import without_effect
from tests.support.in_process import (
    SLOW,
    InlinePool,
    json_of,
    numbers_of,
    refused,
    rewrite,
    rows_of,
    run,
    run_python,
    write,
)
from tests.support.made_up import assert_same_results, made_up_evaluations, system_of
from tests.support.wall import MODELS, STUDY


@pytest.fixture
def wall(in_tmp: Path) -> Iterator[Path]:
    write("models.py", MODELS)
    write("wall.toml", STUDY)
    yield in_tmp / "wall.toml"
    kept.close_simulator()


def choose(model: str, code: str = "", more: str = "", end: str = "") -> None:
    """Let the study simulate another class, whose module has the code, if any is given. The table
    of the scenario has `more`, and the file has another end.
    """
    study = STUDY.replace('"models:Wall"', f'"{model}"\n{more}')
    write("wall.toml", f"{study}{end}")
    if code:
        write(f"{model.partition(':')[0]}.py", code)


def wrong_system(study: Path, change: str, **changes: object) -> System:
    """The system of a simulator whose results are changed."""
    (study.parent / "models.py").write_text(MODELS.replace("CHANGE", change))
    return system_of(study, scenario={"model": "models:Wrong"}, **changes)


def test_runs_with_a_trace_are_measured_as_those_of_sumo(wall: Path) -> None:
    system = system_of(wall)
    found = drive_and_score(system, np.array([[8.0, 0.0], [3.0, 1.0], [4.0, 0.0]]))
    braking = 15 / 8
    assert found.outcome.tolist()[:2] == ["stopped", "collision"]
    assert found.f_safe[0] == pytest.approx(40 - 15 * (0.5 + braking / 2), abs=0.55)
    assert found.f_safe[1] == -found.collision_speed[1]
    assert found.collision_speed[1] == pytest.approx(
        (15**2 - 2 * 3 * 17.5) ** 0.5, abs=0.2
    )
    assert found.metrics["ave_dece"][0] == pytest.approx(8, abs=0.3)
    runs = simulators.simulate_each(system, np.array([[4.0, 0.0]]))
    ttc = runs.trace.gap[:, 0] / np.maximum(runs.trace.speed[:, 0], 1e-9)
    exposed = np.count_nonzero(ttc[runs.trace.speed[:, 0] > 0] <= 1.5) * 0.05
    assert found.metrics["tet"][2] == pytest.approx(exposed, abs=0.05)


def test_metrics_that_a_trace_does_not_define_are_undefined(wall: Path) -> None:
    change = "lambda r: {k: r[k] for k in ('time', 'speed', 'separation', 'outcome')}"
    found = drive_and_score(wrong_system(wall, change), np.array([[8.0, 0.0]]))
    assert np.isnan(
        [found.metrics[name][0] for name in METRICS if name != "safety_degree"]
    ).all()
    assert found.f_safe[0] > 0


NEEDS_GAP = """
from safevar_sumo.metrics import Measure


def first(runs, thresholds):
    assert (runs.trace.gap > -1).all()
    return runs.trace.gap[0]


FIRST = Measure(name="first", title="first", unit="m", function=first, needs=("gap",))
"""


def test_a_metric_gets_the_runs_alone_that_have_what_it_needs(wall: Path) -> None:
    write("needing.py", NEEDS_GAP)
    change = "lambda r: r if r['time'][-1] > 3 else {k: r[k] for k in r if k != 'gap'}"
    system = wrong_system(wall, change, metrics={"also": ["needing:FIRST"]})
    found = drive_and_score(system, np.array([[8.0, 0.0], [4.0, 0.0]]))
    assert str(found.metrics["first"]) == "[nan 40.]"


def test_a_rig_states_its_metrics_itself(wall: Path) -> None:
    system = system_of(wall, scenario={"model": "models:Rig"})
    found = drive_and_score(system, np.array([[5.0, 0.0], [3.0, 0.5]]))
    assert found.f_safe.tolist() == pytest.approx([10.0, -(75**0.5)])
    assert found.collision_speed[1] == pytest.approx(75**0.5)
    assert found.metrics["ave_dece"][0] == 5
    assert np.isnan(found.metrics["ave_dece"][1])
    assert np.isnan(found.metrics["tet"]).all()


def test_each_setting_alone_gives_the_bytes_of_a_batch(wall: Path) -> None:
    system = system_of(wall)
    rows = np.linspace([3, 0], [9, 1], 8)
    alone = Evaluations.concatenate(
        [drive_and_score(system, row) for row in np.split(rows, 8)]
    )
    assert_same_results(drive_and_score(system, rows), alone)


def test_one_simulator_is_kept_its_fields_are_set_and_it_is_closed(wall: Path) -> None:
    search = {"speed": {"lower": 10.0, "upper": 20.0}, "gap": {}}
    system = system_of(wall, scenario={"over": search}, encounters="ranges")
    with system.modules.active():
        module = sys.modules["models"]
    rows = np.array([[8.0, 0.0, 10.0, 40.0], [8.0, 0.0, 20.0, 60.0]])
    found = drive_and_score(system, rows)
    stops = [gap - v * 0.5 - v**2 / 16 for _, _, v, gap in rows]
    assert found.f_safe.tolist() == pytest.approx(stops, abs=0.55)
    assert len(module.OPENED) == 1
    kept.close_simulator()
    assert len(module.CLOSED) == 1


def test_a_struct_that_returns_lists_is_a_simulator_too(wall: Path) -> None:
    """Its fields are searched, and tests of a matrix may have several classes."""
    search = {"speed": {"lower": 10.0, "upper": 20.0}}
    rows = np.array([[8.0, 0.0, 10.0], [4.0, 0.2, 20.0]])
    both = [
        drive_and_score(
            system_of(
                wall,
                scenario={"model": f"models:{name}", "over": search},
                encounters="ranges",
            ),
            rows,
        )
        for name in ("Wall", "Listed")
    ]
    assert both[0].f_safe.tolist() == both[1].f_safe.tolist()
    tests = [
        {"name": name, "model": f"models:{name}"} for name in ("Wall", "Listed", "Rig")
    ]
    system = system_of(wall, matrix={"tests": tests})
    assert drive_and_score(system, np.array([[8.0, 0.0]])).f_safe[0] == pytest.approx(
        18, abs=0.5
    )


KEEPS = """
from dataclasses import dataclass, field
from threading import Lock
from typing import Any

import msgspec
import numpy as np

LOG = []


@dataclass
class Derives:
    '''Stops after v^2 / 2a; values are derived at creation, and changed in a run.'''

    UNITS = {"decel": "m/s^2", "delay": "s"}
    OPTIONAL = ("delay",)
    speed: float = 50.0
    engine: Any = field(default=None, init=False)

    def __post_init__(self):
        self.v = self.speed / 3.6
        self.rows = []
        self.locks = [Lock()]  # which cannot be copied
        self.random = np.random.default_rng(1)

    def simulate(self, setting):
        if self.engine is None:
            self.engine = LOG.append("engine") or object()
        self.rows.append(self.v)
        rest = 40 - self.v**2 / 2 / setting["decel"] - 0 * setting["delay"]
        rest += 1e-3 * self.random.random()
        self.v = 0
        if rest < 0:
            impact = (-2 * setting["decel"] * rest) ** 0.5
            return {"outcome": "collision", "safety_degree": -impact}
        return {"outcome": "stopped", "safety_degree": rest / len(self.rows)}


class Served(Derives):
    @classmethod
    def open_worker(cls, worker):
        open("log", "a").write(f"{cls.__name__} open {worker}\\n")
        return [worker]

    @classmethod
    def close_worker(cls, handle):
        open("log", "a").write(f"{cls.__name__} close {handle[0]}\\n")

    def simulate(self, setting):
        assert self.worker and self.engine is None
        return super().simulate(setting)


class Struct(msgspec.Struct, frozen=True):
    UNITS = Derives.UNITS
    OPTIONAL = ("delay",)
    speed: float = 50.0
    open_worker = classmethod(Served.open_worker.__func__)
    close_worker = classmethod(Served.close_worker.__func__)

    def simulate(self, setting):
        nothing = 0.0 * sum(setting.values())
        return {"outcome": "stopped", "safety_degree": len(self.worker) + nothing}


class Dies(Served):
    def simulate(self, setting):
        if setting["decel"] < 8 and self.worker == [0] and open("dies", "a+").tell() == 0:
            open("dies", "a").write("x")
            __import__("os")._exit(7)
        return super().simulate(setting)
"""


@pytest.mark.parametrize("name", ["Derives", "Served"])
def test_each_setting_has_an_object_that_was_created_with_its_fields(
    wall: Path, name: str
) -> None:
    """What is derived at creation is that of the test point, and of no run before."""
    write("keeps.py", KEEPS)
    tests = [{"name": "a", "over": {"speed": [20.0, 60.0, 90.0]}}]
    system = system_of(
        wall, scenario={"model": f"keeps:{name}"}, matrix={"tests": tests}
    )
    for _ in range(2):
        at_points = simulate_all_points(system, np.array([[8.0, 0.0], [8.0, 0.0]]))
        degrees = [point.evaluations.f_safe.tolist() for point in at_points]
        rests = [40 - (v / 3.6) ** 2 / 16 for v in (20, 60, 90)]
        assert degrees == [pytest.approx([rest] * 2, abs=2e-3) for rest in rests]
        assert len({*degrees[0]}) == 1
    if name == "Derives":
        with system.modules.active():
            assert sys.modules["keeps"].LOG == ["engine"]


@pytest.mark.parametrize("name", ["Served", "Struct"])
def test_a_process_opens_its_worker_once_and_ends_it(wall: Path, name: str) -> None:
    """Also where the code is loaded again, and with a number: 0 without worker processes."""
    choose(f"keeps:{name}", KEEPS)
    run("check wall.toml")
    run("simulate wall.toml")
    kept.close_simulator()
    assert Path("log").read_text().split("\n") == [
        f"{name} open 0",
        f"{name} close 0",
        "",
    ]
    wrong = KEEPS.replace("def open_worker(cls, worker)", "def open_worker(cls)")
    write("keeps.py", wrong)
    refused("check wall.toml", "open_worker that does not take (worker)")


@SLOW
@pytest.mark.usefixtures("worker_processes")
def test_workers_have_numbers_which_those_have_that_replace_them(wall: Path) -> None:
    choose("keeps:Dies", KEEPS)
    run("study wall.toml --out results --jobs 2")
    kept.close_simulator()  # of this process
    lines = Path("log").read_text().splitlines()
    assert {line for line in lines if "open" in line} == {"Dies open 0", "Dies open 1"}
    assert lines.count("Dies open 0") == lines.count("Dies close 0") + 1  # one died
    assert lines.count("Dies open 1") == lines.count("Dies close 1")


def test_runs_have_one_time_step(wall: Path) -> None:
    """In one batch or in several, and in `check`, which names the line of the user's method."""
    change = (
        "lambda r: {**r, 'time': r['time'] * (k := 1 + (len(r['time']) > 60)),"
        " 'speed': r['speed'] / k}"
    )
    system = wrong_system(wall, change)
    simulators.simulate_each(system, np.array([[9.0, 0.0]]))
    with pytest.raises(InputError, match=r"time steps of 0.05 and 0.1 s"):
        simulators.simulate_each(system, np.array([[4.0, 0.5]]))
    choose("models:Wrong")
    (finding,) = rows_of(json_of("check wall.toml", expect=1), "findings")
    assert "time steps of 0.05 and 0.1 s" in finding["finding"]
    lines = Path("models.py").read_text().splitlines()
    file, _, line = finding["where"].rpartition(":")
    assert file == str(wall.parent / "models.py")
    assert lines[int(line) - 2 : int(line)] == [
        "class Wrong(Wall):",
        "    def simulate(self, setting):",
    ]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            "**{k: r[k] * 3.6 for k in ('speed', 'impact_speed') if k in r}",
            "speed and position disagree",
        ),
        ("position=r['position'] * 3.6", "speed and position disagree"),
        (
            "position=r['position'] * 0 + 1, gap=r['gap'] / 3.6",
            "speed and position disagree",
        ),
        ("gap=20 + (r['gap'] - 40) / 1.6", "speed and gap disagree"),
        ("gap=40 + (r['gap'] - 40) / 1.4", ""),
        (
            "gap=r['gap'] / 3.6, obstacle_speed=r['gap'] * 0 + 1",
            "speed and gap disagree",
        ),
        ("gap=r['gap'] + r['time'], obstacle_speed=r['gap'] * 0 + 1", ""),
        ("gap=np.where(r['time'] == 0, np.inf, r['gap'])", ""),
    ],
)
def test_a_speed_that_disagrees_with_the_way_is_a_finding(
    wall: Path, change: str, told: str
) -> None:
    wrong_system(wall, f"lambda r: {{**r, **dict({change})}}")
    choose("models:Wrong")
    assert told in run("check wall.toml --vehicles 3", expect=int(bool(told))).stdout


@SLOW
@pytest.mark.parametrize(
    ("reads", "told"),
    [
        ('{"decel": setting["decel"], "delay": 0}', "simulate never reads delay"),
        (
            '{"decel": setting.get("decel"), "delay": dict(setting)["delay"]}',
            "drac is undefined in all runs",
        ),
    ],
)
def test_what_a_study_names_and_a_simulator_never_has_is_a_finding_of_check_alone(
    wall: Path, reads: str, told: str
) -> None:
    code = f"class Part(Rig):\n    def simulate(self, setting):\n        setting = {reads}\n"
    with (wall.parent / "models.py").open("a") as file:
        file.write(f"{code}        return Rig.simulate(self, setting)\n")
    study = STUDY.replace("models:Wall", "models:Part")
    wall.write_text(
        study if "never" in told else study.replace("ttc", 'also = ["drac"]\nttc', 1)
    )
    printed = run("check wall.toml", expect=1).stdout
    parts = [line.partition(":")[0] for line in printed.splitlines()[2:6]]
    assert parts == ["where", "found", "expected", "what to do"]
    assert told in printed
    run("study wall.toml --out results --runs 1")


def test_versions_belong_to_the_identity_of_results(wall: Path) -> None:
    study = sv.load_study(str(wall))
    versions = manifest_now(study, assemble(study))["versions"]
    assert versions["version of Wall"] == "1.2"
    assert versions["numpy"] == np.__version__
    write("models.py", MODELS.replace('("numpy",)', '("no_such_simulator",)'))
    with pytest.raises(InputError, match="no_such_simulator"):
        manifest_now(study, assemble(study))


@SLOW
def test_a_figure_and_an_animation_need_the_position(wall: Path) -> None:
    run("simulate wall.toml --set decel=4 --plot a.png --animate a.html")
    assert Path("a.png").stat().st_size
    assert "wall" in Path("a.html").read_text()
    choose("models:Rig")
    refused("simulate wall.toml --animate b.html", "needs the position")
    refused("simulate wall.toml --trace b.csv", "states metrics alone")
    refused("study wall.toml --engine sumo --out r", "no other engine")


@SLOW
@pytest.mark.usefixtures("pools_in_this_process")
def test_a_page_with_few_simulations_has_the_replay_with_the_fewest_changes(
    wall: Path,
) -> None:
    run("study wall.toml --out results --runs 1")
    shown = list[int]()
    sv.report(
        "results",
        out="page.html",
        simulations=400,
        progress=lambda _, done, total: shown.append(total),
    )
    assert "Fewest changes: " in Path("page.html").read_text()
    assert max(shown) <= 400


@SLOW
def test_a_cause_ends_where_the_formula_does_and_weather_is_not_said(
    wall: Path,
) -> None:
    """Failures are explained without reference drivers."""
    found = json_of("explain wall.toml --simulations 3000")
    assert found["numbers"]["collisions"] is None
    assert not rows_of(found, "drivers")
    causes = rows_of(found, "causes")
    (share,) = (row["begins_at"] for row in causes if row["causes"] == {"decel": 3})
    assert 8 - 5 * share == pytest.approx(225 / 2 / 32.5, abs=0.1)
    assert "weather" not in run("tolerance wall.toml --simulations 400").stdout


NOISY = """
import random

from models import Wall


class Drifts(Wall):
    def simulate(self, setting):
        result = super().simulate(setting)
        return {**result, "separation": result["separation"] + random.random()}


class Ends(Wall):
    def simulate(self, setting):
        if setting["decel"] < 4 and END:
            __import__("os")._exit(7)
        return super().simulate(setting)
"""


@SLOW
def test_a_simulator_that_is_not_deterministic_says_how_often_it_is_repeated(
    wall: Path,
) -> None:
    """The worst run counts, each is in the journal, and without repeats the study is refused."""
    choose("noisy:Drifts", NOISY)
    assert "repeats = N" in run("check wall.toml", expect=1).stdout
    choose("noisy:Drifts", more="repeats = 4")
    run("check wall.toml")
    found = drive_and_score(
        system_of(wall), np.array([[8.0, 0.0], [3.0, 0.0], [9.0, 0.5]])
    )
    rounds = np.stack([found.metrics[f"safety_degree_{k}"] for k in range(1, 5)])
    assert found.f_safe == pytest.approx(rounds.min(axis=0))
    assert found.metrics["unsafe_share"].tolist() == [0, 1, 0]
    assert len({*rounds[:, 0]}) == 4
    assert found.outcome.tolist() == ["stopped", "collision", "stopped"]
    run("study wall.toml --out results")
    assert (
        '"safety_degree_4":[' in next(Path("results/runs").glob("*.jsonl")).read_text()
    )


def test_the_worst_run_and_the_share_of_unsafe_runs_count() -> None:
    """Metres and metres per second have no mean."""
    degrees = np.array([2.0, 9.0, 2.0, 5.0, 2.0, 6.0, -6.0, 7.0])
    names = [
        "stopped",
        "passed",
        "passed",
        "stopped",
        "stopped",
        "timeout",
        "timeout",
        "timeout",
    ]
    outcome = np.where(degrees < 0, "collision", names)
    of_runs = {
        **dict.fromkeys(METRICS, np.full(8, np.nan)),
        "safety_degree": degrees,
        "tet": np.array([1.0, 1.0, np.nan, 2.0, 3.0, 3.0, np.nan, np.nan]),
    }
    found = joined(made_up_evaluations(degrees, outcome=outcome, metrics=of_runs), 4)
    assert found.outcome.tolist() == ["collision", "timeout"]
    assert found.f_safe.tolist() == [-6, 5]
    assert_array_equal(found.collision_speed, [6, np.nan])
    assert found.metrics["unsafe_share"].tolist() == [0.25, 0]
    assert found.metrics["tet"].tolist() == [2, 2]
    assert Unsafe.parse("below=6").runs(found).mean(axis=0).tolist() == [1, 0.25]
    assert Unsafe.parse("unsafe_share > 0.2").of(found).tolist() == [True, False]
    assert Unsafe().number(found) == 0.25
    words = (
        "collides at 6.00 m/s and fails in 1 of 4 repeated runs (95 %: 0.63 to 81 %)"
    )
    assert Unsafe().breach_in_words(found.take([0])) == words


RARE = """
from models import Wall


class Rare(Wall):
    '''Collides at 8 m/s in one of so many runs as the delay says.'''

    number = {}

    def simulate(self, setting):
        key = tuple(setting.values())
        Rare.number[key] = n = Rare.number.get(key, 0) + 1
        if n % 20 < round(20 * setting["delay"]):
            return {"outcome": "collision", "safety_degree": -8.0}
        return {"outcome": "stopped", "safety_degree": 2.0}
"""


@SLOW
def test_answers_count_the_share_of_unsafe_runs(wall: Path) -> None:
    """A vehicle that fails in 3 of 20 runs counts 0.15; limits are of the worst run."""
    choose("rare:Rare", RARE, "repeats = 20")
    system = system_of(wall)
    names = [one.name for one in system.measuring.scoring.objectives]
    assert names == ["unsafe_share", "f_diff", "f_num_diff"]
    own = wall.read_text() + 'objectives = ["safety_degree", "f_diff"]\n'
    write("own.toml", own)
    names = [
        one.name
        for one in system_of(wall.parent / "own.toml").measuring.scoring.objectives
    ]
    assert names == ["f_safe", "f_diff"]
    found = json_of("simulate wall.toml --set delay=0.15")
    assert (
        "collides at 8.00 m/s and fails in 3 of 20 repeated runs (95 %: 3.2 to 38 %)"
        in (found["verdict"])
    )
    assert found["numbers"]["unsafe_share"] == 0.15
    assert found["numbers"]["safety_degree"] == -8
    for question in ("risk", "rules"):
        numbers = numbers_of(f"{question} wall.toml --simulations 2000")
        share = numbers["failures"] / numbers["samples"]
        assert share == pytest.approx(0.5, abs=0.06)
        low, high = numbers["interval"]
        assert low < share < high
    for delay, holds in ((0.05, False), (0.02, None)):
        answer = sv.tolerance(
            "wall.toml",
            limits=[f"delay <= {delay}"],
            simulations=2000,
            pool=InlinePool(),
        )
        assert answer.numbers["kept"] is holds
    run("study wall.toml --out results")
    assert "unsafe_share" in Path("results/solutions.csv").read_text()


def test_noise_of_one_seed_is_a_remark(wall: Path) -> None:
    noisy = STUDY.replace("delay = {", 'delay = { meaning = "noise of the brake",')
    wall.write_text(noisy)
    assert any(
        "noise of one seed" in remark for remark in without_effect(system_of(wall))
    )
    write("models.py", MODELS.replace("    speed:", "    seed: int = 1\n    speed:"))
    wall.write_text(
        f'{noisy}\n[[matrix.tests]]\nname = "a"\nover = {{ seed = [1, 2, 3] }}\n'
    )
    assert not without_effect(system_of(wall))


@SLOW
@pytest.mark.usefixtures("worker_processes")
def test_a_simulator_that_ends_its_process_twice_is_an_error_with_its_setting(
    wall: Path,
) -> None:
    end = "len(open('ended', 'a+').write('x') and open('ended').read()) <= 2"
    choose("noisy:Ends", NOISY.replace("END", end))
    told = (
        "exit code 7",
        "to reproduce it: python -m safevar_sumo simulate wall.toml --set decel=3",
    )
    refused("study wall.toml --out results", *told)


SECONDS = f"1234.{os.getpid()}"
"""Time that a child process sleeps, as no other test's."""
FAILS = """
import os
import subprocess
import time

from models import Wall


class Fails(Wall):
    version = "1"

    def simulate(self, setting):
        open("count", "a").write("x")
        if setting["decel"] < LIMIT:
            subprocess.Popen(["sleep", "SECONDS"], start_new_session=True)
            FAILURE
        return super().simulate(setting)
""".replace("SECONDS", SECONDS)


def with_failures(failure: str, limit: str = "3.2", failed: str = "skip") -> None:
    code = FAILS.replace("FAILURE", failure).replace("LIMIT", limit)
    choose("fails:Fails", code, end=f'time_limit = 1.0\nfailed = "{failed}"\n')


def children() -> int:
    kept.close_simulator()  # of this process
    return sum(
        path.read_bytes() == f"sleep\x00{SECONDS}\x00".encode()
        for path in Path("/proc").glob("[0-9]*/cmdline")
        if path.exists()
    )


@SLOW
@pytest.mark.usefixtures("worker_processes")
@pytest.mark.parametrize("failure", ["1 / 0", "os._exit(7)", "time.sleep(60)"])
def test_settings_that_fail_may_be_skipped_and_tried_again(
    wall: Path, failure: str
) -> None:
    """They are infeasible and counted; `check` names them; children end with their simulator."""
    with_failures(failure)
    options = "study wall.toml --out results --jobs 1"
    printed = run(options).stdout
    number = int(re.search(r"could not simulate (\d+) ", printed)[1])
    journals = "".join(
        path.read_text() for path in Path("results/runs").glob("*.jsonl")
    )
    assert journals.count('"simulator-error"') == number > 0
    assert "--set decel=3" in journals or failure == "1 / 0"
    assert children() == 0
    printed = run("check wall.toml", expect=None)
    assert {"1 / 0": "division", "os._exit(7)": "code 7"}.get(
        failure, "time limit"
    ) in (printed.stdout + printed.stderr)
    assert children() == 0
    before = Path("count").stat().st_size
    run(f"{options} --retry-failed")
    assert Path("count").stat().st_size > before


def test_an_attempt_counts_as_a_death_only_when_its_process_has_died(
    wall: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other workers may be at the same setting; what ends meanwhile is no error."""
    monkeypatch.setattr(this_process, "attempts", tmp_path / "attempts")
    system = replace(system_of(wall), skips_failed=True)
    with ExitStack() as stack:
        for _ in range(3):
            stack.enter_context(simulators._attempt("it", system))
        (folder,) = (tmp_path / "attempts").iterdir()
        assert len([*folder.iterdir()]) == 3
    for number in range(2):
        (folder / f"dead-{number}").touch()
        if number == 0:
            with simulators._attempt("it", system):
                pass
    with (
        pytest.raises(UserCodeError, match="two workers died"),
        simulators._attempt("it", system),
    ):
        pass
    assert {path.name for path in folder.iterdir()} == {"dead-0", "dead-1"}

    # A process that only looks is not taken for the owner of what it looks at.
    with (folder / "dead-0").open("r+") as file:
        simulators.portalocker.lock(file, simulators.portalocker.LOCK_SH)
        assert simulators._has_died(folder / "dead-0")

    # A disk without locks.
    refused_lock = Mock(side_effect=simulators.portalocker.LockException)
    monkeypatch.setattr(simulators.portalocker, "lock", refused_lock)
    with simulators._attempt("it", system):
        pass


LEAKS = """
import atexit, os, sys, threading, time
from models import Rig

class Leaks(Rig):
    def simulate(self, setting):
        DAMAGE
        return super().simulate(setting)
"""


@SLOW
def test_threads_and_exit_functions_of_a_simulator_keep_no_command(wall: Path) -> None:
    thread = "threading.Thread(target=time.sleep, args=(999,)).start()"
    damage = f"{thread}; atexit.register(time.sleep, 999)"
    choose("leaks:Leaks", LEAKS.replace("DAMAGE", damage))
    command = "study wall.toml --jobs 1 --out results"
    run_python("-m", "safevar_sumo", *command.split(), timeout=200)
    assert Path("results/solutions.csv").exists()


@SLOW
@pytest.mark.usefixtures("worker_processes")
@pytest.mark.parametrize(
    ("damage", "told"),
    [
        ("os.closerange(3, 64)", "user code has closed descriptors"),
        ("sys.stdout = None", "set sys.stdout or sys.stderr to None"),
    ],
)
def test_a_simulator_that_takes_its_process_apart_is_named(
    wall: Path, damage: str, told: str
) -> None:
    choose("leaks:Leaks", LEAKS.replace("DAMAGE", damage))
    message = (told, "leaks:Leaks" if "close" in damage else "leaks.py:5")
    refused("study wall.toml --out results --jobs 1", *message)


@SLOW
def test_more_than_a_tenth_of_failures_is_an_error(wall: Path) -> None:
    with_failures("1 / 0", limit="5")
    told = ("settings failed, more than 10 %", "division by zero")
    refused("study wall.toml --out results", *told, "--retry-failed")
    printed = run("risk wall.toml --simulations 1000", expect=2).stderr
    assert all(part in printed for part in told)
    with_failures("1 / 0", failed="stop")
    refused("study wall.toml --out other", "division by zero")
    with pytest.raises(InputError, match="failed = 'skip' without a simulator"):
        system_of("rain", search={"failed": "skip"})


@SLOW
def test_a_pack_states_the_number_that_followed_from_time(
    wall: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that `verify` asks the same on another machine; so does the command of each answer."""
    run("study wall.toml --out results")
    with monkeypatch.context() as patch:
        patch.setattr("safevar_sumo.questions.budget.LONGEST_QUESTION", 0.4)
        seconds = "safevar_sumo.questions.evaluator.seconds_of_simulation"
        patch.setattr(seconds, lambda *_: 0.001)  # whatever else this machine does
        run("evidence results --out pack.zip --ask 'risk --samples 4000'")
        first = sv.risk("results", pool=InlinePool())
    assert re.search(r"risk results --simulations \d+$", first.command)
    again = sv.risk(
        "results", simulations=int(first.command.split()[-1]), pool=InlinePool()
    )
    assert again.to_dict() == first.to_dict()
    with ZipFile("pack.zip") as pack:
        assert b" --simulations " in pack.read("1-wall/answers.json")
    run("verify pack.zip --run-code")


READS = """
import importlib
import os
import sqlite3
import sys

from models import Wall


class Reads(Wall):
    def simulate(self, setting):
        factor = READ
        result = super().simulate(setting)
        log = open("own.log", "w").write("written") and open("own.log").read()
        return {**result, "separation": result["separation"] * factor}
"""
"""Files that Python opens, and one that it does not."""
BY = {
    "opened": "float(open('data.txt').read())",
    "sqlite3": (
        "sqlite3.connect('file:data.db?mode=ro', uri=True).execute('select x from t').fetchone()[0]"
    ),
    "elsewhere": "float(os.popen('cat data.txt').read())",
}


def with_data(wall: Path, how: str, value: float) -> None:
    choose("reads:Reads", READS.replace("READ", BY[how], 1))
    write("data.txt", f"{value}")
    (wall.parent / "data.db").unlink(missing_ok=True)
    with closing(sqlite3.connect(wall.parent / "data.db")) as database:
        database.execute("create table t (x)")
        database.execute("insert into t values (?)", (value,))
        database.commit()


@SLOW
@pytest.mark.parametrize("how", BY)
def test_results_of_two_simulators_are_not_mixed(wall: Path, how: str) -> None:
    """Neither by `study`, nor by a question; what the simulator has written itself is no input."""
    with_data(wall, how, 1.0)
    run("study wall.toml --out results --runs 1")
    files = sv.load("results").directory / "manifest.json"
    named = {"opened": "data.txt", "sqlite3": "data.db", "elsewhere": ""}[how]
    assert named in files.read_text()
    assert "own.log" not in files.read_text()
    run("study wall.toml --out results")
    run("risk results --simulations 50")
    with_data(wall, how, 1.1)
    told = f"{named} has changed since" if named else "the original vehicle had"
    refused("study wall.toml --out results", told)
    refused("risk results --simulations 50", told)
    run("risk results --simulations 50 --as-it-is-now")
    study = sv.load_study(str(wall))
    keys = set()
    for value in (1.0, 1.1):
        with_data(wall, how, value)
        opened = [named] if named else []
        keys.add(Cache(wall.parent / f"{value}").key_of(study, opened))
    assert len(keys) == (2 if named else 1)


@SLOW
def test_an_interrupted_question_of_another_simulator_begins_anew(
    wall: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here a file that Python does not open."""
    monkeypatch.setenv("SAFEVAR_CACHE", str(wall.parent / "cache"))

    def ask() -> float:
        with (
            keep_simulations("risk"),
            open_evaluator(sv.load_study(str(wall)), InlinePool()) as it,
        ):
            it.budget.is_question = True
            it.begin({"all": 1})
            found = it.evaluate(np.array([[8.0, 0.0], [4.0, 0.0]]), "all")
            if stops:
                raise KeyboardInterrupt
            return float(found.f_safe[0])

    with_data(wall, "elsewhere", 1.0)
    stops = True
    with pytest.raises(KeyboardInterrupt):
        ask()
    with_data(wall, "elsewhere", 1.1)
    stops = False
    with pytest.warns(UserWarning, match="does not continue: the simulator"):
        changed = ask()
    with_data(wall, "elsewhere", 1.0)
    assert changed == pytest.approx(1.1 * ask())


@SLOW
@pytest.mark.usefixtures("worker_processes")
def test_a_study_repeats_three_settings_in_another_process(wall: Path) -> None:
    """A hash of a text is the same in all workers, a process's number is not."""
    choose("reads:Reads", READS.replace("READ", "1 + hash('a') % 9973", 1))
    run("study wall.toml --jobs 2 --out results")
    assert "in a new process" in run("check wall.toml", expect=1).stdout
    choose("reads:Reads", READS.replace("READ", "1 + os.getpid() % 997", 1))
    refused("study wall.toml --jobs 1 --out other", "in another process")


@SLOW
@pytest.mark.usefixtures("worker_processes")
def test_what_an_object_keeps_of_another_point_is_found(wall: Path) -> None:
    """Here an object that is put into the simulator in its first run."""
    lazy = "getattr(self, 'road', None) or type('Road', (), {'length': self.gap})()"
    text = READS.replace(
        "READ", f"(self.__dict__.setdefault('road', {lazy})).length / 40", 1
    )
    tests = '[[matrix.tests]]\nname = "a"\nover = { gap = [40.0, 60.0] }\n'
    choose("reads:Reads", text, end=tests)
    assert "in a new process" in run("check wall.toml", expect=1).stdout
    refused("study wall.toml --out results", "points in another order")


@SLOW
def test_a_library_of_the_search_counts_if_the_simulator_uses_it(wall: Path) -> None:
    run("study wall.toml --out results")
    rewrite(Path("results/manifest.json"), (np.__version__, "1.0"))
    refused("study wall.toml --out results", "version of numpy was '1.0'")
    study = tables_of(sv.load_study(str(wall)))
    stored, now = (
        {"versions": {"numpy": one}, "study": study} for one in ("1.0", "1.1")
    )
    for libraries, matters in ([], False), (["numpy"], True):
        (change,) = manifest_differences(stored, {**now, "libraries": libraries})
        assert change[2] is matters


UNLUCKY = """
from models import Wall


class Unlucky(Wall):
    '''Collides in the first four runs of each vehicle with a delay, and never again.'''

    number = {}

    def simulate(self, setting):
        key = tuple(setting.values())
        Unlucky.number[key] = n = Unlucky.number.get(key, 0) + 1
        if n <= 4 and setting["delay"] > 0.3:
            return {"outcome": "collision", "safety_degree": -8.0}
        return {"outcome": "stopped", "safety_degree": 2.0 + n % 2 - setting["delay"]}
"""


@SLOW
def test_failures_that_fresh_runs_do_not_repeat_are_told_by_no_answer(
    wall: Path,
) -> None:
    choose("unlucky:Unlucky", UNLUCKY, "repeats = 4")
    sampled = sv.explain(str(wall), simulations=2000, pool=InlinePool())
    assert sampled.tables["causes"].empty
    assert "was safe in all its fresh runs" in sampled.verdict
    assert "enough" not in sampled.verdict
    run("study wall.toml --out results")
    summary = json_of("explain results")
    assert not rows_of(summary, "causes")
    assert "enough" not in summary["verdict"]


def test_simulate_compares_the_means_of_repeated_runs(wall: Path) -> None:
    choose("unlucky:Unlucky", UNLUCKY.replace("n <= 4", "n < 0"), "repeats = 4")
    answer = json_of("simulate wall.toml --set delay=0.4")
    changed = [3 - 0.4, 2 - 0.4] * 2
    original = [3.0, 2.0] * 2
    difference = np.mean(changed) - np.mean(original)
    # Welch's interval, from its formula: both variances are 1/3, with 6 degrees of freedom.
    half = scipy.stats.t.ppf(0.975, 6) * np.sqrt(2 * (1 / 3) / 4)
    assert (
        f"is {difference:+.2f} m (95 %: {difference - half:+.2f} to"
        f" {difference + half:+.2f} m). The repeated runs do not show which"
    ) in answer["verdict"]
