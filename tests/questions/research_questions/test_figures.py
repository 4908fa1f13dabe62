"""Figures of made-up solutions: bars, boxes and cells are counts that one can make by hand."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.colors import to_hex

from safevar_sumo.questions.case import UnanswerableError
from safevar_sumo.questions.research_questions import figures
from tests.support.made_up_results import made_up, row

HEAVY, LIGHT, WORN = (1100.0, 2.0, 0.1), (900.0, 2.0, 0.1), (1200.0, 1.5, 0.1)
RUNS = [("nsga2", 0), ("nsga2", 1), ("nsga2", 2)]
CASE = made_up(*(row(values=values) for values in (HEAVY, LIGHT, WORN)), finished=RUNS)
SAFE = made_up(row(sd=3.0))


def test_a_histogram_has_each_change_in_its_bin() -> None:
    """The mass is from 200 kg less to 400 kg more, in 24 bins of 25 kg; increases are orange."""
    figure = figures.draw_change_sizes(CASE)
    mass, *others = figure.axes
    bars = [bar for bar in mass.patches if bar.get_height()]
    assert [(round(bar.get_x()), to_hex(bar.get_facecolor())) for bar in bars] == [
        (100, "#d55e00"),
        (200, "#d55e00"),
        (-100, "#0072b2"),
    ]
    assert {(bar.get_height(), round(bar.get_width())) for bar in bars} == {(1, 25)}
    assert mass.get_xlim() == (-200, 400)
    titles = [axis.get_title() for axis in others]
    assert [mass.get_title(), *titles] == [
        "mass\n+2, -1",
        "grip\n+0, -1",
        "lag\n+0, -0",
    ]
    assert mass.get_xlabel() == "change [kg]"
    assert figure.get_supylabel() == "number of critical solutions (of 3)"
    with pytest.raises(UnanswerableError, match="no critical solution"):
        figures.draw_change_sizes(SAFE)


def test_a_box_has_the_median_over_the_runs() -> None:
    two = made_up(row(values=HEAVY), row(run=1, values=WORN))
    for case, medians in (CASE, [0, 0, 0]), (two, [0.5, 0.5, 0]):
        (axis,) = figures.draw_change_counts([case]).axes
        lines = [line for line in axis.lines if (np.diff(line.get_xdata()) > 0.5).any()]
        assert [line.get_ydata()[0] for line in lines] == medians
    assert [text.get_text() for text in axis.get_xticklabels()] == ["1", "2", "3"]
    assert "(2 runs)" in axis.get_ylabel()
    with pytest.raises(UnanswerableError, match="safety degree"):
        figures.draw_change_counts([made_up(row(), original={})])


def test_a_cell_has_the_share_of_solutions_the_most_frequent_first() -> None:
    """Of two solutions with one change both change the mass."""
    ((axis, _),) = [figures.draw_changed_characteristics(CASE).axes]
    names = [text.get_text() for text in axis.get_yticklabels()]
    assert names == ["mass", "grip", "lag"]
    shares = ["100", "100", "100", "0", "100", "33", "0", "0", "0"]
    assert [text.get_text() for text in axis.texts] == shares
    assert axis.collections[0].get_clim() == (0, 100)
