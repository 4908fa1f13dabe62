"""The commands as a user types them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from safevar_sumo.shipped import STUDIES
from tests.in_process import refused, run

SLOW = pytest.mark.slow


def test_study_leaves_manifest_and_solutions_and_nothing_else(in_tmp: Path) -> None:
    run("study", "smoke", "--evaluations", "100", "--quiet")
    assert [path.name for path in in_tmp.iterdir()] == ["results"]
    assert sorted(path.name for path in (in_tmp / "results/smoke").iterdir()) == [
        "manifest.json",
        "runs",
        "solutions.csv",
    ]
    frame = pd.read_csv(in_tmp / "results/smoke/solutions.csv")
    characteristics = list(
        json.loads((in_tmp / "results/smoke/manifest.json").read_text())["study"]["vehicle"]["characteristics"]
    )
    assert list(frame.columns) == [
        "algorithm",
        "run",
        *characteristics,
        "f_safe",
        "f_diff",
        "f_num_diff",
        "safety_degree",
        "tet",
        "tit",
        "ave_dece",
        "outcome",
    ]
    assert set(frame["run"]) == {0, 1}
    assert set(frame["algorithm"]) == {"nsga2", "rs"}


@pytest.mark.slow
@pytest.mark.parametrize("study", ["rain", pytest.param("lgsvl", marks=SLOW), pytest.param("native", marks=SLOW)])
def test_the_same_bytes_for_every_batch_size_and_from_run_to_run(study: str, in_tmp: Path) -> None:
    contents = set()
    for out, batch in (("a", "7"), ("b", "50"), *((("c", "1"),) if study != "rain" else ())):
        run(
            "study",
            study,
            "--algorithms",
            "nsga2",
            "--runs",
            "1",
            "--evaluations",
            "60",
            "--batch",
            batch,
            "--out",
            out,
            "--quiet",
        )
        contents.add(((in_tmp / out / "solutions.csv").read_bytes(), (in_tmp / out / "manifest.json").read_bytes()))
    assert len(contents) == 1


def test_simulate_prints_the_promised_json() -> None:
    result = json.loads(run("simulate", "rain", "--set", "tireFric=1.5", "--set", "mass=2410", "--json").stdout)
    assert list(result) == [
        "study",
        "vcs",
        "outcome",
        "collision",
        "collision_speed",
        "safety_degree",
        "tet",
        "tit",
        "ave_dece",
        "f_safe",
        "f_diff",
        "f_num_diff",
    ]
    assert result["study"] == "rain"
    assert result["vcs"]["tireFric"] == 1.5
    assert result["vcs"]["mass"] == 2404, "a change below the threshold is filtered"
    assert result["f_num_diff"] == 1
    unfiltered = json.loads(
        run("simulate", "rain", "--set", "tireFric=1.5", "--set", "mass=2410", "--no-filter", "--json").stdout
    )
    assert unfiltered["vcs"]["mass"] == 2410
    assert unfiltered["f_num_diff"] == 2


@pytest.mark.parametrize("study", ["rain", "lgsvl", "native"])
def test_trace_has_every_quantity_with_its_unit(study: str, in_tmp: Path) -> None:
    run("simulate", study, "--trace", "trace.csv")
    frame = pd.read_csv("trace.csv")
    assert list(frame.columns) == [
        "time [s]",
        "position [m]",
        "speed [m/s]",
        "acceleration [m/s^2]",
        "gap [m]",
        "ttc [s]",
        "throttle [-]",
        "brake [-]",
        "gear [-]",
        "lateral [m]",
        "lateral speed [m/s]",
        "seen speed [m/s]",
        "seen gap [m]",
        "seen closing speed [m/s]",
        "seen lateral [m]",
        "seen lateral speed [m/s]",
    ]
    assert frame.loc[frame["speed [m/s]"] < 1e-3, "ttc [s]"].isna().all(), "a standing vehicle closes nothing"
    assert frame["ttc [s]"].notna().any()
    step = np.diff(frame["time [s]"])
    assert np.allclose(step, step[0])
    assert np.allclose(np.diff(frame["speed [m/s]"]) / step, frame["acceleration [m/s^2]"][1:])


@pytest.mark.slow
def test_a_users_scalar_ads_is_named_in_a_study(in_tmp: Path) -> None:
    Path("my_ads.py").write_text(
        "from safevar_sumo.ads import ScalarAds\n\n\n"
        "class Careful(ScalarAds):\n"
        "    def __init__(self, margin):\n        self.margin = margin\n\n"
        "    def drive(self, seen):\n"
        "        stopping = seen.speed**2 / (2 * 0.5 * self.nominal.decel)\n"
        "        return (0.0, 1.0) if seen.gap < stopping + self.margin else (0.3, 0.0)\n"
    )
    Path("mine.toml").write_text(
        'extends = "sun"\nname = "mine"\n[ads]\nmodel = "my_ads:Careful"\nparameters = { margin = 2.0 }\n'
        '[search]\nruns = 1\nevaluations = 10\nalgorithms = ["rs"]\n'
    )
    program = str(Path(sys.executable).parent / "safevar-sumo")
    done = subprocess.run([program, "simulate", "mine.toml", "--json"], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["outcome"] in ("stopped", "passed")
    run("study", "mine.toml", "--quiet")
    assert Path("results/mine/solutions.csv").is_file()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["study", "sum"], ("sum", "rain")),
        (["study", "sun", "--algorithms", "nsga3"], ("nsga3", "nsga2")),
        (["study", "sun", "--batch", "many"], ("--batch", "many")),
        (["study", "sun", "--out", "/proc/nowhere"], ("--out", "/proc/nowhere")),
        (["simulate", "sun", "--set", "mass=5000"], ("mass = 5000", "[2040, 2700] kg")),
        (["simulate", "sun", "--set", "weight=1"], ("weight", "mass")),
        (["simulate", "sun", "--trace", "/proc/nowhere/trace.csv"], ("--trace", "/proc/nowhere/trace.csv")),
        (
            ["study", "smoke", "--out", "link"],
            ("--out: cannot write to link: it is a link whose target does not exist",),
        ),
        (["tables", "out"], ("out: is not a results directory",)),
        (["simulate", "/"], ("/",)),
        (["simulate", "sun", "--as-it-is-now"], ("--as-it-is-now: a study is simulated as it is now anyway",)),
        (
            ["validate", "sun", "none.csv", "--jobs", "1025"],
            ("--jobs", "1025", "see python -m safevar_sumo validate --help"),
        ),
        (["study", "sun", "--seed"], ("--seed", "see python -m safevar_sumo study --help")),
        (["study"], ("Missing argument 'STUDY'",)),
        (["simulate", "sun", "--nothing"], ("No such option '--nothing'",)),
    ],
)
def test_bad_input_ends_with_code_2_and_says_what_is_legal(
    arguments: list[str], expected: tuple[str, ...], in_tmp: Path
) -> None:
    Path("link").symlink_to("nowhere")
    refused(*arguments, message=expected)
    assert not list(in_tmp.rglob("*.csv"))


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('model = "carla"', 'model = "carl"', ("vehicle.model", "carl", "lgsvl")),
        ('model = "world_on_rails"', 'model = "wor"', ("ads.model", "wor", "apollo")),
        ('model = "pedestrian_crossing"', 'model = "crosing"', ("scenario.model", "crosing", "lead_vehicle_stopped")),
        ('weather = "clear"', 'weather = "hail"', ("weather", "hail", "hard_rain")),
        ("tireFric         =", "tyreFric         =", ("tyreFric", "tireFric")),
        (
            "ttc_threshold = 1.5",
            "ttc_threshold = 1.5\nsampling_interval = 0.07",
            ("mine.toml: metrics.sampling_interval = 0.07", "0.05 s"),
        ),
        ("[vehicle]", "parameters = { duration = 0 }\n[vehicle]", ("scenario.parameters.duration = 0",)),
        ("[vehicle]", 'parameters = { network = "x" }\n[vehicle]', ("network 'x'", "lead_vehicle_stopped")),
        ('unit = "kg", ', 'unit = "t", ', ("vehicle.characteristics.mass.unit", "'t'", "kg")),
        ("ensemble = 200", "ensemble = 1", ("fit.ensemble = 1", "at least 2")),
        ("lower = 2040, upper = 2700", "lower = 2700, upper = 2040", ("vehicle.characteristics.mass", "lower < upper")),
    ],
)
def test_a_bad_study_file_ends_with_code_2(old: str, new: str, expected: tuple[str, ...], in_tmp: Path) -> None:
    text = (STUDIES / "sun.toml").read_text()
    assert old in text
    Path("mine.toml").write_text(text.replace(old, new))
    refused("simulate", "mine.toml", message=expected)


@pytest.mark.parametrize("where", ["__init__", "drive"])
def test_an_ads_that_exits_is_a_fault_and_no_success(where: str, in_tmp: Path) -> None:
    arguments = {"__init__": "self", "drive": "self, seen"}[where]
    Path("my_ads.py").write_text(
        "import sys\nfrom safevar_sumo.ads import ScalarAds\n\n\nclass Careful(ScalarAds):\n"
        "    def drive(self, seen):\n        return 0.5, 0.0\n\n"
        f"    def {where}({arguments}):\n        sys.exit(3)\n"
    )
    Path("mine.toml").write_text('extends = "sun"\nname = "mine"\n[ads]\nmodel = "my_ads:Careful"\n')
    refused("simulate", "mine.toml", message=("my_ads:Careful", "SystemExit", "my_ads.py:10"))


def test_an_ads_that_closes_standard_output_ends_in_one_line(in_tmp: Path) -> None:
    Path("my_ads.py").write_text(
        "import sys\nfrom safevar_sumo.ads import ScalarAds\n\n\nclass Careful(ScalarAds):\n"
        "    def drive(self, seen):\n        sys.stdout.close()\n        return 0.5, 0.0\n"
    )
    Path("mine.toml").write_text('extends = "smoke"\nname = "mine"\n[ads]\nmodel = "my_ads:Careful"\n')
    done = subprocess.run(
        [sys.executable, "-m", "safevar_sumo", "simulate", "mine.toml"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.splitlines()[-1] == "safevar-sumo: user code has closed standard output"
    assert "Traceback" not in done.stderr


def test_a_title_is_no_markup(in_tmp: Path) -> None:
    Path("mine.toml").write_text('extends = "smoke"\nname = "mine"\ntitle = "[red]x[/blue] {$"\n')
    assert "[red]x[/blue]" in run("simulate", "mine.toml").stdout
    run("study", "mine.toml", "--evaluations", "10", "--runs", "1", "--algorithms", "rs", "--quiet")


@SLOW
def test_a_study_ends_with_a_summary(in_tmp: Path) -> None:
    output = run("study", "smoke").stdout
    for part in (
        "original vehicle",
        "nsga2",
        "RQ1",
        "RQ2",
        "against the original vehicle: SD",
        "too few runs for a test (8 are needed)",
        "python -m safevar_sumo tables results/smoke",
    ):
        assert part in output
