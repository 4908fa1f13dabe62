"""Two versions of a car before a wall, whose stop is a formula."""

from __future__ import annotations

import numpy as np
import pytest

import safevar_sumo as sv
from tests.support.in_process import InlinePool, write
from tests.support.wall import MODELS, STUDY


@pytest.mark.usefixtures("coarse", "in_tmp")
@pytest.mark.parametrize(("is_worse", "least"), [(True, 3), (False, 4)])
def test_two_versions_are_counted_as_the_formula_says(
    is_worse: bool, least: int
) -> None:
    """One brakes with 8 m/s^2, the other with 6.5: the same changes of each are compared."""
    write("models.py", MODELS)
    study = STUDY.replace("models:Wall", "models:Rig")
    write("hard.toml", study)
    write("soft.toml", study.replace("original = 8", "original = 6.5"))
    names = ["hard.toml", "soft.toml"] if is_worse else ["soft.toml", "hard.toml"]
    answer = sv.compare(
        *names, samples=64, limits=[f"decel >= {least}"], pool=InlinePool()
    )
    hard, soft = "ab" if is_worse else "ba"
    frame, numbers = answer.tables["settings"], answer.numbers
    assert frame["b_decel"].to_numpy() == pytest.approx(
        frame["decel"] + (-1.5 if is_worse else 1.5)
    )
    assert frame[["decel", "b_decel"]].min(axis=None) >= least
    original = [8.0 if is_worse else 6.5, 0.0]
    changes = frame.sort_index()[["decel", "delay"]].to_numpy() - original
    # Of the second setting of each line to its first.
    ratio = changes[16:32] / changes[:16]
    assert ratio[:, 0] == pytest.approx(ratio[:, 1])
    assert set(ratio.ravel().round(9)) <= {0.5, 1.5}
    fails = {}
    for side, decel in ("a", frame["decel"]), ("b", frame["b_decel"]):
        left = 40 - 15 * (0.5 + frame["delay"]) - 15**2 / 2 / decel
        degree = np.where(left < 0, -np.sqrt(np.abs(2 * decel * left)), left)
        assert frame[f"{side}_degree"].to_numpy() == pytest.approx(degree)
        fails[side] = left < 0.3
    counts = [numbers[f"only_{soft}_unsafe"], numbers["both"], numbers["neither"]]
    both = fails[soft] & fails[hard]
    assert counts == [(fails[soft] & ~both).sum(), both.sum(), (~fails[soft]).sum()]
    assert numbers["decision"] == ("do not release" if is_worse else "decide")
    assert f"Only vehicles with decel >= {least} were compared." in answer.verdict
    assert "The original vehicles of A and B differ (decel" in answer.verdict
    said = ["but needless braking was not measured"]
    if is_worse:
        said = [
            "DO NOT RELEASE: B is less safe than A.",
            "that are safe in A are unsafe in B.",
            "limits of single characteristics are narrower in B (",
        ]
    for sentence in said:
        assert sentence in answer.verdict
    assert answer.figure().axes
    assert numbers["limits_shrunk"] == is_worse
    assert numbers["limits_grown"] == (not is_worse)
    assert numbers["p"] == pytest.approx(2 * 0.5**16), (
        "each of 16 lines is safer in one of both"
    )
    limits = answer.tables["limits"].set_index("characteristic")
    assert limits["change"].tolist() == ["the same", "shrunk" if is_worse else "grown"]
    for side, decel in (hard, 8.0), (soft, 6.5):
        latest = min(1, (39.7 - 7.5 - 225 / 2 / decel) / 15)
        weakest = max(least, 225 / 2 / 32.2)
        assert limits.loc["delay", f"{side}_high"] == pytest.approx(latest, abs=0.01)
        assert limits.loc["decel", f"{side}_low"] == pytest.approx(weakest, abs=0.01)
