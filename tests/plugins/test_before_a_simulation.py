"""User code that hangs before a simulation, whose attributes cannot be set, or whose error is no legal text."""

from __future__ import annotations

import pickle
import signal
from pathlib import Path

import pytest

from safevar_sumo.campaign import algorithm_of
from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate
from tests.in_process import refused, run
from tests.made_up import original_of
from tests.plugins.conftest import ADS, SCALAR, Mine

DRIVE = "    def drive(self, seen):\n        return 0.0, 1.0\n"
INIT = "    def __init__(self):\n        __import__('time').sleep(60)\n\n"
SEARCH = "class Mine:\n" + INIT + "    def search(self, problem, rng):\n        yield\n"
IMPORT = "import time\ntime.sleep(60)\n"
CATCHING = "while True:\n    try:\n        1 / 0\n    except Exception:\n        pass\n"
LIMIT = "[search]\ntime_limit = 0.3\n"
ALGORITHM = LIMIT + 'algorithms = ["mine:Mine"]\n'
METRIC = LIMIT + '[metrics]\nalso = ["mine:Mine"]\n'


@pytest.mark.parametrize(
    ("module", "table", "what"),
    [
        (SCALAR + INIT + DRIVE, ADS + LIMIT, "`__init__`"),
        (SEARCH, ALGORITHM, "`__init__`"),
        (IMPORT, ADS + LIMIT, "the import of mine"),
        (CATCHING, ADS + LIMIT, "the import of mine"),
        (IMPORT, METRIC, "the import of mine"),
        (IMPORT, ALGORITHM, "the import of mine"),
    ],
    ids=["ADS", "algorithm", "import", "catching import", "import of a metric", "import of an algorithm"],
)
def test_user_code_that_hangs_before_a_simulation_ends_at_the_time_limit(
    module: str, table: str, what: str, mine: Mine, folder: Path
) -> None:
    def load() -> None:
        mine(module, table)
        algorithm_of("Mine", load_study(str(folder / "mine.toml")))

    before = signal.getsignal(signal.SIGALRM)
    with pytest.raises(UserCodeError) as caught:
        load()
    message = str(caught.value)
    assert f"{what} took longer than the time limit of 0.3 s (" in message
    assert "mine.py:" in message
    assert len(message.splitlines()) == 2
    assert signal.getsignal(signal.SIGALRM) is before


def test_a_searched_scenario_that_hangs_in_its_import_ends_at_the_time_limit(folder: Path) -> None:
    (folder / "mine.py").write_text(IMPORT)
    (folder / "mine.toml").write_text(
        'extends = "sun_joint"\nname = "mine"\n[scenario]\nmodel = "mine:Mine"\n[scenario.search]\nspeed = {}\n' + LIMIT
    )
    with pytest.raises(UserCodeError, match=r"the import of mine took longer than the time limit of 0\.3 s"):
        load_study(str(folder / "mine.toml"))


@pytest.mark.parametrize(
    "module",
    [
        SCALAR + "    @property\n    def nominal(self):\n        raise RuntimeError('no')\n\n",
        SCALAR + "    step = property(lambda self: 1)\n\n",
        SCALAR + "    def put(self, value):\n        raise RuntimeError('no')\n\n    nominal = property(None, put)\n\n",
    ],
    ids=["a property that raises", "a property", "a setter that raises"],
)
def test_an_ads_whose_attributes_cannot_be_set_is_told_in_two_lines(module: str, mine: Mine) -> None:
    system = mine(module + DRIVE)
    words = r"(ads\.model = 'mine:Mine' raised in start|user code raised in put): \w+Error: "
    with pytest.raises(UserCodeError, match=words) as caught:
        evaluate(system, original_of(system))
    assert len(str(caught.value).splitlines()) <= 2


def test_a_lone_surrogate_in_an_error_of_the_user_is_told_as_its_code(mine: Mine, folder: Path) -> None:
    mine(SCALAR + "    def drive(self, seen):\n        raise ValueError('bad \\ud800 text')\n")
    study = str(folder / "mine.toml")
    for command in ("simulate", "tolerance", "study"):
        refused(command, study, "--json", message=("bad \\ud800 text", "mine.py:6"))
    for arguments in ((), ("--json",)):
        assert "ud800 text" in run("check", study, *arguments, expect=1).stdout.encode().decode()
    error = InputError("it", "b \ud800")
    assert pickle.loads(pickle.dumps(error)).problem == error.problem == "b \\ud800"
