"""Answers rendered: the same numbers in every format, LaTeX that compiles, names with any characters."""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox, BboxBase

from safevar_sumo.analysis.research_questions.answer import answer_questions
from safevar_sumo.analysis.research_questions.case import Case, UnanswerableError
from safevar_sumo.analysis.research_questions.figures import (
    draw_change_counts,
    draw_change_sizes,
    draw_changed_characteristics,
    draw_pareto_fronts,
)
from safevar_sumo.analysis.research_questions.gallery import FIGURES_OF_ALL_CASES, FIGURES_OF_ONE_CASE, draw_figures, save_figures
from safevar_sumo.analysis.research_questions.layout import PAPER_LAYOUTS, Layouts
from safevar_sumo.analysis.research_questions.tables import FORMATS, as_json, as_latex, as_markdown, as_text, escaped_for_latex
from safevar_sumo.errors import InputError
from safevar_sumo.study import CharacteristicTable, load_study
from safevar_sumo.vehicles import CharacteristicSet
from tests.research_questions.made_up import CHARACTERISTICS, made_up, made_up_study, row
from tests.research_questions.test_algorithms import three_algorithms

NASTY = ['a&b',
         "50%_of $x$", "#1 {brace}", r"back\slash", "~tilde^2", "[option]", "*star", "<less|more>", "quo\"te'`", "ä µ ° ² Δ 車", "--"]


def rich_setting(**changes: Any) -> Case:
    """Two algorithms, two runs, changes of one to three characteristics, a collision."""
    values = [(1000 + 50 * i, 2 - 0.1 * (i % 3), 0.1 if i % 2 else 0.2) for i in range(8)]
    rows = [row(algorithm, run, values=value, sd=1 - 0.3 * i + 0.1 * run + (0.5 if algorithm == "rs" else 0), tet=1 + i / 10)
            for algorithm in ("nsga2", "rs") for run in (0, 1) for i, value in enumerate(values)]
    return made_up(*rows, study=made_up_study(**changes) if changes else None)


def nasty_setting() -> Case:
    study = made_up_study()
    tables = {name: CharacteristicTable(unit=name, original=1, lower=0.5, upper=2) for name in NASTY}
    study = msgspec.structs.replace(study, vehicle=msgspec.structs.replace(study.vehicle, characteristics=tables))
    case = made_up(row(), row("rs"), study=study)
    changed = {name: 1.5 if i < 4 else 1.0 for i, name in enumerate(NASTY)}
    solutions = case.solutions.drop(columns=["mass", "grip", "lag"]).assign(**changed)
    object.__setattr__(case, "solutions", solutions)
    object.__setattr__(case, "name", "_".join(NASTY))
    return case


@pytest.fixture(params=["one", "two", "nasty"])
def cases(request: pytest.FixtureRequest) -> list[Case]:
    return {"one": [rich_setting()], "two": [rich_setting(), rich_setting(name="wet", weather="hard_rain")], "nasty": [nasty_setting()]}[
        request.param]


DOCUMENT = r"""\documentclass{article}
\usepackage[T1]{fontenc}
\usepackage[utf8]{inputenc}
\usepackage{textcomp}
\usepackage{booktabs}
\usepackage{graphicx}
\begin{document}
%s
\end{document}
"""


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="there is no TeX here, as there is in CI")
@pytest.mark.slow
def test_latex_compiles(cases: list[Case], tmp_path: Path) -> None:
    answers = answer_questions(cases)
    document = DOCUMENT % (as_latex(answers) + as_latex(answers, PAPER_LAYOUTS).replace("tab:", "tab:paper-"))
    (tmp_path / "tables.tex").write_text(document, encoding="utf-8")
    done = subprocess.run(["pdflatex", "-halt-on-error", "-interaction=nonstopmode", "tables.tex"], cwd=tmp_path, capture_output=True,
                          text=True, errors="replace", check=False)
    assert done.returncode == 0, done.stdout[-2000:]
    assert (tmp_path / "tables.pdf").stat().st_size > 1000


@pytest.mark.parametrize(("plain", "latex_form"), [
    ("a_b", r"a\_b"), ("50 %", r"50 \%"), ("m/s^2", r"m/s\textsuperscript{2}"), ("^", r"\textasciicircum{}"), ("[x]", "{[}x{]}"),
    ("-0.5", r"\textminus{}0.5"), ("2-3", "2-3"), ("(-1)", r"(\textminus{}1)"), ("s^-1", r"s\textsuperscript{\textminus{}1}"),
    ("NSGA-2", "NSGA-2"), ("v''", r"v\textquotesingle{}\textquotesingle{}"), ("two\nlines", "two lines"),
    ("é", "é"), ("Δ", "U+0394"), ("--", "-{}-"),
    ("\\", r"\textbackslash{}")])
def test_special_characters_are_escaped(plain: str, latex_form: str) -> None:
    assert escaped_for_latex(plain) == latex_form


def test_markdown_rows_are_as_wide_as_their_heads(cases: list[Case]) -> None:
    for block in as_markdown(answer_questions(cases)).split("\n\n"):
        lines = [line.replace(r"\|", "") for line in block.splitlines() if line.startswith("|")]
        assert len({line.count("|") for line in lines}) <= 1


@pytest.mark.parametrize(("question", "keys"), [
    ("rq1", {"setting", "algorithm", "metric", "p_value", "effect_size", "magnitude", "n1", "n2"}),
    ("rq2", {"setting", "baseline", "metric", "p_value", "effect_size", "magnitude", "n1", "n2"}),
    ("rq3.2", {"setting", "characteristic", "j", "percent"}),
    ("rq3.3", {"setting", "characteristic", "direction", "j", "pc", "delta", "n"}),
    ("rq3.3-safety", {"setting", "quantity", "j", "value", "percent", "n"}),
    ("collisions", {"setting", "algorithm", "solutions", "collisions", "share"})])
def test_json_records_have_the_promised_keys(question: str, keys: set[str]) -> None:
    records = json.loads(as_json(answer_questions([rich_setting()], question)[:1]))
    extra = {"rq1": {"method", "mean", "original"}, "rq2": {"method"}}.get(question, set())
    for one in records:
        assert set(one) == keys | extra | ({"rank"} if one.get("j") == "any" and question == "rq3.2" else set())
        assert all(isinstance(one[name], int) for name in ("n1", "n2", "n", "rank", "solutions", "collisions") if name in one)


def test_significant_and_notable_cells_stand_out() -> None:
    cases = [made_up(*(row(run=i % 8, sd=1 - i / 100) for i in range(30)))]
    result = answer_questions(cases, "rq1")
    assert "<0.001*  0.000*" in as_text(result)
    assert r"\textbf{\textless{}0.001} & \textbf{0.000}" in as_latex(result)
    assert r"**\<0.001** | **0.000**" in as_markdown(result)
    even = as_text(answer_questions([made_up(row(sd=1), row(sd=3))], "rq1")).splitlines()
    assert next(line for line in even if " SD " in line).count("*") == 0


@pytest.mark.parametrize("layouts", [None, PAPER_LAYOUTS])
def test_pooled_solutions_of_too_few_runs_do_not_stand_out_either(layouts: Layouts | None) -> None:
    """As at the end of a study: seven runs are too few for RQ1, five are enough for RQ2, whatever the number of solutions."""
    case = made_up(*(row(name, run=i % 7, sd=sd - i / 100) for name, sd in (("nsga2", 0.5), ("rs", 1.5)) for i in range(30)))
    for question, stands_out in (("rq1", False), ("rq2", True)):
        (answer,) = answer_questions([case], question)
        lines = [line for line in as_text([answer], layouts).splitlines() if "<0.001" in line]
        assert lines
        assert any("*" in line for line in lines) is stands_out
        assert any("too few runs of NSGA-II, RS for a test (8 are needed)" in note for note in answer.notes) is not stands_out
    (imported,) = answer_questions([dataclasses.replace(case, has_runs=False)], "rq1")
    assert "*" in as_text([imported], layouts).replace("(or *)", ""), "the runs of imported solutions are unknown"


@pytest.mark.parametrize("question", ["rq1-runs", "rq2-runs"])
def test_a_large_effect_of_too_few_runs_does_not_stand_out(question: str) -> None:
    document = as_latex(answer_questions([rich_setting()], question))
    assert "& large &" in document
    assert r"\textbf" not in document
    assert r"p \textless{} 0.01 after Holm)}" in document


@pytest.mark.parametrize("kind", list(FORMATS))
def test_what_cannot_be_told_is_never_a_nan(kind: str) -> None:
    cases = [made_up(row(sd=-1), row("rs", tet=None, ave_dece=None), original={"safety_degree": 0.5})]
    assert "nan" not in FORMATS[kind](answer_questions(cases)).lower()


def test_the_papers_layout_has_cases_by_metrics_and_cells_of_p_and_a12() -> None:
    cases = [made_up(*(row(run=i % 8, sd=1 - i / 100) for i in range(30))), rich_setting(name="wet", weather="hard_rain")]
    output = as_text(answer_questions(cases, "rq1"), PAPER_LAYOUTS)
    head = next(line for line in output.splitlines() if line.startswith("case"))
    assert head.split() == ["case", "algorithm", "SD", "TET", "TIT", "aveDece"]
    assert "<0.001 / 0.000*" in output
    for one in answer_questions(cases, "rq1")[0].frame.to_dict("records"):
        if one["p_value"] is not None and one["p_value"] >= 0.001:
            assert f"{one['p_value']:.3f} / {one['effect_size']:.3f}" in output


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


@pytest.mark.slow
@pytest.mark.parametrize("study", ["made-up", "lgsvl"])
@pytest.mark.parametrize("name", [*FIGURES_OF_ALL_CASES, *FIGURES_OF_ONE_CASE])
def test_axes_are_labelled_and_no_text_lies_on_another(name: str, study: str, case: Case) -> None:
    shown = case if study == "made-up" else random_setting(study)
    if name == "critical-differences":
        shown = three_algorithms()
    figure = FIGURES_OF_ALL_CASES[name]([shown]) if name in FIGURES_OF_ALL_CASES else FIGURES_OF_ONE_CASE[name](shown)
    _check_layout(figure, name)


@pytest.mark.slow
def test_cases_stand_side_by_side_in_one_figure(case: Case) -> None:
    cases = [dataclasses.replace(case, name=f"case {i}") for i in range(2)]
    figure = draw_change_counts(cases)
    assert [axis.get_title() for axis in figure.axes if axis.axison] == [one.name for one in cases]
    _check_layout(figure, "rq3.1-number-of-changes")
    result, lacking = draw_figures(cases)
    assert [name for name in result if name.startswith("rq3.1")] == ["rq3.1-number-of-changes"]
    assert "case 1-convergence" in result
    assert not lacking


def test_numbers_of_changes_stand_in_the_order_of_numbers() -> None:
    (axis,) = (axis for axis in draw_change_counts([random_setting("sun")]).axes if axis.axison)
    assert [label.get_text() for label in axis.get_xticklabels()] == [str(j) for j in range(1, 13)]


def test_the_original_vehicle_and_the_line_of_collisions_are_in_the_fronts(case: Case) -> None:
    for axis, marked in zip(draw_pareto_fronts(case).axes, (True, True, False), strict=True):
        output = {str(line.get_label()): line for line in axis.lines}
        assert float(output["original vehicle"].get_xdata()[0]) == (case.original["safety_degree"] if marked else 0.0)  # type: ignore[index,arg-type]
        assert ("collision: 0 or less" in output) == marked


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
    for words, box in boxes:
        assert min(box.x0, box.y0, figure.bbox.x1 - box.x1, figure.bbox.y1 - box.y1) > -1, f"{words!r} is cut off"


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


@pytest.mark.slow
def test_what_cannot_be_drawn_says_why(tmp_path: Path) -> None:
    imported = made_up(row(values=(1100, 2, 0.1)), has_runs=False)
    written, lacking = save_figures([imported], tmp_path, "svg")
    assert sorted(path.name for path in written) == [
        "made-up-pareto-fronts.svg", "made-up-rq3.2-changed-characteristics.svg", "made-up-rq3.3-sizes-of-changes.svg"]
    assert any("imported" in reason for reason in lacking)
    for one in (draw_change_sizes, draw_changed_characteristics):
        with pytest.raises(UnanswerableError, match="no critical solution"):
            one(made_up(row(sd=9)))
    with pytest.raises(InputError, match="no finished run"):
        save_figures([made_up()], tmp_path, "png")


@pytest.mark.slow
def test_names_are_no_formulas(tmp_path: Path) -> None:
    strange = made_up(row(values=(1100, 2, 0.1)), study=made_up_study())
    object.__setattr__(strange, "name", "a$b$c ^_/é")
    written, _ = save_figures([strange], tmp_path, "svg")
    assert all(path.parent == tmp_path for path in written)
