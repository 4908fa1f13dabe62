"""A command writes the same bytes for any number of worker processes and any size of batches.

An author of a question adds a row.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import SafevarError
from safevar_sumo.results import load_runs
from safevar_sumo.search import ALGORITHMS
from tests.campaign.formulas import FormulaPool, carried_out
from tests.end_to_end.conftest import solutions, study
from tests.in_process import run
from tests.questions.test_repair import planted as planted

QUESTIONS = {
    "explain": "small.toml --limit 300 --top 1 --fits 0",
    "tolerance": "small.toml --characteristics mass,tireFric --fits 0 --attack 500",
    "risk": "small.toml --samples 300",
    "rules": "small.toml --samples 300",
    "compare": "small.toml smoke --samples 100",
    "repair": "planted.toml --change always",
}
"""What each command is asked."""


@pytest.mark.slow
@pytest.mark.usefixtures("small", "planted", "worker_processes")
@pytest.mark.parametrize("command", QUESTIONS)
def test_an_answer_has_the_same_bytes_for_one_worker_process_and_for_two(command: str) -> None:
    words = f"{command} {QUESTIONS[command]}".split()
    answers = {run(*words, "--json", "--jobs", jobs).stdout for jobs in ("1", "2")}
    assert len(answers) == 1


@pytest.mark.usefixtures("small", "worker_processes")
def test_a_search_has_the_same_bytes_in_two_worker_processes(whole: Path) -> None:
    study("--jobs", "2", "--batch", "7", "--out", "out")
    assert solutions("out") == solutions(whole)


ALL = [*ALGORITHMS, "pymoo:NSGA3", "pymoo:CMAES", "pymoo:MOEAD"]
SEARCH: dict[str, Any] = {
    "algorithms": ALL,
    "evaluations": 60,
    "parameters": {"pymoo:NSGA3": {"ref_dirs": 3}},
}


@pytest.fixture(scope="module")
def of_formulas(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of all algorithms by formulas, one after another."""
    folder = tmp_path_factory.mktemp("all")
    carried_out(load_study("smoke", search=SEARCH), folder)
    return folder


@pytest.mark.parametrize(
    ("workers", "batch", "breaks_after"), [(7, None, None), (3, 3, None), (2, 1, None), (1, 11, 9)]
)
def test_results_depend_neither_on_workers_nor_on_order_nor_on_batches_nor_on_an_interruption(
    workers: int, batch: int | None, breaks_after: int | None, of_formulas: Path, tmp_path: Path
) -> None:
    searched = load_study("smoke", search=SEARCH)
    if breaks_after:
        with pytest.raises(SafevarError, match="broken down"):
            carried_out(searched, tmp_path, FormulaPool(limit=breaks_after), batch=7)
    carried_out(searched, tmp_path, FormulaPool(workers), batch=batch)
    assert solutions(tmp_path) == solutions(of_formulas)
    results = load_runs(tmp_path)
    pd.testing.assert_frame_equal(results.evaluations, load_runs(of_formulas).evaluations)
    assert {*results.solutions["algorithm"]} == {name.replace(":", "_") for name in ALL}
