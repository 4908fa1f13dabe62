"""The notebooks: stored without output, and each runs from its first cell to its last in a folder of its own."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
SHOWN = {"quickstart": (1, 1), "rq1": (2, 0), "rq2": (1, 2), "rq3": (4, 3)}
"""How many cells show tables and how many a picture."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where they run, one after the other: the first one's small study serves them all."""
    return tmp_path_factory.mktemp("notebooks")


def test_there_are_no_others() -> None:
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == {*SHOWN, "answers"}  # which has a test beside its room


@pytest.mark.parametrize("name", SHOWN)
def test_a_notebook_is_stored_without_output(name: str) -> None:
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            assert cell.outputs == []
            assert cell.execution_count is None


@pytest.mark.parametrize("name", SHOWN)
def test_a_notebook_shows_its_tables_and_pictures(name: str, place: Path) -> None:
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    NotebookClient(notebook, timeout=120, kernel_name="python3", resources={"metadata": {"path": str(place)}}).execute()
    shown = [output.get("data", {}) for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    tables = [data["text/markdown"] for data in shown if "text/markdown" in data]
    assert (len(tables), sum("image/png" in data for data in shown)) == SHOWN[name]
    assert all("| :--- |" in table or "no critical solution" in table for table in tables)
    assert not [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs if output.get("name") == "stderr"]
