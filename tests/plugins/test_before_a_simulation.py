"""User code that hangs before a simulation, whose attributes cannot be set, or whose error is no
legal text.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.campaign import algorithm_of
from safevar_sumo.errors import UserCodeError
from safevar_sumo.sumo.matrix import drive_and_score
from tests.in_process import refused, run
from tests.made_up import original_of
from tests.plugins.conftest import ADS, SCALAR, Mine

DRIVE = "    def drive(self, seen):\n        return 0.0, 1.0\n"
INIT = "    def __init__(self):\n        __import__('time').sleep(60)\n\n"
SEARCH = "class Mine:\n" + INIT + "    def search(self, problem, rng):\n        yield\n"
IMPORT = "import time\ntime.sleep(60)\n"
LIMIT = "[search]\ntime_limit = 0.3\n"
ALGORITHM = LIMIT + 'algorithms = ["mine:Mine"]\n'
METRIC = LIMIT + '[metrics]\nalso = ["mine:Mine"]\n'
JOINT = '[scenario]\nmodel = "mine:Mine"\n[scenario.search]\nspeed = {}\n' + LIMIT


@pytest.mark.parametrize(
    ("module", "table", "what"),
    [
        (SCALAR + INIT + DRIVE, ADS + LIMIT, "`__init__`"),
        (SEARCH, ALGORITHM, "`__init__`"),
        *(
            (IMPORT, table, "the import of mine")
            for table in (ADS + LIMIT, ALGORITHM, METRIC, JOINT)
        ),
    ],
)
def test_user_code_that_hangs_before_a_simulation_ends_at_the_time_limit(
    module: str, table: str, what: str, mine: Mine, folder: Path
) -> None:
    def load() -> None:
        mine(module, table)
        algorithm_of("Mine", load_study(str(folder / "mine.toml")))

    with pytest.raises(UserCodeError) as caught:
        load()
    assert f"{what} took longer than the time limit of 0.3 s ({folder / 'mine.py'}:" in str(
        caught.value
    )
    assert len(str(caught.value).splitlines()) == 2


@pytest.mark.parametrize(
    ("body", "place"),
    [
        (
            "@property\n    def nominal(self):\n        raise RuntimeError('no')",
            "ads.model = 'mine:Mine' raised in start",
        ),
        ("step = property(lambda self: 1)", "ads.model = 'mine:Mine' raised in start"),
        (
            (
                "def put(self, value):\n        raise RuntimeError('no')\n    nominal ="
                " property(None, put)"
            ),
            "raised in put",
        ),
    ],
)
def test_an_ads_whose_attributes_cannot_be_set_is_told_in_two_lines(
    body: str, place: str, mine: Mine
) -> None:
    system = mine(f"{SCALAR}    {body}\n\n{DRIVE}")
    with pytest.raises(UserCodeError, match=place) as caught:
        drive_and_score(system, original_of(system))
    assert len(str(caught.value).splitlines()) <= 2


def test_a_lone_surrogate_in_an_error_of_the_user_is_told_as_its_code(
    mine: Mine, folder: Path
) -> None:
    mine(SCALAR + "    def drive(self, seen):\n        raise ValueError('bad \\ud800 text')\n")
    study = str(folder / "mine.toml")
    refused("simulate", study, "--json", message=("bad \\ud800 text", "mine.py:6"))
    assert run("check", study, expect=1).stdout.encode()
