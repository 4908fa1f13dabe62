"""Solutions are called by algorithm, run and row, and found again by that name."""

from __future__ import annotations

import pandas as pd
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.results import SolutionId, chosen_handle, handles, position_of

FRAME = pd.DataFrame({
    "algorithm": ["nsga2", "nsga2", "nsga2", "rs"], "run": [0, 0, 3, 0], "f_safe": [-3.0, -1.0, -2.0, 2.0], "f_diff": [0.3, 0.2, 0.1, 0.01],
    "f_num_diff": [5, 2, 4, 1], "outcome": ["collision", "collision", "collision", "stopped"]})


def test_rows_count_within_their_run() -> None:
    assert list(map(str, handles(FRAME))) == ["nsga2:0:0", "nsga2:0:1", "nsga2:3:0", "rs:0:0"]
    for place, handle in enumerate(handles(FRAME)):
        assert position_of(FRAME, SolutionId.parse(str(handle))) == place


def test_imported_solutions_count_as_run_0() -> None:
    assert list(map(str, handles(FRAME.drop(columns="run")))) == ["nsga2:0:0", "nsga2:0:1", "nsga2:0:2", "rs:0:0"]


@pytest.mark.parametrize("text", [
    "", "nsga2", "nsga2:0", "nsga2:0:", ":0:0", "nsga2:-1:0", "nsga2:0:0:0", "nsga2:0:x", "nsga2:0:" + "9" * 30])
def test_what_is_no_handle_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="ALGORITHM:RUN:N"):
        SolutionId.parse(text)


@pytest.mark.parametrize(("handle", "legal"), [("nsga2:0:2", "0 to 1"), ("nsga2:1:0", "nsga2:0, nsga2:3, rs:0"), ("sf:0:0", "nsga2:0")])
def test_a_solution_that_is_not_there_is_told_with_what_is(handle: str, legal: str) -> None:
    with pytest.raises(InputError) as refused:
        position_of(FRAME, SolutionId.parse(handle))
    assert handle in str(refused.value)
    assert legal in str(refused.value)


def test_chosen_by_what_they_are_among_the_unsafe() -> None:
    assert str(chosen_handle(FRAME, 2.7, "most_severe", "x")) == "nsga2:0:0"
    assert str(chosen_handle(FRAME, 2.7, "fewest", "x")) == "nsga2:0:1"
    assert str(chosen_handle(FRAME, 2.7, "smallest", "x")) == "nsga2:3:0"


def test_without_a_collision_half_the_distance_is_unsafe() -> None:
    safe = FRAME[FRAME["outcome"] == "stopped"]
    assert str(chosen_handle(safe, 4.1, "smallest", "x")) == "rs:0:0"
    with pytest.raises(InputError, match="no unsafe solution"):
        chosen_handle(safe, 4.0, "smallest", "x")
    assert str(chosen_handle(safe, 4.0, "most_severe", "x")) == "rs:0:0"
