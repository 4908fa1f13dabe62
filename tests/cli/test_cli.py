"""The program itself: what it lists, loads and prints; what simulate is told; progress as a person
sees it.
"""

from __future__ import annotations

import errno
import inspect
import os
import re
from io import StringIO
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from rich.console import Console

import safevar_sumo as sv
from safevar_sumo.api.simulation import load_study
from safevar_sumo.cli.command import ENDED_OPTIONS
from safevar_sumo.cli.program import COMMANDS, command_function, commands
from safevar_sumo.questions.answer import contents_of
from safevar_sumo.questions.ask import QUESTIONS
from safevar_sumo.questions.changes import read_changes
from safevar_sumo.study import Study
from safevar_sumo.terminal import open_progress
from tests.support.in_process import (
    SLOW,
    json_of,
    refused,
    rows_of,
    run,
    run_python,
    write,
)
from tests.support.made_up import SUN

HEAVY = {"libsumo", "traci", "matplotlib", "pandas", "scipy", "seaborn", "cma"}


def loaded(code: str) -> set[str]:
    """Which of the heavy packages a fresh interpreter has loaded after some code."""
    result = f"import sys\n{code}\nprint(*(set(sys.modules) & {HEAVY!r}))"
    return set(run_python("-c", result).stdout.splitlines()[-1].split())


def test_the_help_lists_every_command_with_the_first_sentence_of_its_function() -> None:
    assert set(QUESTIONS) <= set(COMMANDS)
    output = " ".join(CliRunner().invoke(commands, ["--help"]).stdout.split())
    for name in COMMANDS:
        found = commands.get_command(None, name)  # type: ignore[arg-type]
        sentence, _, _ = (found.help or "").partition("\n\n")
        assert f" {name} {' '.join(sentence.split())}" in output


@pytest.mark.parametrize("typed", ENDED_OPTIONS)
def test_an_option_that_ended_is_refused_with_what_replaces_it(typed: str) -> None:
    refused(typed, "is an option of releases before 0.5", ENDED_OPTIONS[typed])


@pytest.mark.parametrize("command", list(COMMANDS))
def test_every_command_and_each_of_its_options_has_a_whole_sentence_of_help(
    command: str,
) -> None:
    found = commands.get_command(None, command)  # type: ignore[arg-type]
    options = [
        option for option in found.params if not isinstance(option, click.Argument)
    ]
    short, full = (
        CliRunner().invoke(commands, [command, flag], catch_exceptions=False).output
        for flag in ("--help", "--help-all")
    )
    assert len(short.splitlines()) <= 45, "one screen"
    for one in options:
        assert one.opts[0] in short
        assert " ".join(str(one.help).split()) in " ".join(full.split())
        assert str(one.help).endswith((".", "]")), one.name


def test_there_are_at_most_20_commands_and_110_different_options() -> None:
    found = [commands.get_command(None, name) for name in COMMANDS]  # type: ignore[arg-type]
    options = {
        flag
        for command in found
        for one in command.params
        if isinstance(one, click.Option)
        for flag in one.opts
    }
    assert len(found) <= 20
    assert len(options) <= 110


def test_the_package_and_the_help_load_nothing_heavy() -> None:
    assert loaded("import safevar_sumo") == set()
    assert loaded("import safevar_sumo.cli") == set()


@SLOW
def test_one_simulation_loads_sumo_and_no_statistics() -> None:
    code = "from click.testing import CliRunner\nfrom safevar_sumo.cli.program import commands\n"
    assert loaded(code + "print(CliRunner().invoke(commands, ['list']).exit_code)") == {
        "pandas"
    }
    simulation = loaded(
        code
        + "print(CliRunner().invoke(commands, ['simulate', 'sun', '--json']).exit_code)"
    )
    assert simulation <= {"libsumo", "traci", "pandas", "scipy"}, (
        "Numba looks up the version of scipy"
    )


@pytest.mark.parametrize(
    ("typed", "condition", "words"),
    [
        ("simulate smoke", "safety_degree < 99", "failed: safety_degree = "),
        ("simulate smoke", "safety_degree < 0.1", ""),
        (
            "list weathers",
            "weathers.road_friction < 0.7",
            "failed: weathers.road_friction = 0.59 < 0.7 in the row hard_rain\n",
        ),
    ],
)
def test_a_gate_ends_with_code_3_and_of_a_table_it_names_the_row(
    typed: str, condition: str, words: str
) -> None:
    command = f"{typed} --fail-if '{condition}'"
    assert words in run(command, expect=3 if words else 0).stderr


@pytest.mark.parametrize(
    ("change", "value"),
    [
        ("mass=2500", 2500.0),
        ("mass=+10%", 2644.4),
        ("mass = 2.5e3", 2500.0),
    ],
)
def test_a_change_is_a_value_or_a_share(change: str, value: float) -> None:
    assert read_changes((change,), SUN) == {"mass": pytest.approx(value)}


@SLOW
def test_a_matrix_says_of_how_many_test_cases_a_degree_is_the_least() -> None:
    """Every number stands once, and the test case of the least degree is named."""
    text = run("simulate wear").stdout
    lead, _, _ = text.partition("\n┏")
    points = rows_of(json_of("simulate wear"), "points")
    worst = min(points, key=lambda row: row["safety_degree"])
    least = f"{worst['safety_degree']:.2f} m in the worst of {len(points)} test cases"
    assert f"{least} ({worst['point']}). The original vehicle fails in none" in lead
    assert "simulated" not in text


def test_the_original_stands_beside_the_changed_vehicle_and_a_verdict_under_them() -> (
    None
):
    changes = "--set tireFric=1.1 --set mass=2600 --set dragCoeff=0.301"
    text = run(f"simulate rain {changes} --details").stdout
    assert (
        "The original vehicle stops, with a safety degree (smallest distance) of 2.01 m"
        in text
    )
    assert "The changed vehicle is less safe" in text
    said = " ".join(text.replace("│", " ").split())
    assert "(f_num_diff) count dragCoeff = 0.301 as unchanged" in said
    assert "changed vehicle" not in run("simulate rain").stdout
    hit, stop = (sv.simulate("native", {"decel": value}) for value in (4.5, 8))
    assert (hit.outcome, hit.gap) == ("collision", 0), "the vehicle is 4.7 m long"
    gap = stop.gap
    assert (stop.outcome, gap) == (
        "stopped",
        pytest.approx(stop.metrics["safety_degree"] - 4.7),
    )
    lead = run("simulate native --set decel=8").stdout
    assert (
        f"{gap + 4.7:.2f} m from centre to centre (gap {gap:.2f} m). The original vehicle"
        in lead
    )


@SLOW
def test_an_output_that_fails_leaves_the_old_file_and_no_new_one(
    in_tmp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace = os.replace

    def full(source: Path, target: Path) -> None:
        if target.parent == in_tmp:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    for flag, name in (
        ("--trace", "trace.csv"),
        ("--plot", "plot.png"),
        ("--animate", "film.html"),
    ):
        refused(
            f"simulate sun {flag} {name}",
            flag,
            name,
            "No space left on device",
            "with space for it",
        )
        assert list(in_tmp.iterdir()) == []
        write(name, "old")
        refused(f"simulate sun {flag} {name}", flag, name)
        assert Path(name).read_text() == "old"
        Path(name).unlink()


@pytest.fixture
def study() -> Study:
    return load_study("rain", search={"runs": 2, "evaluations": 1000})


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """What the time is: change its only element."""
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    return now


def shown(clock: list[float], width: int) -> list[str]:
    """What a terminal shows of a study whose journals hold 300 of 6000 evaluations, and then 100
    more every ten seconds.
    """
    out = StringIO()
    console = Console(file=out, force_terminal=True, width=width, _environ={})
    with open_progress(True, console) as show:
        for done in range(300, 900, 100):
            show("rain: 1 of 6 runs", done, 6000)
            clock[0] += 10
    return [
        re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", line).rstrip()
        for line in out.getvalue().splitlines()
    ]


@pytest.mark.parametrize("width", [120, 80])
def test_on_a_terminal_all_fits_in_its_line(width: int, clock: list[float]) -> None:
    """Of 6000 simulations 5200 are left, at 10 a second."""
    lines = shown(clock, width)
    assert re.fullmatch(
        r"rain: 1 of 6 runs [━╸╺ ]+ 800 of 6,000 0:08:30 left",
        [line for line in lines if "rain" in line][-1],
    )
    assert max(map(len, lines)) <= width


def test_before_a_total_is_known_a_terminal_says_searching() -> None:
    out = StringIO()
    with open_progress(
        True, Console(file=out, force_terminal=True, width=80, _environ={})
    ):
        pass
    last = (
        re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", out.getvalue()).splitlines()[-1].rstrip()
    )
    assert re.fullmatch(r"searching [━╸╺ ]+", last)


@SLOW
def test_what_user_code_prints_leaves_the_json_alone(
    in_tmp: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Also what other processes and compiled code print."""
    write(
        "loud.py",
        "import os\nfrom safevar_sumo.ads import ScalarAds\n\nprint('loaded')\n\n\nclass"
        " Loud(ScalarAds):\n    def drive(self, seen):\n        print('drives')\n       "
        " os.write(1, b'writes')\n        return 0.3, 0.0\n",
    )
    write("loud.toml", 'extends = "smoke"\nname = "loud"\n[ads]\nmodel = "loud:Loud"\n')
    for question in "simulate loud.toml", "risk loud.toml --samples 4 --jobs 1":
        assert json_of(question)["question"] in question
        out, err = capfd.readouterr()
        assert "writes" in err
        assert not out


@pytest.mark.parametrize(
    "command", [name for name in COMMANDS if contents_of(command_function(name))]
)
def test_names_of_no_table_and_no_number_are_refused_before_anything_is_loaded(
    command: str,
) -> None:
    """The subjects do not exist, and the message names what there is."""
    subjects = "nothing " * (2 if command in ("compare", "validate") else 1)
    declared = contents_of(command_function(command))
    told = "--table: there is no table 'nope'"
    refused(f"{command} {subjects} --table nope", told, *declared.tables)
    if ... not in declared.numbers:
        told = "--fail-if: the answer has no number 'nope'"
        refused(f"{command} {subjects} --fail-if 'nope > 1'", told)


def test_every_command_that_gives_an_answer_declares_its_names() -> None:
    gives = [
        name
        for name in COMMANDS
        if "Answer" in str(inspect.signature(command_function(name)).return_annotation)
    ]
    assert [name for name in COMMANDS if contents_of(command_function(name))] == gives


@pytest.mark.parametrize("key", ["results.nope", "drac"])
def test_a_key_that_the_study_of_a_simulation_has_not_is_refused_before_it_drives(
    key: str, in_tmp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("safevar_sumo.replay.simulate.simulate_with_original", None)
    refused(
        f"simulate smoke --fail-if '{key} > 1'",
        f"--fail-if: the answer has no number '{key}'",
    )


def test_a_metric_of_the_study_is_a_key_of_its_simulations(in_tmp: Path) -> None:
    write("mine.toml", 'extends = "smoke"\nname = "mine"\n[metrics]\nalso = ["drac"]\n')
    assert (
        "failed: drac = "
        in run("simulate mine.toml --fail-if 'drac > 0'", expect=3).stderr
    )


def test_a_log_has_command_versions_stages_and_warnings_of_each_call(
    in_tmp: Path,
) -> None:
    Path("log.txt").write_text("of others\n")
    for seed in (1, 2):
        run(
            f"study smoke --algorithms rs --runs 1 --seed {seed} --out r{seed} --log log.txt"
        )
    run("simulate r1 --set tireFric=1 --log log.txt")
    log = Path("log.txt").read_text()
    assert log.startswith("of others\n")
    for seed in (1, 2):
        assert (
            f"study smoke --algorithms rs --runs 1 --seed {seed} --out r{seed} --log log.txt"
            in log
        )
    assert log.count(f"with safevar_sumo {sv.__version__}, libsumo 1.28.0") == 3
    assert len(re.findall(r"smoke: search of \d+ runs with 2 workers into r", log)) == 2
    assert len(re.findall(r"smoke: searched in [\d.]+ s$", log, re.MULTILINE)) == 2
    assert len(re.findall(r"ended after [\d.]+ s$", log, re.MULTILINE)) == 3
    for folder in ("r1", "r2"):
        assert not [path for path in Path(folder).rglob("*") if "log" in path.name]


def test_verbose_shows_stages_and_more_batches_and_silence_is_the_default() -> None:
    stage = "sampling vehicles: 20 simulations"
    batch = "smoke: 20 settings simulated"
    shown = [
        run(f"risk smoke --samples 20 --simulations 60 {flags}").stderr
        for flags in ("", "-v", "-vv")
    ]
    assert [stage in text for text in shown] == [False, True, True]
    assert [batch in text for text in shown] == [False, False, True]
