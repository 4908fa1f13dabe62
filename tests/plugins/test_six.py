"""One member of every kind from a folder outside the package: a study, its tables and figures; and the same as members of the package."""

from __future__ import annotations

import importlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import safevar_sumo as sv
from safevar_sumo import ads, metrics, scenarios, search, vehicles
from safevar_sumo.cli.program import commands
from tests.plugins.beside import InThisProcess

SIX = Path(__file__).parent / "six"
MEMBERS = {"my_vehicle:Cart": vehicles.VEHICLES, "my_ads:Careful": ads.ADS, "my_scenario:Wall": scenarios.SCENARIOS,
           "my_metrics:JERK": metrics.METRICS, "my_objective:MEAN": vehicles.CHANGES, "my_search:Halving": search.ALGORITHMS}


@pytest.fixture(params=["outside", "in the package"])
def study(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The study file; where its members are in the package, they are so in this process alone."""
    folder = Path(shutil.copytree(SIX, tmp_path / "six"))
    monkeypatch.chdir(tmp_path)
    if request.param == "outside":
        return folder / "mine.toml"
    monkeypatch.syspath_prepend(str(folder))
    text = (folder / "mine.toml").read_text()
    for name, mapping in MEMBERS.items():
        module, _, attribute = name.partition(":")
        member = getattr(importlib.import_module(module), attribute)
        short = getattr(member, "name", attribute)
        monkeypatch.setitem(mapping, short, member)  # type: ignore[arg-type]
        text = text.replace(name, short)
    (tmp_path / "mine.toml").write_text(text)
    return tmp_path / "mine.toml"


def command(*arguments: str) -> str:
    done = CliRunner().invoke(commands, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


def test_a_study_of_six_members_from_outside(study: Path, tmp_path: Path) -> None:
    told = json.loads(command("simulate", str(study), "--set", "grip=5", "--json"))
    assert told["jerk"] > 0
    assert told["mean_change"] == pytest.approx(3 / 8 / 3)
    assert "m/s^3" in command("simulate", str(study))

    results = search_in_this_process(study, tmp_path / "out")
    assert set(results.solutions["algorithm"]) == {"nsga2", "Halving"}
    assert {"jerk", "mean_change", "f_diff"} <= set(results.solutions.columns)
    assert np.isfinite(results.solutions[["jerk", "mean_change"]].to_numpy()).all()
    assert results.solutions["f_diff"].max() <= 1 / 2 + 1e-9, "the weight of mass halves its changes"

    for question in ("rq1", "rq2"):
        rows = json.loads(command("tables", str(tmp_path / "out"), "--rq", question, "--format", "json"))
        assert "jerk" in {row["metric"] for row in rows}
        assert "jerk" in command("tables", str(tmp_path / "out"), "--rq", question)
    command("figures", str(tmp_path / "out"), "--out", str(tmp_path / "pictures"))
    assert {path.name for path in (tmp_path / "pictures").iterdir()} >= {"mine-pareto-fronts.png", "mine-convergence.png"}


def search_in_this_process(study: Path, out: Path) -> sv.Results:
    """As `run`, computed here: members that are patched into the package are not in worker processes."""
    from safevar_sumo.api.running import NullObserver, carried_out, prepared
    from safevar_sumo.campaign import all_runs

    chosen, system = prepared(str(study))
    carried_out(chosen, system, all_runs(chosen), out, InThisProcess(), NullObserver(), None)
    return sv.load(out)
