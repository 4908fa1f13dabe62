"""What leaks from setting to setting in rare states alone is found when a run ends, however its settings were shared out."""

from __future__ import annotations

from pathlib import Path

import pytest
from beside import InThisProcess, Mine

from safevar_sumo.api.running import Unheard, carried_out
from safevar_sumo.campaign import all_runs
from safevar_sumo.errors import ForeignError
from safevar_sumo.study import load_study

LATCH = """
from safevar_sumo.ads import ScalarAds


class Mine(ScalarAds):
    seen_one = False

    def drive(self, seen):
        if seen.gap < 1.66:
            Mine.seen_one = True
        stopping = seen.speed**2 / (2 * 0.6 * self.nominal.decel)
        if seen.gap < stopping + 2.0 and abs(seen.lateral) < 2.5:
            return 0.0, 0.9 if Mine.seen_one else 1.0
        return (0.5, 0.0) if seen.speed < 5 else (0.0, 0.0)
"""


def test_a_class_that_remembers_what_only_a_rare_setting_does(mine: Mine, folder: Path, tmp_path: Path) -> None:
    system = mine(LATCH)
    study = load_study(str(folder / "mine.toml"), search={"algorithms": ["nsga2"], "evaluations": 60, "runs": 1})
    for _ in range(2):  # the same command again does not get by either
        with pytest.raises(ForeignError, match=r"in run nsga2-00 and [\d.]+ alone; again by: python -m safevar_sumo simulate") as caught:
            carried_out(study, system, all_runs(study), tmp_path / "out", InThisProcess(), Unheard(), 7)
        assert "ads.model = 'mine:Mine' a result depends on what else is simulated" in str(caught.value)
    assert not (tmp_path / "out/solutions.csv").exists()


SEARCH = """
class Mine:
    best = None

    def search(self, problem, rng):
        settings = problem.characteristics.filter(problem.uniform(10, rng))
        evaluated = yield settings
        if {own}.best is None:
            {own}.best = evaluated.settings[0].copy()
        settings[1] = {own}.best
        evaluated = yield settings
        return evaluated.take([0])
"""


@pytest.mark.parametrize(("own", "shared"), [("Mine", True), ("self", False)])
def test_an_algorithm_whose_runs_learn_from_each_other(own: str, shared: bool, mine: Mine, folder: Path, tmp_path: Path) -> None:
    system = mine(SEARCH.format(own=own), '[search]\nalgorithms = ["mine:Mine"]\nevaluations = 20\nruns = 3\n')
    study = load_study(str(folder / "mine.toml"))

    def searched() -> object:
        return carried_out(study, system, all_runs(study), tmp_path / "out", InThisProcess(), Unheard(), None)

    if shared:
        with pytest.raises(ForeignError, match="'mine:Mine' asks for other settings in run 2 when there are no other runs"):
            searched()
    else:
        searched()
