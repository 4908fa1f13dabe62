"""tables, figures and import as a user types them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from safevar_sumo.study import load_study
from safevar_sumo.vehicles import CharacteristicSet
from tests.in_process import refused, run


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of two algorithms and two runs, as the command leaves it."""
    place = tmp_path_factory.mktemp("study") / "small"
    run("study", "smoke", "--evaluations", "100", "--out", str(place), "--quiet")
    return place


def package_csv(path: Path, rows: int, seed: int, **constant: float) -> Path:
    """Made-up solutions of the study sun in the published package's columns: rounded, unfiltered, radius in cm."""
    rng = np.random.default_rng(seed)
    characteristics = CharacteristicSet.of(load_study("sun"))
    settings = np.round(rng.uniform(characteristics.lower, characteristics.upper, (rows, len(characteristics))), 3)
    settings[::2, :6] = characteristics.original[:6] + 0.001
    sd = np.round(rng.uniform(-1, 3, rows), 3)
    names = [name.replace("ZeroT", "Zero") for name in characteristics.names]
    frame = pd.DataFrame(settings, columns=names).assign(
        MaxPercentage=0.5,
        SaftyDegree=sd,
        numbers=12.0,
        TIT=np.where(sd > 0, 0.5, 0),
        TET=np.where(sd > 0, 1.5, 0),
        Dece=5.0,
    )
    frame.assign(**constant).to_csv(path, index=False)
    return path


@pytest.fixture
def imported(in_tmp: Path) -> Path:
    package_csv(in_tmp / "nsga2.csv", 40, 1)
    package_csv(in_tmp / "rs.csv", 30, 2, SaftyDegree=2.5)
    run("import", "sun", "--out", "imported", "--nsga2", "nsga2.csv", "--rs", "rs.csv")
    return in_tmp / "imported"


def test_tables_agree_with_the_solutions_that_are_stored(results: Path) -> None:
    solutions = pd.read_csv(results / "solutions.csv")
    records = json.loads(run("tables", str(results), "--rq", "collisions", "--format", "json").stdout)
    for one in records:
        group = solutions[solutions["algorithm"] == one["algorithm"]]
        assert one["solutions"] == len(group)
        assert one["collisions"] == (group["outcome"] == "collision").sum()
    rq1 = json.loads(run("tables", str(results), "--rq", "rq1", "--format", "json").stdout)
    for one in rq1:
        group = solutions[(solutions["algorithm"] == one["algorithm"])]
        assert one["mean"] == pytest.approx(group[one["metric"]].mean())


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "start"), [("svg", b"<?xml"), pytest.param("pdf", b"%PDF", marks=pytest.mark.slow)])
def test_figures_are_files_of_the_kind_asked_for(kind: str, start: bytes, results: Path, in_tmp: Path) -> None:
    done = run("figures", str(results), "--out", kind, "--format", kind)
    files = sorted(Path(kind).iterdir())
    assert len(files) == 6
    assert sorted(done.stdout.split()) == [str(path) for path in files]
    assert all(path.read_bytes().startswith(start) for path in files)


def test_imported_solutions_are_filtered_and_counted_anew(imported: Path) -> None:
    assert sorted(path.name for path in imported.iterdir()) == ["manifest.json", "solutions.csv"]
    frame = pd.read_csv(imported / "solutions.csv")
    assert "run" not in frame
    assert len(frame) == 70
    characteristics = CharacteristicSet.of(load_study("sun"))
    settings = frame[list(characteristics.names)].to_numpy()
    assert (settings[:, :6] == characteristics.original[:6]).any(axis=0).all(), (
        "changes below the threshold are put back"
    )
    assert frame["f_num_diff"].tolist() == (settings != characteristics.original).sum(axis=1).tolist()
    assert np.allclose(frame["f_diff"], np.max(np.abs(settings / characteristics.original - 1), axis=1))


def test_an_unfinished_campaign_is_answered_as_far_as_it_went(results: Path, in_tmp: Path) -> None:
    shutil.copytree(results, "part")
    Path("part/runs/rs-01.jsonl").unlink()
    Path("part/solutions.csv").unlink()
    output = run("tables", "part").stdout
    assert "unfinished, rs 1 of 2 runs" in output
    records = json.loads(run("tables", "part", "--rq", "rq2", "--format", "json").stdout)
    assert next(one for one in records if one["metric"] == "igd")["n2"] == 1
    Path("part/runs/rs-00.jsonl").unlink()
    refused("tables", "part", "--rq", "rq2", message=("only nsga2",))
    for path in Path("part/runs").glob("nsga2-*"):
        path.write_bytes(path.read_bytes()[:-20])
    refused("tables", "part", message=("no finished run",))
    refused("figures", "part", "--out", "pictures", message=("no finished run",))
