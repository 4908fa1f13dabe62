"""What other people's code does to the process that it runs in is undone, or refused where results would hang on it."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.errors import ForeignError
from safevar_sumo.metrics import deceleration
from safevar_sumo.sumo import batch
from safevar_sumo.sumo.matrix import evaluate
from tests.plugins.beside import SCALAR, Mine

DRIVE = "    def drive(self, seen):\n        {}\n        return 0.5, 0.0\n"


IMPORTS = """import numpy as np
import safevar_sumo.metrics.deceleration as deceleration
import safevar_sumo.sumo.batch as batch
"""


@pytest.mark.parametrize(("owner", "name", "called"), [
    (np, "minimum", "np"), (deceleration, "every", "deceleration"), (batch._Verdict, "judge", "batch._Verdict")])
@pytest.mark.parametrize("when", ["import", "drive"])
def test_who_replaces_a_function_of_ours_or_of_numpy_is_refused(when: str, owner: object, name: str, called: str, mine: Mine,
                                                                monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(owner, name, getattr(owner, name))  # put back at the end
    statement = f"{called}.{name} = {called}.{name}.__call__"
    at_import, at_drive = (f"{statement}\n", "pass") if when == "import" else ("", statement)
    with pytest.raises(ForeignError, match=rf"ads.model = 'mine:Mine' has replaced [\w.]+\.{name}\nlegal: code that leaves"):
        evaluated(mine(IMPORTS + at_import + SCALAR + DRIVE.format(at_drive)))


@pytest.mark.parametrize("where", ["__init__", "drive"])
def test_folder_environment_error_state_and_recursion_limit_are_put_back(where: str, mine: Mine, folder: Path) -> None:
    before = Path.cwd(), dict(os.environ), np.geterr(), sys.getrecursionlimit()
    disturb = "os.chdir('/'); os.environ['HOME'] = '/nowhere'; np.seterr(all='raise'); sys.setrecursionlimit(400)"
    init = f"    def __init__(self):\n        {disturb}\n\n" if where == "__init__" else ""
    evaluated(mine("import os, sys\nimport numpy as np\n" + SCALAR + init + DRIVE.format("pass" if init else disturb)))
    assert (Path.cwd(), dict(os.environ), np.geterr(), sys.getrecursionlimit()) == before


def evaluated(system: object) -> None:
    evaluate(system, system.characteristics.original[None])  # type: ignore[arg-type, attr-defined]
