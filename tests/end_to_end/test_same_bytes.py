"""A command writes the same bytes for any number of worker processes and any size of batches.

An author of a question adds a row. `repair`, which takes minutes, is asked in
`tests/questions/test_repair.py`.
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import SafevarError
from safevar_sumo.results import load_runs
from safevar_sumo.search import ALGORITHMS
from tests.support.formulas import FormulaPool, carried_out, solutions
from tests.support.in_process import SLOW, run

QUESTIONS = {
    "explain": "small.toml --quick --top 1",
    "tolerance": "small.toml --characteristics mass,tireFric --quick",
    "risk": "small.toml --samples 300",
    "rules": "small.toml --samples 300",
    "compare": "small.toml smoke --samples 100",
}
"""What each command is asked."""


@SLOW
@pytest.mark.usefixtures("small", "worker_processes")
@pytest.mark.parametrize("command", QUESTIONS)
def test_an_answer_has_the_same_bytes_for_one_worker_process_and_for_two(
    command: str,
) -> None:
    typed = f"{command} {QUESTIONS[command]} --json --jobs"
    assert run(f"{typed} 1").stdout == run(f"{typed} 2").stdout


@SLOW
@pytest.mark.usefixtures("small", "worker_processes")
def test_a_search_has_the_same_bytes_in_two_worker_processes(whole: Path) -> None:
    run("study small.toml --quiet --jobs 2 --out out")
    assert solutions(Path("out")) == solutions(whole)


OURS = [*ALGORITHMS]
MIXED = ["nsga2", "surrogate", "pymoo:NSGA3", "pymoo:CMAES", "pymoo:MOEAD"]


@SLOW
@pytest.mark.parametrize(
    ("algorithms", "workers", "batch", "breaks_after"),
    [(OURS, 3, 3, None), (OURS, 2, 1, None), (MIXED, 1, 11, 9)],
)
def test_results_depend_neither_on_workers_nor_on_order_nor_on_batches_nor_on_an_interruption(
    algorithms: list[str],
    workers: int,
    batch: int | None,
    breaks_after: int | None,
    tmp_path: Path,
) -> None:
    """Those of pymoo share numpy's random state, so they run in one thread of a process."""
    parameters = {"pymoo:NSGA3": {"ref_dirs": 3}} if algorithms is MIXED else {}
    search = {"algorithms": algorithms, "evaluations": 60, "parameters": parameters}
    searched = load_study("smoke", search=search)
    carried_out(searched, tmp_path / "whole")
    if breaks_after:
        with pytest.raises(SafevarError, match="broken down"):
            carried_out(
                searched, tmp_path / "out", FormulaPool(limit=breaks_after), batch=7
            )
    carried_out(searched, tmp_path / "out", FormulaPool(workers), batch=batch)
    assert solutions(tmp_path / "out") == solutions(tmp_path / "whole")
    whole, results = (load_runs(tmp_path / name) for name in ("whole", "out"))
    pd.testing.assert_frame_equal(results.evaluations, whole.evaluations)
    assert {*results.solutions["algorithm"]} == {
        name.replace(":", "_") for name in algorithms
    }
