"""Runs whose evaluations are formulas: in any shares, alone and together, with more or fewer
evaluations.
"""

from __future__ import annotations

import dataclasses
import re
import sys
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng
from pandas.testing import assert_frame_equal

from safevar_sumo.api.simulation import load_study
from safevar_sumo.campaign import RunKey, evaluation
from safevar_sumo.campaign.batches import Batches
from safevar_sumo.campaign.campaign import deal
from safevar_sumo.campaign.runs import Run
from safevar_sumo.errors import SafevarError
from safevar_sumo.metrics import PUBLISHED_SCORING
from safevar_sumo.records import Outcome
from safevar_sumo.results import Journal, journal_file, journal_head, load_runs
from safevar_sumo.search import ALGORITHMS
from safevar_sumo.study import Study
from tests.support.formulas import (
    FormulaPool,
    carried_out,
    evaluated,
    solutions,
    with_search,
)
from tests.support.in_process import SLOW, InlinePool, searched
from tests.support.made_up import SUN


@pytest.fixture
def study() -> Study:
    return load_study("smoke", search={"algorithms": sorted(ALGORITHMS)})


def test_runs_of_a_share_share_batches(study: Study, tmp_path: Path) -> None:
    large = with_search(
        study, population=40, evaluations=400, runs=10, algorithms=["rs"]
    )
    together = FormulaPool(workers=2)
    alone = FormulaPool(workers=2)
    carried_out(large, tmp_path / "together", together)
    carried_out(large, tmp_path / "alone", alone, keys=[RunKey("rs", 3)])
    assert np.mean(together.sizes[1:]) > 3 * large.search.population
    assert alone.sizes[1:3] == [40, 40]
    one, other = (
        load_runs(tmp_path / name).evaluations.query("algorithm == 'rs' and run == 3")
        for name in ("together", "alone")
    )
    assert_frame_equal(one.reset_index(drop=True), other.reset_index(drop=True))


@pytest.mark.parametrize(
    ("workers", "runs_at_once", "sizes"),
    [
        (2, 160, {45}),
        (16, 160, {5, 6}),
        (200, 160, {1}),
        (2, 8, {7, 8}),
    ],
)
def test_runs_are_dealt_in_equal_shares_with_equally_many_runs_of_each_algorithm(
    workers: int, runs_at_once: int, sizes: set[int]
) -> None:
    keys = [
        RunKey(name, run)
        for name in ("nsga2", "rs", "safe_fuzzer")
        for run in range(30)
    ]
    shares = deal(keys, workers, batch_size=50 * runs_at_once, population=100)
    assert sorted(key for share in shares for key in share) == sorted(keys)
    assert {len(share) for share in shares} == sizes
    assert workers > 90 or len(shares) % workers == 0
    for share in shares:
        numbers = Counter(key.algorithm for key in share)
        assert len(share) < 3 or max(numbers.values()) - min(numbers.values()) <= 1


@SLOW
def test_a_run_in_other_hands_is_left_to_them_and_named(
    study: Study, tmp_path: Path
) -> None:
    study = with_search(study, algorithms=["nsga2", "rs"])
    carried_out(study, tmp_path / "whole")
    carried_out(study, tmp_path / "out", keys=[RunKey("rs", 1)])
    path = journal_file(tmp_path / "out", "rs-01")
    theirs = path.read_bytes()
    journal = Journal(path, evaluation.msgspec.json.decode(theirs.partition(b"\n")[0]))
    with pytest.raises(
        SafevarError, match=r"rs-01\.jsonl: another process works on this run"
    ):
        carried_out(study, tmp_path / "out")
    journal.close()
    assert [*path.parent.iterdir()] == [path], "no other run has begun"
    assert path.read_bytes() == theirs
    carried_out(study, tmp_path / "out")
    assert solutions(tmp_path / "out") == solutions(tmp_path / "whole")


@SLOW
@pytest.mark.parametrize("budgets", [(55, 130), (100, 60)])
def test_more_or_fewer_evaluations_go_on_and_end_as_if_there_had_never_been_others(
    study: Study, tmp_path: Path, budgets: tuple[int, int]
) -> None:
    first, second = (
        with_search(study, evaluations=budget, runs=1) for budget in budgets
    )
    before = FormulaPool()
    after = FormulaPool()
    carried_out(first, tmp_path / "out", before)
    carried_out(second, tmp_path / "out", after)
    carried_out(second, tmp_path / "fresh")
    assert solutions(tmp_path / "out") == solutions(tmp_path / "fresh")
    results = load_runs(tmp_path / "out")
    assert_frame_equal(results.evaluations, load_runs(tmp_path / "fresh").evaluations)
    assert not {*before.received[1:]} & {*after.received[1:]}, "the original apart"
    carried_out(first, tmp_path / "out", FormulaPool(limit=1))


def test_progress_has_its_total_from_the_start_and_begins_with_the_journals(
    study: Study, tmp_path: Path
) -> None:
    study = with_search(study, algorithms=["rs"])
    shown = list[tuple[str, int, int]]()
    carried_out(study, tmp_path, keys=[RunKey("rs", 0)])
    carried_out(study, tmp_path, progress=lambda *values: shown.append(values))
    assert shown[0] == ("smoke: 1 of 2 runs", 100, 200)
    assert shown[-1] == ("smoke: 2 of 2 runs", 200, 200)


@pytest.mark.parametrize(
    "outcome", [Outcome.COLLISION, Outcome.INVALID_TEST, Outcome.SIMULATOR_ERROR]
)
def test_what_a_longer_run_found_after_its_budget_is_not_counted(
    outcome: Outcome, tmp_path: Path
) -> None:
    """A journal of two settings, and a run of one evaluation."""
    both = evaluated(np.stack([SUN.original, SUN.upper]))
    both = dataclasses.replace(both, outcome=np.array(["stopped", outcome.value]))
    head = journal_head("study", "rs-00", SUN.names)
    journal = Journal(tmp_path / "rs-00.jsonl", head)
    journal.append([0, 1], both)
    journal.finish([0], 1)
    journal.close()
    run = Run(
        RunKey("rs", 0), iter(()), Journal(journal.path, head), 1, PUBLISHED_SCORING
    )  # type: ignore[arg-type]
    result = run.finish(default_rng(0))
    for found in (result.solutions, result.sample):
        assert np.array_equal(found.settings, both.settings[:1])


def test_a_search_that_asks_for_other_settings_than_its_journal_holds_is_refused(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = with_search(study, algorithms=["rs"], runs=1)
    carried_out(study, tmp_path, batch=3)
    path = journal_file(tmp_path, "rs-00")
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:5]))
    monkeypatch.setattr(
        "safevar_sumo.campaign.share.random_generator_of",
        lambda study, key: default_rng(7),
    )
    with pytest.raises(
        SafevarError,
        match=r"rs-00\.jsonl: holds other settings than this search requests",
    ):
        carried_out(study, tmp_path)


ROOT = Path(__file__).parents[2]
PACKAGE = f"{ROOT / 'safevar_sumo'}/"
ENDS = {
    "vehicles/characteristics.py": (
        "CharacteristicSet.filter",
        "CharacteristicSet.largest_change",
        "CharacteristicSet.number_changed",
    ),
    "vehicles/base.py": ("Vehicle.at_start",),
    "vehicles/carla.py": ("Carla.prepare", "Carla.sense", "Carla.advance"),
    "scenarios/published.py": (
        "PedestrianCrossing.observe",
        "PedestrianCrossing.encounter",
    ),
    "ads/published.py": ("WorldOnRails.drive",),
    "sumo/perception.py": ("Perception.observe",),
    "sumo/recorded_world.py": ("RecordedWorld.enter", "RecordedWorld.step"),
    "sumo/bodies.py": ("FirstContacts.count",),
    "sumo/drive.py": (
        "_Log.write",
        "_Log.trace",
        "_Outcomes.note_sample",
        "_Outcomes.classify",
    ),
    "results/journal.py": ("Journal.append", "Journal.finish"),
    "results/store.py": ("evaluations_frame",),
    "results/manifest.py": ("write_whole",),
}
"""Where a setting, or what became of it, leaves the package's way: into a model, a metric, or a
file.
"""
BESIDE = "repeat_in_sumo"
"""Verification takes a way of its own."""


def functions_on_the_stack(frame: FrameType | None) -> list[tuple[str, str]]:
    """The package's functions on the stack, up to the campaign, which a worker may carry out
    elsewhere.
    """
    functions = []
    while frame is not None:
        file = frame.f_code.co_filename
        name = frame.f_code.co_qualname
        if file.startswith(PACKAGE) and not frame.f_code.co_name.startswith("<"):
            functions.append((file.removeprefix(PACKAGE), name))
        frame = frame.f_back
    return functions


def listed() -> list[tuple[str, str]]:
    """The functions in the table of the manual, in its order: a file in the second column, its
    functions in the third.
    """
    section = (
        (ROOT / "docs/architecture.md")
        .read_text()
        .partition("## The path of a value")[2]
        .partition("\n## ")[0]
    )
    rows = re.findall(r"^\|.*\| `([\w/]+\.py)` \| (.+) \|$", section, re.MULTILINE)
    return [
        (file, name)
        for file, names in rows
        for name in re.findall(r"`([\w.]+)`", names)
    ]


def test_the_way_of_a_setting_is_the_one_in_the_manual(tmp_path: Path) -> None:
    study = load_study(
        "rain",
        search={"algorithms": ["nsga2"], "population": 4, "evaluations": 8, "runs": 1},
    )
    way = dict[tuple[str, str], None]()

    def note(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call":
            file = frame.f_code.co_filename
            name = frame.f_code.co_qualname
            if file.startswith(PACKAGE) and name in ENDS.get(
                file.removeprefix(PACKAGE), ()
            ):
                functions = functions_on_the_stack(frame)
                names = [name for _, name in functions]
                if BESIDE not in names and (
                    "carry_share" in names or "ResultsDirectory.finish" in names
                ):
                    start = names.index(
                        "carry_share"
                        if "carry_share" in names
                        else "ResultsDirectory.finish"
                    )
                    way.update(dict.fromkeys(functions[start::-1]))

    sys.setprofile(note)
    try:
        searched(study, tmp_path)
    finally:
        sys.setprofile(None)
    assert list(way) == listed(), "in the order of their first call"
    assert len(way) <= 40


@pytest.mark.parametrize(
    ("batches", "settings", "workers", "number"),
    [
        # Vehicles in a recorded scene take the same steps together.
        (Batches(4000, True, True), 1000, 8, 1),
        (Batches(4000, True, True), 1001, 2, 2),
        (Batches(4000, True, True), 80_000, 2, 20),
        (
            Batches(4000, False, True),
            300,
            2,
            2,
        ),  # those of a `ScalarAds` take turns, as do copies in SUMO
        (Batches(200, False, False), 10, 4, 4),
        (Batches(200, False, False), 1, 4, 1),
    ],
)
def test_a_small_batch_is_divided_only_where_that_saves_time(
    batches: Batches, settings: int, workers: int, number: int
) -> None:
    assert batches.number(settings, InlinePool(workers)) == number
