"""Answers rendered: the same numbers in every format, LaTeX that compiles, figures that can be read."""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from safevar_sumo.analysis.research_questions.answer import answer_questions
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.analysis.research_questions.tables import as_json, as_latex, as_markdown, as_text
from safevar_sumo.study import CharacteristicTable
from tests.research_questions.made_up import made_up, made_up_study, row
from tests.research_questions.test_questions import three_algorithms


def rich_case(**changes: Any) -> Case:
    """Two algorithms, two runs, changes of one to three characteristics, collisions; every run has evaluations."""
    values = [(1000 + 50 * i, 2 - 0.1 * (i % 3), 0.1 if i % 2 else 0.2) for i in range(8)]
    rows = [
        row(
            algorithm, run, values=value, sd=1 - 0.3 * i + 0.1 * run + (0.5 if algorithm == "rs" else 0), tet=1 + i / 10
        )
        for algorithm in ("nsga2", "rs")
        for run in (0, 1)
        for i, value in enumerate(values)
    ]
    return made_up(
        *rows, study=made_up_study(**changes), evaluations=[{**one, "evaluation": i % 8} for i, one in enumerate(rows)]
    )


def special_case() -> Case:
    """Names and units with the characters that LaTeX and Markdown read as commands."""
    tables = {
        name: CharacteristicTable(unit=name, original=1, lower=0.5, upper=2)
        for name in ("a&b", "50%_of $x$", "#1 {brace}", r"back\slash", "~tilde^2", "[option]", "*star|", "µ ° ² ä")
    }
    case = made_up(row(), row("rs"), study=made_up_study(characteristics=tables))
    solutions = case.solutions.assign(**{name: 1.5 if i < 4 else 1.0 for i, name in enumerate(tables)})
    return dataclasses.replace(case, name="_".join(tables), solutions=solutions)


CASES = {
    "one": [rich_case()],
    "two": [rich_case(), rich_case(name="wet", weather="hard_rain")],
    "special": [special_case()],
}
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
@pytest.mark.parametrize("cases", CASES.values(), ids=CASES)
def test_latex_compiles(cases: list[Case], tmp_path: Path) -> None:
    answers = answer_questions(cases)
    document = DOCUMENT % as_latex(answers)
    (tmp_path / "tables.tex").write_text(document, encoding="utf-8")
    done = subprocess.run(
        ["pdflatex", "-halt-on-error", "-interaction=nonstopmode", "tables.tex"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:]


@pytest.mark.parametrize(
    ("question", "keys"),
    [
        ("rq1", "setting algorithm metric p_value effect_size magnitude n1 n2 method mean original"),
        ("rq2", "setting baseline metric p_value effect_size magnitude n1 n2 method"),
        ("rq3.2", "setting characteristic j percent"),
        ("rq3.3", "setting characteristic direction j pc delta n"),
        ("rq3.3-safety", "setting quantity j value percent n"),
        ("collisions", "setting algorithm solutions collisions share"),
    ],
)
def test_json_records_have_the_promised_keys(question: str, keys: str) -> None:
    for one in json.loads(as_json(answer_questions(CASES["one"], question)[:1])):
        assert list(one) == [*keys.split(), *(["rank"] if question == "rq3.2" and one["j"] == "any" else [])]
        assert all(
            isinstance(one[name], int) for name in ("n1", "n2", "n", "rank", "solutions", "collisions") if name in one
        )


def test_pooled_solutions_of_too_few_runs_do_not_stand_out_either() -> None:
    """As at the end of a study: seven runs are too few for RQ1, five are enough for RQ2, whatever the number of
    solutions.
    """
    case = made_up(
        *(row(name, run=i % 7, sd=sd - i / 100) for name, sd in (("nsga2", 0.5), ("rs", 1.5)) for i in range(30))
    )
    for question, stands_out in (("rq1", False), ("rq2", True)):
        (answer,) = answer_questions([case], question)
        lines = [line for line in as_text([answer]).splitlines() if "<0.001" in line]
        assert lines
        assert any("*" in line for line in lines) is stands_out
        assert (
            any("too few runs of NSGA-II, RS for a test (8 are needed)" in note for note in answer.notes)
            is not stands_out
        )
    (imported,) = answer_questions([dataclasses.replace(case, has_runs=False)], "rq1")
    assert "*" in as_text([imported]).replace("(or *)", ""), "the runs of imported solutions are unknown"


@pytest.mark.parametrize("question", ["rq1-runs", "rq2-runs"])
def test_a_large_effect_of_too_few_runs_does_not_stand_out(question: str) -> None:
    document = as_latex(answer_questions(CASES["one"], question))
    assert "& large &" in document
    assert r"\textbf" not in document


def test_every_rendering_has_every_effect() -> None:
    answers = answer_questions([three_algorithms()])
    for output in (render(answers) for render in (as_text, as_markdown, as_latex)):
        assert all(f"{effect:.3f}" in output for answer in answers for effect in answer.frame.get("effect_size", ()))
