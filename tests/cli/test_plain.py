"""Tables of 80 columns: names that a reader has to type are whole, and nothing is cut off."""

from __future__ import annotations

import re
from io import StringIO

import pytest
from click.testing import CliRunner
from rich.console import Console

from safevar_sumo.cli.program import commands
from safevar_sumo.study import load_study, study_names
from safevar_sumo.terminal import WholeTable


def printed(table: WholeTable, width: int) -> list[str]:
    console = Console(file=StringIO(), width=width, _environ={})
    console.print(table)
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined, no-any-return]


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


def test_a_list_of_names_is_narrowed_no_more_than_it_must() -> None:
    table = WholeTable("minimal cause", "share")
    table.add_row("mass up, tireFric down, radius down", "20 %")
    assert any("mass up, tireFric down, radius" in line for line in printed(table, 44))


def test_every_name_of_the_list_can_be_read_and_typed() -> None:
    told = CliRunner(env={"COLUMNS": "80"}).invoke(commands, ["list"]).stdout
    assert "…" not in told
    for name in study_names():
        study = load_study(name)
        for text in (name, study.vehicle.model, study.ads.model, study.scenario.model, *study.vehicle.characteristics):
            assert text in told


@pytest.mark.parametrize("command", [["list"], ["simulate", "native", "--set", "brakeGain=0.8"]])
def test_what_a_characteristic_is_stands_with_its_name(command: list[str]) -> None:
    done = CliRunner().invoke(commands, command, catch_exceptions=False)
    gain = load_study("native").vehicle.characteristics["brakeGain"]
    assert f"brakeGain {gain.meaning}; counterpart: {gain.counterpart}" in re.sub(r"\s+", " ", done.stdout)
    assert command == ["list"] or "reactionTime age" not in re.sub(r"\s+", " ", done.stdout), "of what is changed alone"
