"""The notebooks: stored with what they show, and each runs from its first cell to its last in a
folder of its own.
"""

from __future__ import annotations

import base64
import io
import re
import sys
import tempfile
from pathlib import Path

import nbformat
import pytest
from PIL import Image

import safevar_sumo as sv
from tests.support.in_process import SLOW, InlinePool
from tests.support.made_up import SUN, published_rows, uniform
from tests.support.needs import need_library

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
SHOWN = {"quickstart": (1, 2), "rq1": (2, 0), "rq2": (1, 2), "rq3": (4, 3)}
"""Number of cells that show an answer with tables and of those that show a picture, by notebook."""
OTHERS = ("answers", "paper")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where they run, one after the other: the first one's small study serves them all."""
    return tmp_path_factory.mktemp("notebooks")


def test_there_are_no_others() -> None:
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == {*SHOWN, *OTHERS}


@pytest.mark.parametrize("name", [*SHOWN, *OTHERS])
def test_a_notebook_needs_only_the_public_names(name: str) -> None:
    cells = _read(name).cells
    code = "\n".join(cell.source for cell in cells if cell.cell_type == "code")
    assert re.findall(r".*\bsafevar_sumo\b.*", code) == ["import safevar_sumo as sv"]
    assert set(re.findall(r"\bsv\.(\w+)", code)) <= set(sv.__all__)


@pytest.mark.parametrize("name", SHOWN)
def test_a_notebook_is_stored_with_what_it_shows(name: str) -> None:
    notebook = _read(name)
    nbformat.validate(notebook)
    assert _shown(notebook) == SHOWN[name]


def test_stored_outputs_are_of_todays_vehicle() -> None:
    """`python -m tests.test_notebooks [NAME]...` stores them anew."""
    texts = {name: _texts(_read(name)) for name in (*SHOWN, "answers")}
    assert str(sv.simulate("sun").metrics["safety_degree"]) in "".join(
        texts["quickstart"]
    )
    results = [
        text
        for name in SHOWN
        for text in texts[name]
        if text.startswith("<Results of sun")
    ]
    assert results == results[:1] * len(SHOWN)
    assert "of all unsafe vehicles lie in this region" in "".join(texts["answers"])
    assert all(path.stat().st_size < 500_000 for path in NOTEBOOKS.glob("*.ipynb"))


@SLOW
@pytest.mark.parametrize("name", SHOWN)
def test_a_notebook_shows_its_tables_and_pictures(
    name: str, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a smaller study than the one that its stored outputs come from."""
    monkeypatch.setenv("SAFEVAR_RUNS", "2")
    monkeypatch.setenv("SAFEVAR_EVALUATIONS", "200")
    assert _shown(_executed(name, place, timeout=240)) == SHOWN[name]


@SLOW
def test_the_notebook_of_the_paper_shows_published_solutions_beside_a_study(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With made-up rows in the published format, and a smaller study."""
    settings = uniform(SUN, 60, 5)
    rows = published_rows(
        SUN, settings, sv.evaluate("sun", settings, pool=InlinePool())
    )
    for name in ("nsga2", "rs", "fuzzer"):
        rows.to_csv(tmp_path / f"sun_{name}.csv", index=False)
    monkeypatch.setenv("SAFEVAR_PUBLISHED", str(tmp_path))
    monkeypatch.setenv("SAFEVAR_RUNS", "2")
    monkeypatch.setenv("SAFEVAR_EVALUATIONS", "200")
    for notebook in (_read("paper"), _executed("paper", place, timeout=240)):
        assert _shown(notebook) == (0, 0)
        tables = [
            text
            for text in _texts(notebook)
            if "results/small" in text and "results/published" in text
        ]
        assert len(tables) == 6


def _read(name: str) -> nbformat.NotebookNode:
    return nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)


def _executed(name: str, place: Path, timeout: int) -> nbformat.NotebookNode:
    notebook = _read(name)
    client = need_library("nbclient").NotebookClient(
        notebook,
        timeout=timeout,
        kernel_name="python3",
        record_timing=False,
        resources={"metadata": {"path": str(place)}},
    )
    client.execute()
    return notebook


def _outputs(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [
        output
        for cell in notebook.cells
        if cell.cell_type == "code"
        for output in cell.outputs
    ]


def _texts(notebook: nbformat.NotebookNode) -> list[str]:
    """Everything that a notebook's cells print or return, as text."""
    return [
        output.get("text") or output.get("data", {}).get("text/plain", "")
        for output in _outputs(notebook)
    ]


def _shown(notebook: nbformat.NotebookNode) -> tuple[int, int]:
    """Number of answers and of pictures that a notebook shows; refuses outputs on stderr."""
    outputs = _outputs(notebook)
    assert not [
        output
        for output in outputs
        if output.get("name") == "stderr" or output.output_type == "error"
    ]
    data = [output.get("data", {}) for output in outputs]
    answers = sum("<caption>" in one.get("text/html", "") for one in data)
    return answers, sum("image/png" in one for one in data)


@SLOW
def test_every_question_has_its_table_picture_or_sentence(tmp_path: Path) -> None:
    notebook = _executed("answers", tmp_path, timeout=900)
    outputs = _outputs(notebook)
    shown = [output.get("data", {}) for output in outputs]
    assert (
        sum("text/html" in data for data in shown),
        sum("image/png" in data for data in shown),
    ) == (5, 3)
    printed = "".join(_texts(notebook))
    for result in (
        "vehicle that was tested within these limits",
        "The probability that a vehicle",
        "of all unsafe vehicles lie in this region",
    ):
        assert result in printed
    assert not [output for output in outputs if output.get("name") == "stderr"]


def main() -> None:
    """Execute notebooks, by default all, and store them with their outputs, pictures in 128
    colours: a third of the size. `paper` needs the published files.
    """
    with tempfile.TemporaryDirectory() as folder:
        for name in sys.argv[1:] or (*SHOWN, *OTHERS):
            notebook = _executed(name, Path(folder), timeout=1800)
            for data in [
                output["data"]
                for cell in notebook.cells
                for output in cell.get("outputs", [])
                if "data" in output
            ]:
                if "image/png" in data:
                    drawn = Image.open(io.BytesIO(base64.b64decode(data["image/png"])))
                    picture = io.BytesIO()
                    drawn.convert("RGB").quantize(128).save(
                        picture, "png", optimize=True
                    )
                    data["image/png"] = base64.b64encode(picture.getvalue()).decode()
            nbformat.write(notebook, NOTEBOOKS / f"{name}.ipynb")


if __name__ == "__main__":
    main()
