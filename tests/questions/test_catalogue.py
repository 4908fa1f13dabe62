"""Characteristics as a supplier and a workshop know them: their names, how they are measured, and
what is done with a vehicle beyond a limit.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from safevar_sumo.results.identity import evaluation_keys
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.study import tables_of
from tests.support.in_process import json_of, run

OWN = """
extends = "native"
name = "native"
[vehicle.characteristics]
mass = { short_name = "towed load", measurement = "weighbridge", remedy = "leave the trailer" }
tau = { meaning = "", measurement = "" }
"""


def rows_of(study: str) -> dict[str, Any]:
    rows = json_of(f"list characteristics {study}")["tables"]["characteristics"]["rows"]
    return {row["name"]: row for row in rows}


def test_texts_of_a_study_are_listed_and_affect_no_evaluation(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text(OWN)
    rows = rows_of(str(file))
    own = {
        "short_name": "towed load",
        "measurement": "weighbridge",
        "remedy": "leave the trailer",
    }
    assert (
        rows["mass"].items()
        >= {**own, "unit": "kg", "lower": 1300, "upper": 2100}.items()
    )
    assert rows["tau"]["short_name"] == "tau", "without any text, its key is its name"
    printed = run(f"list characteristics {file}").stdout
    assert "weighbridge" in printed
    assert "trailer" in printed
    keys = [
        evaluation_keys(tables_of(read_study(name))) for name in ("native", str(file))
    ]
    assert keys[0] == keys[1]
