"""A results directory: its bytes, its columns, and its errors."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

import safevar_sumo as sv
from safevar_sumo.analysis.research_questions.case import load_cases
from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Evaluations
from safevar_sumo.results import (
    JournalBusyError,
    ResultsDirectory,
    SolutionId,
    choose_handle,
    handles_of,
    load_runs,
    read_late_files,
    record,
    row_of_handle,
    solutions_frame,
    status,
)
from safevar_sumo.results.manifest import FORMAT, differences_now, owner_digest
from safevar_sumo.study import ModelTable, Study, load_study, tables_of
from safevar_sumo.sumo.system import assemble
from safevar_sumo.workers.identity import identity_of

NAMES = ("a", "b")


def evaluations(*safety: float) -> Evaluations:
    values = np.array(safety)
    collided = values <= 0
    metrics = {"safety_degree": values, "tet": np.where(collided, np.nan, 0.2), "tit": np.where(collided, np.nan, 0.1),
               "ave_dece": np.full(len(values), 5.0)}
    return Evaluations(settings=np.arange(2.0 * len(values)).reshape(-1, 2), outcome=np.where(collided, "collision", "stopped"),
                       collision_speed=np.where(collided, -values, np.nan), metrics=metrics, f_diff=values * 0 + 0.5,
                       f_num_diff=values * 0 + 2)


def written(path: Path, study: Study) -> ResultsDirectory:
    directory = ResultsDirectory(path, study)
    directory.begin(evaluations(2.5))
    directory.finish({("nsga2", 0): wide(study)})
    return directory


def wide(study: Study) -> Evaluations:
    """One evaluation with as many characteristics as the study has."""
    one = evaluations(1.0)
    return dataclasses.replace(one, settings=np.ones((1, len(study.vehicle.characteristics))))


@pytest.fixture
def study() -> Study:
    return load_study("smoke")


def with_search(study: Study, **changes: int) -> Study:
    return msgspec.structs.replace(study, search=msgspec.structs.replace(study.search, **changes))


def test_solutions_have_the_promised_columns_in_a_fixed_order() -> None:
    result = {("nsga2", 1): evaluations(2.0, -1.0), ("nsga2", 0): evaluations(3.0)}
    frame = solutions_frame(NAMES, result.items())
    assert list(frame.columns) == ["algorithm", "run", "a", "b", "f_safe", "f_diff", "f_num_diff", "safety_degree", "tet", "tit",
                                   "ave_dece", "outcome"]
    assert frame["run"].tolist() == [0, 1, 1]
    assert frame["f_safe"].tolist() == [3.0, -1.0, 2.0]
    pd.testing.assert_frame_equal(frame, solutions_frame(NAMES, reversed(result.items())))


def test_undefined_values_stay_undefined() -> None:
    assert record(evaluations(-1.5), 0) == {
        "outcome": "collision", "collision": True, "collision_speed": 1.5, "safety_degree": -1.5, "tet": None, "tit": None,
        "ave_dece": 5.0, "f_safe": -1.5, "f_diff": 0.5, "f_num_diff": 2}
    assert "nan" not in solutions_frame(NAMES, [(("nsga2", 0), evaluations(-1.5))]).to_csv()


def test_the_manifest_holds_study_versions_and_original(tmp_path: Path, study: Study) -> None:
    written(tmp_path / "new" / "out", study)
    manifest = json.loads((tmp_path / "new" / "out" / "manifest.json").read_text())
    assert manifest["study"] == tables_of(study)
    assert manifest["seed"] == study.search.seed
    assert manifest["original"]["safety_degree"] == 2.5
    assert manifest["versions"]["libsumo"] == "1.28.0"
    assert sorted(path.name for path in (tmp_path / "new" / "out").iterdir()) == ["manifest.json", "solutions.csv"]


def test_results_of_another_study_are_not_overwritten(tmp_path: Path, study: Study) -> None:
    written(tmp_path, study)
    ResultsDirectory(tmp_path, study)
    ResultsDirectory(tmp_path, with_search(study, runs=7))
    with pytest.raises(InputError, match=r"search\.seed was 1 and is 2 now"):
        ResultsDirectory(tmp_path, with_search(study, seed=2))
    with pytest.raises(InputError, match="holds results of another study"):
        ResultsDirectory(tmp_path, load_study("native"))


def test_the_error_names_the_changed_file_and_both_remedies(tmp_path: Path, study: Study) -> None:
    ResultsDirectory(tmp_path, study, {"sources": {"my_ads.py": "abc", "my_map.py": "def"}}).begin(evaluations(2.5))
    with pytest.raises(InputError) as caught:
        ResultsDirectory(tmp_path, study, {"sources": {"my_ads.py": "abc", "my_map.py": "012"}})
    assert "my_map.py has changed since" in str(caught.value)
    assert caught.value.legal == f"another `out`, such as `out={tmp_path}-2`, or the file as it was"
    Path(f"{tmp_path}-2").mkdir()
    with pytest.raises(InputError, match=rf"such as `out={tmp_path}-3`, or"):
        ResultsDirectory(tmp_path, study, {"sources": {"my_ads.py": "abc", "my_map.py": "012"}})
    with pytest.raises(InputError, match=r"my_map\.py no longer exists"):
        ResultsDirectory(tmp_path, study, {"sources": {"my_ads.py": "abc"}})


def test_a_change_without_effect_on_results_is_accepted(tmp_path: Path, study: Study) -> None:
    written(tmp_path, study)
    for other in (msgspec.structs.replace(study, title="Another title", published={}, calibration={}),
                  with_search(study, time_limit=7, runs=3, evaluations=900),
                  msgspec.structs.replace(study, search=msgspec.structs.replace(study.search, algorithms=["rs"]))):
        directory = ResultsDirectory(tmp_path, other)
        assert owner_digest(directory.manifest) == owner_digest(ResultsDirectory(tmp_path, study).manifest)


def test_a_whole_number_is_not_the_same_as_one_with_a_point(tmp_path: Path, study: Study) -> None:
    one, other = (msgspec.structs.replace(study, ads=ModelTable(model="my_ads:Mine", parameters={"margin": margin})) for margin in (2, 2.0))
    ResultsDirectory(tmp_path, one).begin(evaluations(2.5))
    with pytest.raises(InputError, match=r"ads\.parameters\.margin was 2 and is 2\.0 now"):
        ResultsDirectory(tmp_path, other)


def test_a_folder_that_holds_other_things_is_refused(tmp_path: Path, study: Study) -> None:
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(InputError, match=r"holds other files: thesis\.tex"):
        ResultsDirectory(tmp_path, study)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["thesis.tex"]


def test_a_directory_belongs_to_its_first_study(tmp_path: Path, study: Study) -> None:
    first = ResultsDirectory(tmp_path, study)
    second, same = ResultsDirectory(tmp_path, with_search(study, seed=2)), ResultsDirectory(tmp_path, study)
    journal = first.journal("original")
    with pytest.raises(InputError, match="is in use by another study that is running now"):
        second.journal("original")
    with pytest.raises(JournalBusyError):
        same.journal("original")
    journal.append([0], wide(study))
    journal.close()
    with pytest.raises(InputError, match="belongs to another study"):
        second.journal("original")


@pytest.mark.parametrize("text", ["", "{}", "[]", "null", "{\"study\": 3", "\x00"])
def test_a_file_that_is_no_manifest_is_refused(tmp_path: Path, study: Study, text: str) -> None:
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(InputError, match=r"manifest\.json"):
        ResultsDirectory(tmp_path, study)


def test_a_failed_write_leaves_the_file_unchanged(tmp_path: Path, study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = written(tmp_path, study)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(SafevarError, match="No space left"):
        directory.begin(evaluations(9.9))
    with pytest.raises(SafevarError, match="No space left"):
        directory.finish({})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_simulations_depend_on_files_and_the_number_of_results_but_not_on_new_keys() -> None:
    stored = {"format": FORMAT, "resolved": {"a": 1}, "network": {}, "sources": {"x.py": "0"}, "results": 1, "versions": {"numpy": "1"}}
    assert differences_now(stored, {**stored, "resolved": {"a": 1, "b": False}, "versions": {"numpy": "2"}}) == []
    assert differences_now(stored, {**stored, "resolved": {"a": 2}, "sources": {}, "results": 2}) == [
        "a was 1 and is 2 now", "x.py no longer exists", "the version of the package's results was 1 and is 2 now"]


FRAME = pd.DataFrame({
    "algorithm": ["nsga2", "nsga2", "nsga2", "rs"], "run": [0, 0, 3, 0], "f_safe": [-3.0, -1.0, -2.0, 2.0], "f_diff": [0.3, 0.2, 0.1, 0.01],
    "f_num_diff": [5, 2, 4, 1], "outcome": ["collision", "collision", "collision", "stopped"]})


def test_rows_count_within_their_run() -> None:
    assert list(map(str, handles_of(FRAME))) == ["nsga2:0:0", "nsga2:0:1", "nsga2:3:0", "rs:0:0"]
    for place, handle in enumerate(handles_of(FRAME)):
        assert row_of_handle(FRAME, SolutionId.parse(str(handle))) == place


@pytest.mark.parametrize("text", [
    "", "nsga2", "nsga2:0", "nsga2:0:", ":0:0", "nsga2:-1:0", "nsga2:0:0:0", "nsga2:0:x", "nsga2:0:" + "9" * 30])
def test_a_text_that_is_no_handle_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="ALGORITHM:RUN:N"):
        SolutionId.parse(text)


@pytest.mark.parametrize(("handle", "legal"), [("nsga2:0:2", "0 to 1"), ("nsga2:1:0", "nsga2:0, nsga2:3, rs:0"), ("sf:0:0", "nsga2:0")])
def test_the_error_for_a_missing_solution_names_the_present_ones(handle: str, legal: str) -> None:
    with pytest.raises(InputError) as refused:
        row_of_handle(FRAME, SolutionId.parse(handle))
    assert handle in str(refused.value)
    assert legal in str(refused.value)


def test_chosen_by_what_they_are_among_the_unsafe() -> None:
    assert str(choose_handle(FRAME, Unsafe(), "most_severe", "x")) == "nsga2:0:0"
    assert str(choose_handle(FRAME, Unsafe(), "fewest", "x")) == "nsga2:0:1"
    assert str(choose_handle(FRAME, Unsafe(), "smallest", "x")) == "nsga2:3:0"


def test_without_a_collision_half_the_distance_is_unsafe() -> None:
    safe = FRAME[FRAME["outcome"] == "stopped"]
    wide, narrow = (Unsafe.default({"safety_degree": degree}, safe["outcome"]) for degree in (4.1, 4.0))
    assert str(choose_handle(safe, wide, "smallest", "x")) == "rs:0:0"
    with pytest.raises(InputError, match="no unsafe solution"):
        choose_handle(safe, narrow, "smallest", "x")
    assert str(choose_handle(safe, narrow, "most_severe", "x")) == "rs:0:0"


def test_a_point_is_lost_to_six_decimals() -> None:
    """34.899405 - 1 is 33.899404999999994 in floating point."""
    unsafe = Unsafe.default({"rating_points": 34.899405, "safety_degree": -14.2}, FRAME["outcome"])
    rated = FRAME.head(2).assign(rating_points=[33.899405, 33.899406])
    assert unsafe.rows(rated).tolist() == [True, False]
    assert (str(unsafe), unsafe.in_words) == ("points=33.899405", "keeps at most 33.8994 points")


def test_a_criterion_in_words_is_rounded_but_its_text_is_exact() -> None:
    half = Unsafe.default({"safety_degree": 1.694206}, FRAME["outcome"].head(0))
    assert (str(half), half.description, half.in_words) == (
        "below=0.847103", "safety degree below 0.847 m (half of the original's, a screening limit)", "SD is below 0.847")
    assert half == Unsafe(0.847103)
    assert [Unsafe.parse(text).description for text in ("collision", "below=0.847103", "below=-2", "points=3.5")] == [
        "collision", "safety degree below 0.847 m", "safety degree below -2 m/s", "at most 3.5 points"]


STORED = Path(__file__).with_name("stored")


@pytest.mark.parametrize("stored", ["format-1", "format-2", "format-3"])
def test_stored_results_are_read_as_they_were_written(stored: str) -> None:
    result = load_runs(STORED / stored)
    assert result.finished == (("nsga2", 0), ("rs", 0))
    assert len(result.evaluations) == 20
    assert result.solutions.to_csv(index=False, lineterminator="\n").encode() == (STORED / stored / "solutions.csv").read_bytes()
    keys = ["algorithm", "run", *list(result.solutions.columns[2:14])]
    assert len(result.solutions.merge(result.evaluations, on=keys)) == len(result.solutions), "what is solved was evaluated"
    if stored == "format-2":
        pd.testing.assert_frame_equal(result.evaluations, load_runs(STORED / "format-1").evaluations)


def test_the_format_that_is_written_now_is_stored_here() -> None:
    assert (STORED / f"format-{FORMAT}").is_dir()


@pytest.mark.parametrize(("stored", "expected"), [
    ("format-1", r"version 0\.[12]\.0 wrote them"), ("format-2", r"version 0\.2\.0 wrote them"),
    ("format-3", "holds results of another study")])
def test_other_code_does_not_continue_stored_results(stored: str, expected: str, tmp_path: Path) -> None:
    shutil.copytree(STORED / stored, tmp_path / "out")
    study = load_study("smoke", search={"algorithms": ["nsga2", "rs"], "evaluations": 10})
    with pytest.raises(InputError, match=expected):
        ResultsDirectory(tmp_path / "out", study, identity_of(study, assemble(study)) | {"results": 0})


def test_a_format_of_the_future_is_refused(tmp_path: Path) -> None:
    shutil.copytree(STORED / f"format-{FORMAT}", tmp_path / "out")
    manifest = tmp_path / "out" / "manifest.json"
    manifest.write_text(manifest.read_text().replace(f'"format": {FORMAT}', f'"format": {FORMAT + 1}'))
    with pytest.raises(InputError, match="is not a manifest of this version of the program"):
        load_runs(tmp_path / "out")


def test_a_torn_manifest_is_called_torn(tmp_path: Path) -> None:
    shutil.copytree(STORED / f"format-{FORMAT}", tmp_path / "out")
    manifest = tmp_path / "out" / "manifest.json"
    manifest.write_text(text := manifest.read_text()[:300])
    with pytest.raises(InputError, match=rf"manifest\.json: is torn or was edited, line {len(text.splitlines())} is no JSON"):
        load_runs(tmp_path / "out")


def test_an_edited_manifest_is_refused_until_it_is_removed(tmp_path: Path, study: Study) -> None:
    directory = written(tmp_path, study)
    directory.journal("original").close()
    (tmp_path / "answers").mkdir()
    file = tmp_path / "manifest.json"
    file.write_text(file.read_text().replace('"safety_degree": 2.5', '"safety_degree": 9.5'))
    with pytest.raises(InputError, match=r"manifest\.json: was edited"):
        ResultsDirectory(tmp_path, study)
    file.unlink()
    ResultsDirectory(tmp_path, study).begin(evaluations(2.5))
    assert json.loads(file.read_text())["original"]["safety_degree"] == 2.5


@pytest.mark.parametrize("content", [b"", b'{"my_table.csv": "ab', b"{}", b"[]", b"3", b'["\xff"]', b'{"other.csv": "ab"}'])
def test_a_damaged_record_of_an_input_is_an_error_not_a_forgotten_input(tmp_path: Path, study: Study, content: bytes) -> None:
    written(tmp_path, study).record_late_files({"my_table.csv": "ab"})
    assert read_late_files(tmp_path) == {"my_table.csv": "ab"}
    (file,) = (tmp_path / "runs").glob("read-*.json")
    file.write_bytes(content)
    before = contents(tmp_path)
    with pytest.raises(InputError, match=rf"{file.name}: (is torn or )?was edited"):
        ResultsDirectory(tmp_path, study)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("content", [b"", b'["..', b"{}", b"3", b"[3]", b'["\xff"]'])
def test_a_damaged_record_of_folders_is_an_error_until_it_is_removed(slippery: Path, tmp_path: Path, content: bytes) -> None:
    shutil.copytree(slippery, tmp_path / "it")
    file = tmp_path / "it/runs/places.json"
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"places\.json: is torn or was edited"):
        load_cases([tmp_path / "it"])
    file.unlink()
    load_cases([tmp_path / "it"])


def contents(place: Path) -> dict[str, tuple[bytes, int]]:
    return {str(path): (path.read_bytes(), path.stat().st_mtime_ns) for path in sorted(place.rglob("*")) if path.is_file()}


def test_the_status_of_a_finished_study_agrees_with_its_journals(slippery: Path) -> None:
    assert sv.status is status
    before = contents(slippery)
    result, (case,) = status(slippery), load_cases([slippery])
    assert contents(slippery) == before
    assert result.finished
    assert result.share == 1
    assert result.simulated == len(case.evaluations)
    for run in result.runs:
        group = case.evaluations[(case.evaluations["algorithm"] == run.algorithm) & (case.evaluations["run"] == run.run)]
        assert run.collisions == (group["outcome"] == "collision").sum()
        assert run.best == group["f_safe"].min()
    assert sorted(result.points[:, 0].tolist()) == sorted(case.evaluations["f_safe"].tolist())


def test_a_study_under_way(slippery: Path, tmp_path: Path) -> None:
    shutil.copytree(slippery, tmp_path / "it")
    nsga2, rs = tmp_path / "it/runs/nsga2-00.journal", tmp_path / "it/runs/rs-00.journal"
    rs.unlink()
    (tmp_path / "it/solutions.csv").unlink()  # written after the last run
    nsga2.write_bytes(nsga2.read_bytes()[:len(nsga2.read_bytes()) * 2 // 3])  # torn, as while somebody writes
    result = status(tmp_path / "it")
    assert [run.state for run in result.runs] == ["begun", "waiting"]
    assert 0 < result.runs[0].simulated < 60
    assert 0 < result.share < 0.5
    done = CliRunner().invoke(commands, ["status", str(tmp_path / "it")])
    assert "nsga2:0 " in done.output
    assert "Front so far" in done.output
    assert "simulator" in done.output, "a collision is a failure too, but counted on its own"
    assert "failures" not in done.output
    assert "% done" in done.output
    lines = CliRunner(env={"COLUMNS": "80"}).invoke(commands, ["status", str(tmp_path / "it")]).output.splitlines()
    assert max(map(len, lines)) <= 80
    assert "collisions" in "".join(lines), "no word is cut in two"


def test_reading_a_torn_run_warns(slippery: Path, tmp_path: Path) -> None:
    shutil.copytree(slippery, tmp_path / "it")
    journal = tmp_path / "it/runs/nsga2-00.journal"
    journal.write_bytes(journal.read_bytes()[:-7])
    with pytest.warns(UserWarning, match=r"nsga2-00\.journal: the last \d+ bytes are torn, so the run counts as unfinished"):
        (case,) = load_cases([tmp_path / "it"])
    assert ("nsga2", 0) not in case.finished_runs


def test_a_lost_journal_of_a_finished_study_is_named_with_its_remedy(slippery: Path, tmp_path: Path) -> None:
    shutil.copytree(slippery, tmp_path / "it")
    lost = tmp_path / "it/runs/rs-00.journal"
    lost.unlink()
    with pytest.raises(InputError, match=r"rs-00\.journal: is missing, although solutions\.csv holds.*\nexpected: .*the same study again"):
        load_runs(tmp_path / "it")
    assert f"{lost} is missing" in status(tmp_path / "it").remarks[0]
    (tmp_path / "it/runs/nsga2-00.journal").unlink()
    with pytest.raises(InputError, match=r"nsga2-00\.journal: is missing \(and 1 more\)"):
        load_runs(tmp_path / "it")


def test_every_command_about_solutions_says_which_runs_are_unfinished(slippery: Path, tmp_path: Path) -> None:
    shutil.copytree(slippery, tmp_path / "it")
    (tmp_path / "it/runs/rs-00.journal").unlink()
    (tmp_path / "it/solutions.csv").unlink()
    for command in (["explain", str(tmp_path / "it"), "--top", "1"], ["simulate", str(tmp_path / "it"), "--most-severe"]):
        done = CliRunner().invoke(commands, command)
        assert done.exit_code == 0, done.output
        assert "unfinished, rs 0 of 1 runs" in done.stderr
    assert "unfinished" not in CliRunner().invoke(commands, ["simulate", str(tmp_path / "it")]).output


def test_watching_ends_with_the_study_and_json_is_json(slippery: Path) -> None:
    done = CliRunner().invoke(commands, ["status", str(slippery), "--watch"])
    assert done.exit_code == 0
    assert "Finished." in done.output
    assert done.output.endswith("\n")
    output = json.loads(CliRunner().invoke(commands, ["status", str(slippery), "--json"]).output)
    assert output["finished"] is True
    assert np.isfinite(output["runs"][0]["best"])


def test_an_edited_table_is_reported(slippery: Path, tmp_path: Path) -> None:
    shutil.copytree(slippery, tmp_path / "it")
    file = tmp_path / "it/solutions.csv"
    file.write_text(file.read_text().replace("nsga2,0,", "nsga2,1,", 1))
    done = CliRunner().invoke(commands, ["status", str(tmp_path / "it"), "--json"])
    assert done.exit_code == 0
    assert f"{file} was edited" in done.stderr
    json.loads(done.stdout)
