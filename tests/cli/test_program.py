"""The program itself: what it lists, and what it loads."""

from __future__ import annotations

import ast
import importlib
import json
import pkgutil
import re
import subprocess
import sys
from io import StringIO
from pathlib import Path

import click
import pytest
from click.shell_completion import ShellComplete
from click.testing import CliRunner
from rich.console import Console

from safevar_sumo import cli
from safevar_sumo.cli import catalogue
from safevar_sumo.cli.program import COMMANDS, commands, main
from safevar_sumo.errors import InputError
from safevar_sumo.study import load_study, study_names
from safevar_sumo.terminal import WholeTable
from tests.in_process import refused

ROOT = Path(__file__).parents[2]
HEAVY = {"libsumo", "traci", "matplotlib", "pandas", "scipy", "seaborn", "cma"}


def loaded(code: str) -> set[str]:
    """Which of the heavy packages a fresh interpreter has loaded after some code."""
    result = f"import sys\n{code}\nprint(*(set(sys.modules) & {HEAVY!r}))"
    return set(
        subprocess.run([sys.executable, "-c", result], capture_output=True, text=True, check=True)
        .stdout.splitlines()[-1]
        .split()
    )


def test_every_command_is_listed_and_every_listed_one_is_there() -> None:
    for module in pkgutil.iter_modules(cli.__path__):
        importlib.import_module(f"safevar_sumo.cli.{module.name}")
    assert set(commands.commands) == set(COMMANDS)
    output = " ".join(CliRunner().invoke(commands, ["--help"]).stdout.split())
    for name, (_, sentence) in COMMANDS.items():
        assert f" {name} {sentence}" in output
        assert sentence.endswith(".")


@pytest.mark.parametrize("command", list(COMMANDS))
def test_every_command_and_each_of_its_options_has_a_whole_sentence_of_help(command: str) -> None:
    results = commands.get_command(None, command)  # type: ignore[arg-type]
    assert results is not None
    assert str(results.help).strip().endswith(".")
    result = CliRunner().invoke(commands, [command, "--help"])
    assert result.exit_code == 0
    for option in results.params:
        sentence = isinstance(option, click.Argument) or str(option.help).endswith((".", "]"))  # type: ignore[attr-defined]
        assert sentence, option.name


def test_the_package_and_the_help_load_nothing_heavy() -> None:
    assert loaded("import safevar_sumo") == set()
    assert loaded("import safevar_sumo.cli") == set()


def test_a_subject_that_is_nothing_is_refused_in_plain_words() -> None:
    with pytest.raises(
        InputError, match=r"rian: is neither a results directory, a study nor a file; did you mean 'rain'\?"
    ):
        commands.main(["rules", "rian"], standalone_mode=False)


@pytest.mark.slow
def test_one_simulation_loads_sumo_and_no_statistics() -> None:
    code = "from click.testing import CliRunner\nfrom safevar_sumo.cli.program import commands\n"
    assert loaded(code + "print(CliRunner().invoke(commands, ['list']).exit_code)") == set()
    assert loaded(code + "print(CliRunner().invoke(commands, ['simulate', 'sun', '--json']).exit_code)") <= {
        "libsumo",
        "traci",
    }


def test_what_the_library_says_of_a_parameter_is_said_of_its_flag(in_tmp: Path) -> None:
    Path("file").write_text("")
    for arguments in (
        ["import", "native", "--rs", "x.csv", "--out", "o", "--original", "sd"],
        ["study", "smoke", "--cluster", "nowhere"],
        ["study", "smoke", "--out", "file"],
    ):
        result = CliRunner().invoke(commands, arguments).exception
        assert isinstance(result, InputError)
        assert result.source == arguments[-2]


def test_errors_of_the_library_speak_of_arguments_and_not_of_flags() -> None:
    for file in (ROOT / "safevar_sumo").rglob("*.py"):
        if "cli" not in file.parts:
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id.endswith("Error"):
                    assert not re.search(r"--[a-z]", re.sub(r"`[^`]*`", "", ast.unparse(node))), f"{file}:{node.lineno}"


@pytest.mark.parametrize(
    ("typed", "says"),
    [
        ("simulate rian", "did you mean 'rain'?"),
        ("explain rian", "did you mean 'rain'?"),
        ("simlate rain", "did you mean 'simulate'?"),
        ("simulate rain --set tirefric=1", "did you mean 'tireFric'?"),
        ("tolerance rain --characteristics mas", "did you mean 'mass'?"),
        ("report results/rain --only verdct", "did you mean 'verdict'?"),
        ("simulate weather.toml", "did you mean 'fog'?"),
        ("simulate model.toml", "did you mean 'world_on_rails'?"),
        ("simulate key.toml", "runns: there is no such key; did you mean 'runs'?"),
        (
            "simulate rain --set mass=+8",
            "is outside its domain\nexpected: a number in [2040, 2700] kg, or mass=+8% of the original, or any "
            "with --beyond",
        ),
        ("simulate rain --set mass=2000", "a number in [2040, 2700] kg, or any with --beyond"),
        ("rating euro_ncap_rating --set treadDepth=300", "is outside its domain\nexpected: a number in [1.6, 8] mm\n"),
        ("rating euro_ncap_rating --set treadDepth", "NAME=+10% of the original\n"),
        ("tables smoke", "did you mean results/smoke?"),
        ("status smoke", "did you mean results/smoke?"),
    ],
)
def test_an_error_names_what_was_probably_meant(
    typed: str, says: str, in_tmp: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, text in (
        ("weather", 'weather = "fogg"'),
        ("model", '[ads]\nmodel = "world_on_rail"'),
        ("key", "[search]\nrunns = 3"),
    ):
        Path(f"{name}.toml").write_text(f'extends = "sun"\n{text}\n')
    results = in_tmp / "results" / "smoke"
    results.mkdir(parents=True)
    (results / "manifest.json").write_text("{}")
    monkeypatch.setattr(sys, "argv", ["safevar-sumo", *typed.split()])
    with pytest.raises(SystemExit) as ended:
        main()
    result = capsys.readouterr().err
    assert ended.value.code == 2
    assert says in result


@pytest.mark.parametrize(
    ("words", "incomplete", "expected"),
    [
        ([], "s", {name for name in COMMANDS if name.startswith("s")}),
        (["study"], "ra", {"rain"}),
        (["simulate"], "su", {"sun"}),
        (["simulate", "native", "--set"], "t", {"tau="}),
        (["simulate", "sun", "--set"], "ma", {"mass=", "max_rpm=", "maxBrakeTorque="}),
        (["simulate", "nothing", "--set"], "t", set()),
        (["validate"], "lg", {"lgsvl"}),
    ],
)
def test_names_complete(words: list[str], incomplete: str, expected: set[str]) -> None:
    result = ShellComplete(commands, {}, "safevar-sumo", "_SAFEVAR_SUMO_COMPLETE").get_completions(words, incomplete)
    assert expected == {item.value for item in result if item.type == "plain"} or expected <= {
        item.value for item in result
    }


def printed(table: WholeTable, width: int) -> list[str]:
    console = Console(file=StringIO(), width=width, _environ={})
    console.print(table)
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined, no-any-return]


def test_80_columns_break_no_word_of_a_heading() -> None:
    algorithms = ["nsga2", "rs", "safe_fuzzer", "map_elites", "mocell", "spea2"]
    title = "Euro NCAP pedestrian, day and night: CARLA's LincolnMkz2017 with an AEB"
    table = WholeTable("", right=["original vehicle", *algorithms], title=title)
    table.add_row("solutions that collide", *["12.34"] * 7)
    console = Console(file=StringIO(), width=80)
    console.print(table)
    heading, _, head, *_ = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert heading == title
    assert [name.strip() for name in head.split("┃")[3:-1]] == algorithms
    assert len(head) <= 80


@pytest.mark.parametrize("width", [40, 60, 200])
def test_names_stay_whole_and_the_rest_goes_on_in_the_next_line(width: int) -> None:
    table = WholeTable("characteristic", "here", "what [red]it[/red] is")
    table.add_row("dampRateZeroT_CE [kg m^2/s]", "1.1688135797930421", "abcdefghijklmnopqrstuvwxyz" * 2)
    lines = printed(table, width)
    assert max(map(len, lines)) <= width
    assert any("│ dampRateZeroT_CE" in line for line in lines)
    letters = "".join(line.rpartition("│")[0].rpartition("│")[2].strip() for line in lines)
    assert letters == "abcdefghijklmnopqrstuvwxyz" * 2
    assert "…" not in "".join(lines)


def test_every_name_of_the_list_can_be_read_and_typed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(catalogue.VEHICLES, "in_no_study", catalogue.VEHICLES["sumo"])
    output = CliRunner(env={"COLUMNS": "80"}).invoke(commands, ["list"], catch_exceptions=False).stdout
    assert "Vehicle in_no_study" in output, "a vehicle without a study has no characteristics to explain"
    assert "┃ name            ┃ friction ┃ visibility ┃ delay, s    ┃ light ┃ road ┃" in output
    assert "…" not in output
    for name in ("f_safe", "f_comfort", "f_diff", "rating_points"):
        assert f"│ {name} " in output.partition("Objectives")[2]
    for name in study_names():
        study = load_study(name)
        for text in (name, study.vehicle.model, study.ads.model, study.scenario.model, *study.vehicle.characteristics):
            assert text in output


def test_a_section_of_the_list_comes_alone() -> None:
    def listed(*arguments: str) -> str:
        return CliRunner().invoke(commands, ["list", *arguments], catch_exceptions=False).stdout

    assert re.findall(r"^(\w+)", listed("weathers"), re.MULTILINE) == ["Weathers", "carla_hard_rain"]
    assert "carla_hard_rain: no effect on road and sensors" in listed("weathers")
    assert re.findall(r"^(\w+)", listed("ads"), re.MULTILINE) == ["ADSs"]
    assert list(json.loads(listed("studies", "--json"))) == ["studies"]
    assert "'weathers'" in str(CliRunner().invoke(commands, ["list", "weather"], standalone_mode=False).exception)


@pytest.mark.parametrize(
    "arguments",
    [
        "validate sun folder",
        "import sun --out published --rs folder",
        "simulate folder",
        "tables folder",
        "status folder",
        "simulate smoke --trace folder.csv",
        "tolerance smoke --plot folder.png",
        "study smoke --out file",
        "figures file --out folder",
    ],
)
def test_a_folder_is_no_file_and_a_file_no_folder(arguments: str, in_tmp: Path) -> None:
    for folder in ("folder", "folder.csv", "folder.png"):
        Path(folder).mkdir()
    Path("file").touch()
    refused(*arguments.split(), message=(arguments.rpartition(" ")[2] if "figures" not in arguments else "file",))


def test_the_program_runs_where_stderr_is_no_file() -> None:
    code = (
        "import contextlib, io, sys; from safevar_sumo.__main__ import main; sys.argv = ['safevar-sumo', '--version']\n"
        "with contextlib.redirect_stderr(io.StringIO()): main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, "version" in done.stdout) == (0, True), done.stderr
