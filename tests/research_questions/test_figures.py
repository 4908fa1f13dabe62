"""Every picture: axes with labels, no text over another, nothing drawn of nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from matplotlib.transforms import Bbox, BboxBase

from safevar_sumo.analysis.research_questions.case import Case, Unanswerable
from safevar_sumo.analysis.research_questions.figures import (
    OF_A_CASE,
    OF_ALL,
    changed_characteristics,
    draw,
    draw_all,
    number_of_changes,
    pareto_fronts,
    sizes_of_changes,
)
from safevar_sumo.errors import InputError
from safevar_sumo.study import load_study
from safevar_sumo.vehicles import CharacteristicSet
from tests.research_questions.made_up import CHARACTERISTICS, made_up, made_up_study, row


def random_setting(name: str) -> Case:
    """A shipped study's characteristics, some with long names, and three algorithms."""
    rng, study = np.random.default_rng(4), load_study(name)
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    rows = [row(algorithm, run, sd=rng.uniform(-5, 11)) for algorithm in study.search.algorithms for run in range(3) for _ in range(100)]
    evaluations = [{**one, "evaluation": i % 100} for i, one in enumerate(rows)]
    base = made_up(*rows, original={"safety_degree": 10.1}, study=study, evaluations=evaluations)
    drawn = rng.uniform(characteristics.lower, characteristics.upper, (len(rows), len(characteristics)))
    drawn = np.where(rng.random(drawn.shape) < 0.5, drawn, characteristics.original)
    values = {**dict(zip(characteristics.names, drawn.T, strict=True)), "f_diff": characteristics.largest_change(drawn)}
    return dataclasses.replace(base, solutions=base.solutions.drop(columns=list(CHARACTERISTICS)).assign(**values))


@pytest.fixture(scope="module")
def case() -> Case:
    rng = np.random.default_rng(2)
    rows, evaluations = [], []
    for algorithm in ("nsga2", "rs"):
        for run in (0, 1):
            for i in range(60):
                values = (rng.uniform(800, 1400), rng.uniform(1, 3) if i % 2 else 2.0, rng.uniform(0.05, 0.5) if i % 3 else 0.1)
                one = row(algorithm, run, values=values, sd=rng.uniform(-2, 3))
                evaluations.append({**one, "evaluation": i})
                if i % 3 == 0:
                    rows.append(one)
    return made_up(*rows, evaluations=evaluations)


@pytest.mark.parametrize("study", ["made-up", "lgsvl"])
@pytest.mark.parametrize("name", [*OF_ALL, *OF_A_CASE])
def test_axes_are_labelled_and_no_text_lies_on_another(name: str, study: str, case: Case) -> None:
    shown = case if study == "made-up" else random_setting(study)
    figure = OF_ALL[name]([shown]) if name in OF_ALL else OF_A_CASE[name](shown)
    _check_layout(figure, name)


def test_cases_stand_side_by_side_in_one_figure(case: Case) -> None:
    cases = [dataclasses.replace(case, name=f"case {i}") for i in range(2)]
    figure = number_of_changes(cases)
    assert [axis.get_title() for axis in figure.axes if axis.axison] == [one.name for one in cases]
    _check_layout(figure, "rq3.1-number-of-changes")
    found, lacking = draw(cases)
    assert [name for name in found if name.startswith("rq3.1")] == ["rq3.1-number-of-changes"]
    assert "case 1-convergence" in found
    assert not lacking


def test_the_original_vehicle_and_the_line_of_collisions_are_in_the_fronts(case: Case) -> None:
    for axis, marked in zip(pareto_fronts(case).axes, (True, True, False), strict=True):
        told = {str(line.get_label()): line for line in axis.lines}
        assert float(told["original vehicle"].get_xdata()[0]) == (case.original["safety_degree"] if marked else 0.0)  # type: ignore[index,arg-type]
        assert ("collision: 0 and left of it" in told) == marked


def _check_layout(figure: Figure, name: str) -> None:
    """Every axis has labels and a scale, no text lies on another or is cut off."""
    FigureCanvasAgg(figure).draw()
    shared = {"rq3.3-sizes-of-changes"}
    for axis in figure.axes:
        if axis.axison and axis.get_label() != "<colorbar>":
            assert axis.get_xlabel()
            assert axis.get_ylabel() or (name in shared and figure.get_supylabel())
            low, high = axis.get_xlim()
            assert sum(low - 1e-9 <= tick <= high + 1e-9 for tick in axis.get_xticks()) >= 2, "one tick tells no scale"
    texts = {id(one): one for one in _texts(figure) if one.get_visible() and one.get_text().strip()}
    assert len(texts) > 10
    boxes = [(one.get_text(), _with_space_beside(one.get_window_extent())) for one in texts.values()]
    for (first, box), (second, other) in combinations(boxes, 2):
        assert not box.overlaps(other), f"{first!r} and {second!r}"
    for text, box in boxes:
        assert min(box.x0, box.y0, figure.bbox.x1 - box.x1, figure.bbox.y1 - box.y1) > -1, f"{text!r} is cut off"


def _with_space_beside(box: BboxBase) -> Bbox:
    """The box of a text with what must stay free at its ends, without what its line has above and below."""
    return Bbox.from_extents(box.x0 - 1, box.y0 + 0.1 * box.height, box.x1 + 1, box.y1 - 0.1 * box.height)


def _texts(figure: Figure) -> Iterator[Text]:
    """Every text that is drawn; ticks beyond an axis's ends exist but are not."""
    yield from (part for part in (*figure.texts, figure._suptitle, figure._supxlabel, figure._supylabel) if part is not None)
    for legend in figure.legends:
        yield from legend.get_texts()
    for axes in figure.axes:
        if axes.axison:
            yield from (axes.title, axes.xaxis.label, axes.yaxis.label, *axes.texts)
            for axis in (axes.xaxis, axes.yaxis):
                low, high = sorted(axis.get_view_interval())
                yield from (tick.label1 for tick in axis.get_major_ticks() if low - 1e-9 <= tick.get_loc() <= high + 1e-9)
                yield from (tick.label2 for tick in axis.get_major_ticks() if low - 1e-9 <= tick.get_loc() <= high + 1e-9)


def test_changes_are_counted_on_their_side_of_zero(case: Case) -> None:
    axis = sizes_of_changes(case).axes[0]
    bars = [bar for bar in axis.patches if isinstance(bar, Rectangle) and bar.get_height() > 0]
    up, down = sum(bar.get_height() for bar in bars if bar.get_x() >= -1e-9), sum(bar.get_height() for bar in bars if bar.get_x() < -1e-9)
    assert axis.get_title() == f"mass\n+{up:.0f}, -{down:.0f}"
    assert up > 0
    assert down > 0
    assert not [bar for bar in bars if bar.get_x() < -1e-9 and bar.get_x() + bar.get_width() > 1e-9]


def test_what_cannot_be_drawn_says_why(tmp_path: Path) -> None:
    imported = made_up(row(values=(1100, 2, 0.1)), has_runs=False)
    written, lacking = draw_all([imported], tmp_path, "svg")
    assert sorted(path.name for path in written) == [
        "made-up-pareto-fronts.svg", "made-up-rq3.2-changed-characteristics.svg", "made-up-rq3.3-sizes-of-changes.svg"]
    assert any("imported" in reason for reason in lacking)
    for one in (sizes_of_changes, changed_characteristics):
        with pytest.raises(Unanswerable, match="no critical solution"):
            one(made_up(row(sd=9)))
    with pytest.raises(InputError, match="no finished run"):
        draw_all([made_up()], tmp_path, "png")


def test_names_are_no_formulas(tmp_path: Path) -> None:
    strange = made_up(row(values=(1100, 2, 0.1)), study=made_up_study())
    object.__setattr__(strange, "name", "a$b$c ^_/é")
    written, _ = draw_all([strange], tmp_path, "svg")
    assert all(path.parent == tmp_path for path in written)
