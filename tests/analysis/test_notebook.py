"""The notebook that walks an engineer through one study runs from its first cell to its last."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[2] / "notebooks" / "answers.ipynb"


@pytest.mark.slow
def test_every_question_has_its_table_picture_or_sentence(tmp_path: Path) -> None:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=900, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    shown = [output.get("data", {}) for output in outputs]
    assert (sum("text/html" in data for data in shown), sum("image/png" in data for data in shown)) == (3, 4)
    printed = "".join(output["text"] for output in outputs if output.output_type == "stream" and output.name == "stdout")
    for said in ("The original stops", "all together", "with 95 % confidence", "SD is below 1.1 in"):
        assert said in printed
    assert not [output for output in outputs if output.get("name") == "stderr"]
