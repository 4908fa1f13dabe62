"""What the Tab key completes."""

from __future__ import annotations

import pytest
from click.shell_completion import ShellComplete

from safevar_sumo.cli.program import COMMANDS, commands


@pytest.mark.parametrize(("words", "incomplete", "expected"), [
    ([], "s", {name for name in COMMANDS if name.startswith("s")}), (["study"], "ra", {"rain"}), (["simulate"], "su", {"sun"}),
    (["simulate", "native", "--set"], "t", {"tau="}), (["simulate", "sun", "--set"], "ma", {"mass=", "max_rpm=", "maxBrakeTorque="}),
    (["simulate", "nothing", "--set"], "t", set()), (["validate"], "lg", {"lgsvl"}),
])
def test_names_complete(words: list[str], incomplete: str, expected: set[str]) -> None:
    found = ShellComplete(commands, {}, "safevar-sumo", "_SAFEVAR_SUMO_COMPLETE").get_completions(words, incomplete)
    assert expected == {item.value for item in found if item.type == "plain"} or expected <= {item.value for item in found}
