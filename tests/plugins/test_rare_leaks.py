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


@pytest.mark.parametrize("batch", [None, 7])
def test_a_class_that_remembers_what_only_a_rare_setting_does(batch: int | None, mine: Mine, folder: Path, tmp_path: Path) -> None:
    system = mine(LATCH)
    study = load_study(str(folder / "mine.toml"), search={"algorithms": ["nsga2"], "runs": 1})
    for _ in range(2):  # the same command again does not get by either
        with pytest.raises(ForeignError, match=r"in run nsga2-00 and [\d.]+ alone; again by: python -m safevar_sumo simulate") as caught:
            carried_out(study, system, all_runs(study), tmp_path / "out", InThisProcess(), Unheard(), batch)
        assert "ads.model = 'mine:Mine' a result depends on what else is simulated" in str(caught.value)
    assert not (tmp_path / "out/solutions.csv").exists()
