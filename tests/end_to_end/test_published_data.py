"""validate, import, tables and figures as a user types them."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from safevar_sumo.reference.rows import package_filter
from safevar_sumo.sumo.matrix import drive_and_score
from tests.support.in_process import SLOW, json_of, refused, rows_of, run
from tests.support.made_up import SUN, published_rows, system_of, uniform


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Forty settings of the study sun in the published format, with the metrics that this package
    finds; some changes are below the threshold.
    """
    system = system_of("sun")
    characteristics = system.characteristics
    settings = uniform(characteristics, 40, 3)
    settings[::2, :6] = characteristics.original[:6] + 0.001
    result = drive_and_score(system, package_filter(characteristics, settings))
    path = tmp_path_factory.mktemp("data") / "mine.csv"
    rows = published_rows(characteristics, settings, result.metrics)
    rows.to_csv(path, index=False)
    return path


@SLOW
def test_validate_agrees_perfectly_with_itself(data: Path) -> None:
    output = json_of(f"validate sun {data}")
    assert (output["question"], output["study"], output["numbers"]["rows"]) == (
        "validate",
        "sun",
        40,
    )
    table = output["tables"]["agreement"]
    assert all(list(row) == list(table["columns"]) for row in table["rows"])
    errors = [
        row[name] for row in table["rows"] for name in ("mean_absolute_error", "bias")
    ]
    assert errors == pytest.approx([0.0] * 8, abs=1e-12)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of two algorithms and two runs, as the command leaves it."""
    place = tmp_path_factory.mktemp("study") / "small"
    run(f"study smoke --evaluations 100 --out {place} --quiet")
    return place


@SLOW
def test_figures_are_png_and_pdf_files(results: Path, in_tmp: Path) -> None:
    run(f"tables {results} --figures pictures --plot counts.svg")
    files = sorted(Path("pictures").iterdir())
    assert len(files) == 10
    starts = {".png": b"\x89PNG", ".pdf": b"%PDF"}
    assert all(path.read_bytes().startswith(starts[path.suffix]) for path in files)
    fonts = b"".join(path.read_bytes() for path in files if path.suffix == ".pdf")
    assert b"/Type3" not in fonts, "publishers refuse such fonts"
    assert b"/TrueType" in fonts or b"/CIDFontType2" in fonts
    assert Path("counts.svg").read_bytes().startswith(b"<?xml")


@SLOW
def test_tables_prints_what_answers_the_questions_and_all_of_them_if_asked(
    results: Path,
) -> None:
    short, whole = (run(f"tables {results}{end}").stdout for end in ("", " --details"))
    for title in ("RQ2 over runs", "RQ3.1", "Medians over runs"):
        assert title not in short
        assert title in whole
    assert len(short.splitlines()) <= 30
    assert "By --table NAME: rq1, rq2." in whole
    assert "RQ1 as published" in run(f"tables {results} --table rq1").stdout
    assert "rq3.2" in json_of(f"tables {results}")["tables"]


def test_imported_solutions_are_filtered_and_counted_anew(
    data: Path, in_tmp: Path
) -> None:
    run(f"import sun --out imported --nsga2 {data} --rs {data}")
    assert sorted(path.name for path in Path("imported").iterdir()) == [
        "manifest.json",
        "solutions.csv",
    ]
    frame = pd.read_csv("imported/solutions.csv")
    assert frame["algorithm"].value_counts().to_dict() == {"nsga2": 40, "rs": 40}
    assert "run" not in frame
    pd.read_csv(data).assign(
        mass=lambda rows: rows["mass"].where(rows.index > 0, 9e9)
    ).to_csv("heavy.csv", index=False)
    output = run("import sun --out imported --rs heavy.csv")
    assert "1 rows with values outside the domains are left out" in output.stderr
    assert "39 solutions" in output.stdout
    changed = frame.iloc[:, 1:13].to_numpy() != SUN.original
    assert np.count_nonzero(~changed[:, :6].any(axis=1)) == 40, (
        "changes below the threshold are put back"
    )
    assert frame["f_num_diff"].tolist() == changed.sum(axis=1).tolist()
    assert np.allclose(
        frame["f_diff"], np.max(np.abs(frame.iloc[:, 1:13] / SUN.original - 1), axis=1)
    )


@SLOW
def test_an_unfinished_campaign_is_answered_as_far_as_it_went(
    results: Path, in_tmp: Path
) -> None:
    shutil.copytree(results, "part")
    Path("part/runs/rs-01.jsonl").unlink()
    Path("part/solutions.csv").unlink()
    output = json_of("tables part")
    assert "incomplete: 1 of 2 runs of rs are finished" in str(
        output["tables"]["remarks"]
    )
    assert "1 of 2 runs of rs" in run("rules part --samples 64 --jobs 1").stderr
    records = rows_of(output, "rq2")
    assert next(one for one in records if one["metric"] == "igd")["n2"] == 1
    assert "budget" not in output["tables"]
    assert {*json_of("tables part --table budget")["tables"]} == {
        "budget",
        "remarks",
    }
    Path("part/runs/rs-00.jsonl").unlink()
    assert "only nsga2" in run("tables part --table rq2").stdout
    refused("tables part --table budget", "only nsga2")
    for path in Path("part/runs").glob("nsga2-*"):
        path.write_bytes(path.read_bytes()[:-20])
    goes_on = "`study` goes on where it was interrupted"
    refused("tables part", "no run is finished", goes_on)
    for path in Path("part/runs").glob("nsga2-*"):
        path.unlink()
    answer = run("explain part --jobs 1")
    assert "none of the examined vehicles is unsafe" in answer.stdout
    assert "nan %" not in answer.stdout
    assert answer.stderr.count("warning") == 1, (
        "the unfinished runs, and nothing of numpy"
    )
