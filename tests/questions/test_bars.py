"""Bars of limits: where the ranges are in the domain, in blocks and in SVG."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd

from safevar_sumo.questions.bars import CELLS, HEIGHT, WIDTH, bars_of

LIMITS = pd.DataFrame(
    {
        "original": [8.0, 10.0],
        "together_low": [4.0, np.nan],
        "together_high": [8.0, np.nan],
        "alone_low": [2.0, np.nan],
        "alone_high": [8.0, np.nan],
        "specified_low": [3.0, np.nan],
        "specified_high": [np.nan, np.nan],
    }
)


def test_a_bar_shows_where_its_ranges_are_in_the_domain() -> None:
    worn, undefined = bars_of(LIMITS, [(0.0, 8.0), (0.0, 20.0)])
    quarter = CELLS // 4
    assert len(worn.blocks) == CELLS
    assert worn.blocks[:quarter] == "·" * quarter, "below 2 it is unsafe alone"
    assert worn.blocks[quarter : 2 * quarter].strip("▒") == "|", (
        "from 2 to 4 alone; specified: from 3"
    )
    assert worn.blocks[2 * quarter :] == "█" * (2 * quarter - 1) + "o"
    assert undefined.blocks.replace("o", "·") == "·" * CELLS
    inside = WIDTH - HEIGHT
    found = {
        name: (float(x), float(w))
        for name, x, w in re.findall(
            r'class="(\w+)" x="(.*?)" .*?width="(.*?)"', worn.svg
        )
    }
    assert found["together"] == (HEIGHT / 2 + inside / 2, inside / 2)
    assert found["alone"] == (
        round(HEIGHT / 2 + inside / 4, 1),
        round(inside * 0.75, 1),
    )
    assert "together" not in undefined.svg
