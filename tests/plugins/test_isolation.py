"""Models that let settings see each other are found before a search begins; options that write files are refused."""

from __future__ import annotations

import shutil
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.errors import ForeignError, InputError
from safevar_sumo.records import Evaluations
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.workers.isolation import check_isolation
from tests.plugins.beside import SCALAR, Mine

ADS = ("import numpy as np\n\n\nclass Mine:\n    def start(self, n, nominal, step):\n        return 0\n\n"
       "    def drive(self, seen, memory):\n")
MEAN = ADS + "        return (0 * seen.speed + 0.5 + 0.01 * np.mean(seen.gap), 0), memory\n"
CLASS = SCALAR + "    calls = 0\n\n    def drive(self, seen):\n        Mine.calls += 1\n        return 1 / (1 + Mine.calls / 1e4), 0.0\n"
SELF = ADS + "        self.count = getattr(self, 'count', 0) + 1\n        return (0 * seen.speed + 1 / self.count, 0), memory\n"
RANDOM = SCALAR + "    def drive(self, seen):\n        return np.random.random(), 0.0\n\n\nimport numpy as np\n"
PLACE = ADS + "        return (np.linspace(0.2, 0.8, len(seen.speed)), 0), memory\n"
HONEST = SCALAR + "    def drive(self, seen):\n        return 0.5, 0.0\n"


def probed(system: System, folder: Path) -> None:
    def submit(settings: np.ndarray) -> Future[Evaluations]:
        future: Future[Evaluations] = Future()
        future.set_result(evaluate(system, settings))
        return future

    check_isolation(load_study(str(folder / "mine.toml")), system.characteristics, submit)


@pytest.mark.parametrize("module", [MEAN, CLASS, SELF, RANDOM, PLACE], ids=["mean", "class", "self", "random", "place"])
def test_an_ads_that_mixes_settings_up_is_refused(module: str, mine: Mine, folder: Path) -> None:
    with pytest.raises(ForeignError, match=r"ads.model = 'mine:Mine' a result depends on what else is simulated") as caught:
        probed(mine(module), folder)
    assert "nothing random" in caught.value.legal


def test_an_honest_ads_is_not(mine: Mine, folder: Path) -> None:
    probed(mine(HONEST), folder)


@pytest.mark.parametrize("option", ['<fcd-output value="fcd.xml"/>', '<output><summary-output value="x"/></output>',
                                    '<remote-port value="8813"/>', '<random value="true"/>', '<additional-files value="a.xml"/>',
                                    '<log value="x"/>', '<save-state.times value="1"/>', '<device.fcd.period value="1"/>'])
def test_a_folder_whose_configuration_writes_files_or_opens_sockets_is_refused(option: str, folder: Path) -> None:
    shutil.copytree(NETWORKS / "lead_vehicle_stopped", folder / "road")
    (folder / "mine.toml").write_text('extends = "native"\nname = "mine"\n[scenario.parameters]\nnetwork = "road"\n')
    system = assemble(load_study(str(folder / "mine.toml")))
    assert system.scenario.network == str(folder / "road"), "a folder beside the study"
    file = folder / "road/scenario.sumocfg"
    file.write_text(file.read_text().replace("</configuration>", f"{option}</configuration>"))
    with pytest.raises(InputError, match=r"sets SUMO's option '[a-z.-]+'"):
        assemble(load_study(str(folder / "mine.toml")))
