"""Results directories as versions before have left them: read, or refused clearly."""

from __future__ import annotations

import shutil
from pathlib import Path

import pandas as pd
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.results import ResultsDirectory, load
from safevar_sumo.results.manifest import FORMAT
from safevar_sumo.study import load_study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.workers.identity import identity_of

STORED = Path(__file__).with_name("stored")


@pytest.mark.parametrize("stored", ["format-1", "format-2", "format-3"])
def test_stored_results_are_read_as_they_were_written(stored: str) -> None:
    found = load(STORED / stored)
    assert found.finished == (("nsga2", 0), ("rs", 0))
    assert len(found.evaluations) == 20
    assert found.solutions.to_csv(index=False, lineterminator="\n").encode() == (STORED / stored / "solutions.csv").read_bytes()
    keys = ["algorithm", "run", *list(found.solutions.columns[2:14])]
    assert len(found.solutions.merge(found.evaluations, on=keys)) == len(found.solutions), "what is solved was evaluated"
    if stored == "format-2":
        pd.testing.assert_frame_equal(found.evaluations, load(STORED / "format-1").evaluations)


def test_the_format_that_is_written_now_is_stored_here() -> None:
    assert (STORED / f"format-{FORMAT}").is_dir()


@pytest.mark.parametrize(("stored", "told"), [("format-1", r"version 0\.[12]\.0 wrote them"), ("format-2", r"version 0\.2\.0 wrote them"),
                                              ("format-3", "holds results of another study")])
def test_stored_results_are_not_gone_on_with_by_other_code(stored: str, told: str, tmp_path: Path) -> None:
    shutil.copytree(STORED / stored, tmp_path / "out")
    study = load_study("smoke", search={"algorithms": ["nsga2", "rs"], "evaluations": 10})
    with pytest.raises(InputError, match=told):
        ResultsDirectory(tmp_path / "out", study, identity_of(study, assemble(study)) | {"results": 0})


def test_a_format_of_the_future_is_refused(tmp_path: Path) -> None:
    shutil.copytree(STORED / f"format-{FORMAT}", tmp_path / "out")
    manifest = tmp_path / "out" / "manifest.json"
    manifest.write_text(manifest.read_text().replace(f'"format": {FORMAT}', f'"format": {FORMAT + 1}'))
    with pytest.raises(InputError, match="is not a manifest of this version of the program"):
        load(tmp_path / "out")
