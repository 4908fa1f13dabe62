"""Results of shipped studies, to the bit where that is promised: the original vehicle and a small
search. As a program: renews golden.json.

Each entry has rounded values that a person can compare, the reason for the entry (`why`), and
digests of the exact values.
"""

from __future__ import annotations

import json
import platform
import tempfile
from hashlib import sha256
from pathlib import Path

import pandas as pd
import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.campaign.inputs import PLATFORM
from safevar_sumo.records import JsonObject
from safevar_sumo.results import CHOICES, RESULTS, load_runs
from safevar_sumo.study import Study
from tests.support.in_process import searched

WHY = {
    "sun": (
        "the published vehicle and driving system in dry clear weather: the case to which they were"
        " fitted"
    ),
    "rain": "the same in rain: friction, sight, recognition delay and hesitation act",
    "lgsvl": "another vehicle model, driving system and scenario: a lead vehicle stands",
    "native": "SUMO's own car-following model with modelled sensors and actuators",
    "smoke": "the study that a user runs first",
}
"""Studies, each with the reason for its entry."""
FILE = Path(__file__).with_name("golden.json")


def small(name: str) -> Study:
    """A shipped study with a search that takes a second."""
    search = {
        "algorithms": ["nsga2", "rs", "safe_fuzzer"],
        "population": 10,
        "evaluations": 40,
        "runs": 1,
    }
    return load_study(name, search=search)


def computed(name: str) -> JsonObject:
    """The entry of a study: the original vehicle, and every algorithm's solutions."""
    study = small(name)
    with tempfile.TemporaryDirectory() as folder:
        results = load_runs(searched(study, Path(folder)))
    original = results.manifest["original"]
    changed = {
        member: row.original for member, row in study.vehicle.characteristics.items()
    }
    solutions = {
        str(algorithm): _of_algorithm(rows, changed)
        for algorithm, rows in results.solutions.groupby("algorithm")
    }
    return {
        "why": WHY[name],
        "original": {
            **_rounded(original),
            "digest": _digest(json.dumps(original, sort_keys=True)),
        },
        "solutions": solutions,
    }


def _of_algorithm(rows: pd.DataFrame, original: dict[str, float]) -> JsonObject:
    """The numbers of solutions and of collisions, and the most severe solution: its objectives and
    its changes.
    """
    most_severe = rows.sort_values(CHOICES["most_severe"], kind="stable").iloc[0]
    values = {name: float(most_severe[name]) for name in CHOICES["most_severe"]}
    values |= {
        name: float(most_severe[name])
        for name, value in original.items()
        if most_severe[name] != value
    }
    return {
        "number": len(rows),
        "collisions": int((rows["outcome"] == "collision").sum()),
        "most_severe": _rounded(values),
        "digest": _digest(rows.to_csv(index=False, lineterminator="\n")),
    }


def _rounded(values: JsonObject) -> JsonObject:
    """Round numbers to five digits, enough to see how much a value has changed."""
    return {
        name: float(f"{value:.5g}") if isinstance(value, float) else value
        for name, value in values.items()
    }


def _digest(text: str) -> str:
    return sha256(text.encode()).hexdigest()[:16]


CHANGED = (
    "results changed: if that is meant, raise RESULTS in safevar_sumo/results/identity.py, renew"
    " golden.json and say why"
)
GOLDEN = json.loads(FILE.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", WHY)
def test_a_shipped_studys_results_are_those_of_ever(name: str) -> None:
    here = computed(name)
    expected = GOLDEN["studies"][name]
    numbers = {
        key: value
        for key, value in expected["original"].items()
        if isinstance(value, float)
    }
    assert {key: here["original"][key] for key in numbers} == pytest.approx(
        numbers, rel=1e-4
    ), "other results, not only other bits"
    if GOLDEN["platform"] == PLATFORM:
        assert here == expected, CHANGED


def test_results_and_the_number_that_stands_for_them_change_together() -> None:
    assert GOLDEN["results"] == RESULTS, (
        "RESULTS is not the one of golden.json: renew it with python -m tests.golden.test_golden"
    )


@pytest.mark.skipif(
    (platform.system(), platform.machine()) != ("Linux", "x86_64"),
    reason="bytes are promised for Linux on x86-64",
)
def test_this_is_the_platform_that_bytes_are_promised_for() -> None:
    assert GOLDEN["platform"] == PLATFORM, (
        "the C library rounds powers differently: NSGA-II finds other last bits here"
    )


if __name__ == "__main__":
    studies = {name: computed(name) for name in WHY}
    if studies != GOLDEN["studies"] and GOLDEN["results"] == RESULTS:
        raise SystemExit(
            "results have changed: raise RESULTS in safevar_sumo/results/identity.py above"
            f" {RESULTS} first"
        )
    golden = {"platform": PLATFORM, "results": RESULTS, "studies": studies}
    FILE.write_text(json.dumps(golden, indent=2) + "\n", encoding="utf-8", newline="\n")
