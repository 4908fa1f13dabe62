"""The figure of one characteristic at a time explains what it draws, and nothing else."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest

from safevar_sumo.analysis.figures import profiles_figure
from safevar_sumo.vehicles import Characteristic


@pytest.mark.parametrize(("degrees", "unsafe", "told"), [
    ([2.0, 2.0, 1.5], [], "dot: the original vehicle"),
    ([2.0, 2.0, 0.7], [(2.5, 3.0)], "dot: the original vehicle;\nhatched: unsafe"),
    ([2.0, 2.0, -3.0], [(2.5, 3.0)], "dot: the original vehicle;\nhatched: unsafe;\nbelow the dashed line: collisions")])
def test_its_words_are_of_what_is_drawn(degrees: list[float], unsafe: list[tuple[float, float]], told: str) -> None:
    member = Characteristic(name="wear", unit="-", original=2.0, lower=1.0, upper=3.0)
    profile = pd.DataFrame({"value": [1.0, 2.0, 3.0], "safety_degree": degrees})
    alone = SimpleNamespace(characteristic=member, unsafe=unsafe, profile=profile)
    found: Any = SimpleNamespace(study=SimpleNamespace(name="it"), unsafe="collision", alone=[alone])
    assert profiles_figure(found).get_supxlabel() == told
