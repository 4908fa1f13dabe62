"""What `simulate` is told, and what it tells."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from safevar_sumo.cli.arguments import read_changes
from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError
from safevar_sumo.study import load_study
from safevar_sumo.vehicles import CharacteristicSet
from tests.in_process import refused

SUN = CharacteristicSet.of(load_study("sun").vehicle.characteristics)


def simulate(*arguments: str) -> Result:
    return CliRunner(env={"COLUMNS": "80"}).invoke(commands, ["simulate", *arguments])


@pytest.mark.parametrize(
    ("change", "values"),
    [
        ("mass=2500", [2500.0]),
        ("mass=+10%", [2644.4]),
        ("mass=-5%", [2283.8]),
        ("tireFric=1.0..1.5:3", [1.0, 1.25, 1.5]),
        ("tireFric=1.5..1:2", [1.5, 1.0]),
        ("tireFric = 1.0..2.0", [1 + i / 10 for i in range(11)]),
        ("mass=2.5e3", [2500.0]),
    ],
)
def test_a_change_is_a_value_a_share_or_a_sweep(change: str, values: list[float]) -> None:
    (result,) = read_changes((change,), SUN, beyond=False).values()
    assert result == pytest.approx(values)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (("mass",), "NAME=VALUE"),
        (("mass=",), "NAME=VALUE"),
        (("mass=10%",), "NAME=VALUE"),
        (("mass=1..",), "NAME=VALUE"),
        (("mass=2300", "mass=2400"), "mass is set twice"),
        (("weight=1",), "weight"),
        (("mass=+50%",), "mass = 3606"),
        (("mass=2100..9000",), "mass = 2790"),
        (("mass=2100..2200:999", "tireFric=1..2:999"), "more than 10000 settings"),
        (("mass=nan",), "NAME=VALUE"),
        (("mass=2_500",), "NAME=VALUE"),
    ],
)
def test_a_change_that_cannot_be_used_is_told(changes: tuple[str, ...], expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        read_changes(changes, SUN, beyond=False)


def test_the_original_stands_beside_the_changed_vehicle_and_a_verdict_under_them() -> None:
    result = simulate("rain", "--set", "tireFric=1.1", "--set", "mass=2600", "--set", "dragCoeff=0.301")
    assert "original" in result.stdout
    assert "The original vehicle stops, with a safety degree of 1.93 m" in result.stdout
    assert "less safe than the original" in result.stdout
    assert (
        "note: dragCoeff = 0.301 differs from the original by less than the filter threshold and was reset to 0.3"
        in result.stderr
    )
    assert "changed vehicle" not in simulate("rain").stdout
    assert " m from centre to centre." in simulate("native").stdout


def test_an_output_that_fails_leaves_the_old_file_and_no_new_one(in_tmp: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace = os.replace

    def full(source: Path, target: Path) -> None:
        if target.parent == in_tmp:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    for flag, name in (("--trace", "trace.csv"), ("--plot", "plot.png"), ("--animate", "film.html")):
        refused("simulate", "sun", flag, name, message=(flag, name, "No space left on device", "with space for it"))
        assert list(in_tmp.iterdir()) == []
        Path(name).write_text("old")
        refused("simulate", "sun", flag, name, message=(flag, name))
        assert Path(name).read_text() == "old"
        Path(name).unlink()


@pytest.mark.slow
def test_a_sweep_is_a_table_under_the_original_or_a_list() -> None:
    result = simulate("rain", "--set", "tireFric=1.0..1.5:3", "--json")
    records = json.loads(result.stdout)
    assert [one["vcs"]["tireFric"] for one in records] == [1.0, 1.25, 1.5]
    single = json.loads(simulate("rain", "--set", "tireFric=1.25", "--json").stdout)
    assert records[1] == single
    rows = [
        line.split("│")
        for line in simulate("rain", "--set", "tireFric=1.0..1.5:3").stdout.splitlines()
        if line.startswith("│")
    ]
    assert [float(row[1]) for row in rows] == [3.5, 1.0, 1.25, 1.5]


def test_no_output_replaces_a_study_or_solutions(in_tmp: Path) -> None:
    Path("solutions.csv").write_text("stored")
    for flag, file in (("--trace", "mine.toml"), ("--plot", "mine.toml"), ("--trace", "solutions.csv")):
        refused("simulate", "smoke", flag, file, message=(flag, file))
    assert Path("solutions.csv").read_text() == "stored"
    assert not Path("mine.toml").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("simulate", "sun", "--set", "tireFric=1..2:1"), ("tireFric=1..2:1", "at least 2")),
        (("simulate", "sun", "--set", "mass=2_404"), ("mass=2_404",)),
        (("simulate", "sun", "--slower", "2"), ("--slower", "--gui")),
        (("simulate", "sun", "--set", "mass=2100..2200", "--trace", "x.csv"), ("--set", "is a sweep")),
        (("risk", "sun", "--confidence", "nan"), ("--confidence", "nan", "below 1")),
        (("study", "smoke", "--algorithms", "rs,rs", "--dry-run"), ("search.algorithms", "same name")),
        (("tolerance", "sun", "--characteristics", "mass,mass"), ("characteristics", "mass,mass", "once")),
        (("tolerance", "sun", "--characteristics", "mass", "--pairs"), ("pairs", "at least two")),
        (("rating", "euro_ncap_rating", "--force"), ("--force", "--xlsx")),
        (("risk", "sun", "--unsafe", "points=1"), ("unsafe", "points=1", "not rated")),
        (("rules", "sun", "--unsafe", "points=1"), ("unsafe", "points=1", "not rated")),
        (("explain", "sun", "--unsafe", "points=1"), ("unsafe", "points=1", "not rated")),
    ],
)
def test_input_that_would_be_ignored_is_refused(arguments: tuple[str, ...], message: tuple[str, ...]) -> None:
    refused(*arguments, message=message)
