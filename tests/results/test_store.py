"""A results directory: its bytes, its columns, and its errors."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from msgspec.structs import replace

from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.case import Results, load_cases
from safevar_sumo.records import Evaluations
from safevar_sumo.results import (
    ResultsDirectory,
    SolutionId,
    choose_handle,
    handles_of,
    record,
    row_of_handle,
    solutions_frame,
)
from safevar_sumo.results.identity import (
    evaluation_keys,
    identity_digest,
    manifest_differences,
    manifest_of,
    packages_of,
)
from safevar_sumo.results.manifest import read_manifest
from safevar_sumo.study import Study, tables_of
from tests.support.formulas import carried_out, with_search
from tests.support.in_process import SLOW, json_of, refused, rows_of, run
from tests.support.made_up import made_up_evaluations

NAMES = ("a", "b")


def evaluations(*safety: float) -> Evaluations:
    values = np.array(safety)
    exposure = {
        name: np.where(values <= 0, np.nan, time)
        for name, time in (("tet", 0.2), ("tit", 0.1))
    }
    return made_up_evaluations(
        values,
        settings=np.arange(2.0 * len(values)).reshape(-1, 2),
        metrics={
            "safety_degree": values,
            **exposure,
            "ave_dece": np.full(len(values), 5.0),
        },
        f_diff=values * 0 + 0.5,
        f_num_diff=values * 0 + 2,
    )


def results_directory(path: Path, study: Study) -> ResultsDirectory:
    return ResultsDirectory(path, study, manifest_of(study, {}))


def written(path: Path, study: Study) -> ResultsDirectory:
    directory = results_directory(path, study)
    directory.begin(evaluations(2.5))
    directory.finish({("nsga2", 0): wide(study)})
    return directory


def wide(study: Study) -> Evaluations:
    """One evaluation with as many characteristics as the study has."""
    return dataclasses.replace(
        evaluations(1.0), settings=np.ones((1, len(study.vehicle.characteristics)))
    )


@pytest.fixture
def study() -> Study:
    return load_study("smoke")


def test_solutions_have_the_promised_columns_in_a_fixed_order() -> None:
    result = {("nsga2", 1): evaluations(2.0, -1.0), ("nsga2", 0): evaluations(3.0)}
    frame = solutions_frame(NAMES, result.items())
    assert " ".join(frame.columns) == (
        "algorithm run a b f_safe f_diff f_num_diff safety_degree tet tit ave_dece outcome"
    )
    assert frame["run"].tolist() == [0, 1, 1]
    assert frame["f_safe"].tolist() == [3.0, -1.0, 2.0]
    pd.testing.assert_frame_equal(
        frame, solutions_frame(NAMES, reversed(result.items()))
    )


def test_undefined_values_stay_undefined() -> None:
    assert record(evaluations(-1.5)) == {
        "outcome": "collision",
        "collision": True,
        "collision_speed": 1.5,
        "safety_degree": -1.5,
        "tet": None,
        "tit": None,
        "ave_dece": 5.0,
        "f_safe": -1.5,
        "f_diff": 0.5,
        "f_num_diff": 2,
    }
    assert (
        "nan"
        not in solutions_frame(NAMES, [(("nsga2", 0), evaluations(-1.5))]).to_csv()
    )


def test_results_of_another_study_are_not_overwritten(
    tmp_path: Path, study: Study
) -> None:
    written(tmp_path, study)
    results_directory(tmp_path, study)
    results_directory(tmp_path, with_search(study, runs=7))
    with pytest.raises(InputError, match=r"search\.seed was 1 and is 2 now"):
        results_directory(tmp_path, with_search(study, seed=2))
    with pytest.raises(InputError, match="holds results of another study"):
        results_directory(tmp_path, load_study("native"))


def test_a_change_without_effect_on_results_is_accepted(
    tmp_path: Path, study: Study
) -> None:
    written(tmp_path, study)
    for other in (
        replace(study, title="Another title", published={}),
        with_search(study, time_limit=7, runs=3, evaluations=900),
        with_search(study, algorithms=["rs"]),
    ):
        assert identity_digest(
            results_directory(tmp_path, other).manifest
        ) == identity_digest(results_directory(tmp_path, study).manifest)


def test_results_of_listed_encounters_do_not_depend_on_ranges() -> None:
    def keys(encounters: str, **scenario: Any) -> Any:
        study = load_study("smoke", encounters=encounters, scenario=scenario)
        return evaluation_keys(tables_of(study))

    friction = {"road_friction": {"lower": 0.5}}
    assert keys("tests", margin=1, over=friction) == keys("tests")
    assert keys("ranges") not in (
        keys("tests"),
        keys("ranges", margin=1),
        keys("ranges", over=friction),
    )


def turned(record: Any, key: str) -> Any:
    """A record with the keys of one of its tables in the opposite order."""
    return replace(record, **{key: dict(reversed(getattr(record, key).items()))})


def test_the_order_of_a_table_counts_where_settings_or_points_are_arrays_in_it() -> (
    None
):
    wear, joint = load_study("wear"), load_study("sun", encounters="ranges")
    matrix = replace(
        wear.matrix, tests=[turned(test, "over") for test in wear.matrix.tests]
    )
    for study, order, changes in (
        (
            wear,
            "vehicle.order of characteristics",
            {"vehicle": turned(wear.vehicle, "characteristics")},
        ),
        (joint, "scenario.order of over", {"scenario": turned(joint.scenario, "over")}),
        (wear, "matrix.tests", {"matrix": matrix}),
        (wear, "", {"vehicle": turned(wear.vehicle, "parameters")}),
        (wear, "", {"metrics": wear.metrics}),
    ):
        before = manifest_of(study, {})
        after = manifest_of(replace(study, **changes), {})
        differences = [*manifest_differences(before, after)]
        assert (
            (identity_digest(before) == identity_digest(after))
            == (not differences)
            == (not order)
        )
        assert all(
            text.startswith(order) and matters for _, text, matters in differences
        )


@pytest.mark.parametrize(
    ("name", "more"),
    [
        ("rain", set()),
        ("wear_rss", {"ad-rss"}),
        ("wear_idm", {"highway-env"}),
        ("pymoo", {"pymoo", "cma"}),
    ],
)
def test_a_manifest_names_the_packages_that_its_study_uses(
    name: str, more: set[str]
) -> None:
    study = (
        load_study("smoke", search={"algorithms": ["pymoo:NSGA3"]})
        if name == "pymoo"
        else load_study(name)
    )
    assert {*packages_of(study)} == {"safevar_sumo", "libsumo", "deap", "numpy", *more}


@pytest.mark.parametrize("text", ["", "{}", "[]", "null", '{"study": 3', "\x00"])
def test_a_file_that_is_no_manifest_is_refused(
    tmp_path: Path, study: Study, text: str
) -> None:
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(InputError, match=r"manifest\.json"):
        results_directory(tmp_path, study)


def test_simulations_depend_on_files_and_the_number_of_results_but_not_on_new_keys(
    study: Study,
) -> None:
    tables = tables_of(study)
    stored = {
        "study": tables,
        "files": {"x.py": "0"},
        "results": 1,
        "versions": {"numpy": "1", "libsumo": "1"},
    }

    def changed(**layers: object) -> list[tuple[str, bool]]:
        return [
            (text, changes_simulations)
            for _, text, changes_simulations in manifest_differences(
                stored, {**stored, **layers}
            )
        ]

    assert changed(
        study={**tables, "new": False}, versions={"numpy": "2", "libsumo": "1"}
    ) == [
        ("new was None and is False now", False),
        ("version of numpy was '1' and is '2' now", False),
    ]
    assert not changed(study={**tables, "title": "new"})
    assert changed(
        study={**tables, "weather": "fog"},
        files={},
        results=2,
        versions={"libsumo": "2"},
    ) == [
        (f"weather was {tables['weather']!r} and is 'fog' now", True),
        ("x.py no longer exists", True),
        ("the version of the package's results was 1 and is 2 now", True),
        ("version of libsumo was '1' and is '2' now", True),
        ("version of numpy was '1' and is None now", False),
    ]


FRAME = pd.DataFrame(
    {
        "algorithm": ["nsga2", "nsga2", "nsga2", "rs"],
        "run": [0, 0, 3, 0],
        "f_safe": [-3.0, -1.0, -2.0, 2.0],
        "f_diff": [0.3, 0.2, 0.1, 0.01],
        "f_num_diff": [5, 2, 4, 1],
        "outcome": ["collision", "collision", "collision", "stopped"],
    }
)


def test_rows_count_within_their_run() -> None:
    assert list(map(str, handles_of(FRAME))) == [
        "nsga2:0:0",
        "nsga2:0:1",
        "nsga2:3:0",
        "rs:0:0",
    ]
    for place, handle in enumerate(handles_of(FRAME)):
        assert row_of_handle(FRAME, SolutionId.parse(str(handle))) == place


@pytest.mark.parametrize(
    ("handle", "legal"),
    [("nsga2:0:2", "nsga2:0:1"), ("nsga2:1:0", "nsga2:0:1, nsga2:3:0, rs:0:0")],
)
def test_the_error_for_a_missing_solution_names_the_present_ones(
    handle: str, legal: str
) -> None:
    with pytest.raises(InputError) as refused:
        row_of_handle(FRAME, SolutionId.parse(handle))
    assert handle in str(refused.value)
    assert legal in str(refused.value)


def test_chosen_by_what_they_are_among_the_unsafe() -> None:
    assert str(choose_handle(FRAME, Unsafe(), "most_severe")) == "nsga2:0:0"
    assert str(choose_handle(FRAME, Unsafe(), "fewest")) == "nsga2:0:1"
    assert str(choose_handle(FRAME, Unsafe(), "smallest")) == "nsga2:3:0"


def test_without_a_collision_half_the_distance_is_unsafe() -> None:
    safe = FRAME[FRAME["outcome"] == "stopped"]
    wide, narrow = (
        Unsafe.default({"safety_degree": degree}, safe["outcome"])
        for degree in (4.1, 4.0)
    )
    assert str(choose_handle(safe, wide, "smallest")) == "rs:0:0"
    with pytest.raises(InputError, match="no unsafe solution"):
        choose_handle(safe, narrow, "smallest")
    assert str(choose_handle(safe, narrow, "most_severe")) == "rs:0:0"


def test_a_criterion_in_words_is_rounded_but_its_text_is_exact() -> None:
    half = Unsafe.default({"safety_degree": 1.694206}, FRAME["outcome"].head(0))
    assert (str(half), half.description) == (
        "safety_degree < 0.847103",
        "safety degree below 0.847 m, half of the original's",
    )
    assert half == Unsafe(degree=0.847103)
    assert [
        Unsafe.parse(text).description
        for text in (
            "collision",
            "below=0.847103",
            "safety_degree < 0.847103",
            "safety_degree < -2",
            "drac > 3.5",
        )
    ] == [
        "collision",
        "collision, or clearance below 0.847103 m",
        "safety degree below 0.847 m",
        "safety degree below -2 m/s",
        "drac > 3.5, or a collision",
    ]


@pytest.fixture
def copied(slippery: Path, tmp_path: Path) -> Path:
    """A copy of results that a test may change."""
    return Path(shutil.copytree(slippery, tmp_path / "it"))


@pytest.mark.parametrize(("number", "release"), [(5, "0.4.0"), (7, "9.0.0")])
def test_results_in_another_format_are_refused_with_the_release_that_wrote_them(
    number: int, release: str, copied: Path
) -> None:
    manifest = read_manifest(copied)
    manifest["format"] = number
    manifest["versions"]["safevar_sumo"] = release
    (copied / "manifest.json").write_text(json.dumps(manifest))
    before = contents(copied)
    told = f"the release that wrote them, safevar_sumo {release}"
    for command in f"tables {copied}", f"study smoke --status --out {copied}":
        refused(command, f"in format {number}", told)
    assert contents(copied) == before


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir], ids=["a pipe", "a folder"])
def test_what_is_no_file_in_place_of_a_journal_is_refused_at_once(
    make: Callable[[Path], None], copied: Path, slippery: Path
) -> None:
    journal = copied / "runs/rs-00.jsonl"
    journal.unlink()
    make(journal)
    before = contents(copied)
    study = str(slippery.parent / "slippery.toml")
    for command in "tables", f"study {study} --quiet --out", "report":
        told = "or no file: the run then begins anew"
        refused(f"{command} {copied}", "rs-00.jsonl: is no file", told)
    assert contents(copied) == before


def as_of_another_study(journal: Path) -> None:
    journal.write_bytes(
        re.sub(rb'"study":"\w+"', b'"study":"other"', journal.read_bytes())
    )


def made_anew(make: Callable[[Path], object], path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    make(path)


IN_THE_WAY: dict[str, Callable[[Path], object]] = {
    "journal of another study": lambda out: as_of_another_study(
        out / "runs/rs-00.jsonl"
    ),
    "journal without a manifest": lambda out: [
        as_of_another_study(out / "runs/rs-00.jsonl"),
        (out / "manifest.json").unlink(),
    ],
    "file as the journals' folder": lambda out: made_anew(Path.touch, out / "runs"),
    "folder as the table": lambda out: made_anew(os.mkdir, out / "solutions.csv"),
    "pipe as the manifest": lambda out: made_anew(os.mkfifo, out / "manifest.json"),
}


@pytest.mark.parametrize("what", IN_THE_WAY)
def test_what_makes_a_study_refuse_is_found_before_anything_is_written(
    what: str, study: Study, tmp_path: Path
) -> None:
    study = with_search(study, algorithms=["rs"], runs=1)
    carried_out(study, tmp_path)
    IN_THE_WAY[what](tmp_path)
    before = contents(tmp_path)
    with pytest.raises(InputError, match=r"rs-0\d\.jsonl|manifest|solutions|runs"):
        carried_out(with_search(study, runs=2), tmp_path)
    assert contents(tmp_path) == before


def contents(place: Path) -> dict[str, tuple[bytes, int]]:
    return {
        str(path): (path.read_bytes(), path.stat().st_mtime_ns)
        for path in sorted(place.rglob("*"))
        if path.is_file()
    }


def status_of(place: Path) -> dict[str, dict[str, Any]]:
    """The rows of the status of the study in a directory, by algorithm."""
    status = json_of(f"study smoke --status --out {place}")
    return {row["algorithm"]: row for row in rows_of(status, "algorithms")}


def test_the_status_of_a_study_agrees_with_its_journals(
    slippery: Path, case: Results
) -> None:
    before = contents(slippery)
    status = status_of(slippery)
    assert contents(slippery) == before
    assert list(status) == ["nsga2", "rs"]
    for algorithm, row in status.items():
        group = case.evaluations.query(f"algorithm == '{algorithm}'")
        assert (row["finished"], row["runs"], row["simulated"]) == (1, 1, len(group))
        assert row["collisions"] == (group["outcome"] == "collision").sum()
        assert row["best"] == group["f_safe"].min()


def test_a_study_under_way(copied: Path) -> None:
    nsga2 = copied / "runs/nsga2-00.jsonl"
    (copied / "runs/rs-00.jsonl").unlink()
    (copied / "solutions.csv").unlink()  # written after the last run
    nsga2.write_bytes(
        nsga2.read_bytes()[: len(nsga2.read_bytes()) * 2 // 3]
    )  # torn, as while somebody writes
    begun, waiting = status_of(copied).values()
    assert (
        begun["finished"],
        waiting["finished"],
        waiting["simulated"],
        waiting["best"],
    ) == (
        0,
        0,
        0,
        None,
    )
    assert 0 < begun["simulated"] < 56
    nsga2.write_bytes(nsga2.read_bytes().partition(b"\n")[0] + b"\n")
    assert status_of(copied)["nsga2"]["simulated"] == 0
    assert load_cases([copied])[0].evaluations.empty


@SLOW
def test_results_of_a_study_whose_search_was_a_key_are_read_by_their_release(
    tmp_path: Path,
) -> None:
    """A key that was without effect is passed over."""
    run(f"study smoke --runs 1 --evaluations 50 --out {tmp_path}")
    manifest = read_manifest(tmp_path)
    file = tmp_path / "manifest.json"
    file.write_text(
        json.dumps(
            {
                **manifest,
                "study": {**manifest["study"], "wider": "smoke", "correlations": []},
            }
        )
    )
    assert read_manifest(tmp_path) == manifest
    manifest["study"]["scenario"]["search"] = {"distance": {}}
    file.write_text(json.dumps(manifest))
    with pytest.raises(InputError, match="release that wrote them"):
        read_manifest(tmp_path)
