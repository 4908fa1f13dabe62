"""Packs of evidence: every claim is made again, and whatever was changed in one is named."""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.report.pack import DESCRIPTION, Description, _check_entries, describe, read_pack, write_pack
from safevar_sumo.shipped import NETWORKS
from tests.analysis.test_repair import planted as planted
from tests.in_process import json_of, refused, run

MINE = """
from pathlib import Path
from safevar_sumo.ads import ScalarAds


class Mine(ScalarAds):
    def __init__(self, limits):
        self.gap = float(Path(limits).read_text())

    def drive(self, seen):
        return (0.0, 1.0) if seen.gap < self.gap else (0.4, 0.0)
"""
STUDY = """
extends = "smoke"
name = "mine"
[ads]
model = "mine:Mine"
parameters = { limits = "limits.txt" }
[scenario.parameters]
network = "roads"
[search]
algorithms = ["rs"]
population = 5
evaluations = 20
runs = 1
"""


@pytest.fixture(scope="module")
def bare(slippery: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pack without answers."""
    out = tmp_path_factory.mktemp("bare") / "bare.zip"
    run("evidence", str(slippery), "--out", str(out))
    return out


@pytest.fixture
def mine(in_tmp: Path) -> Path:
    """Results of a study with an own network and user code, which reads a file."""
    there = in_tmp / "there"
    shutil.copytree(NETWORKS / "pedestrian_crossing", there / "roads")
    for name, text in {"mine.py": MINE, "mine.toml": STUDY, "limits.txt": "6.0"}.items():
        (there / name).write_text(text)
    run("study", str(there / "mine.toml"), "--out", str(there / "results"), "--quiet", "--jobs", "1")
    return there / "results"


def changed(source: Path, target: Path, name: str, change: Callable[[str], str], *, sealed: bool = True) -> str:
    """Change a file of a pack, by default with new digests; returns the path of the changed pack."""
    description, files = read_pack(source)
    if name == DESCRIPTION:
        text = msgspec.json.encode(description).decode()
        assert change(text) != text
        write_pack(target, msgspec.json.decode(change(text), type=Description), files)
        return str(target)
    (path,) = [path for path in files if path.endswith(name)]
    before = files[path].decode()
    assert change(before) != before
    if sealed:
        write_pack(target, description, {**files, path: change(before).encode()})
        return str(target)
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for entry in old.infolist():
            new.writestr(entry, change(before) if entry.filename == path else old.read(entry))
    return str(target)


def digit_of(pattern: str) -> Callable[[str], str]:
    """A change of the last digit of what the pattern's group matches first."""

    def change(text: str) -> str:
        match = re.search(pattern, text)
        assert match is not None, pattern
        end = match.end(1)
        return f"{text[: end - 1]}{(int(text[end - 1]) + 1) % 10}{text[end:]}"

    return change


def not_same(*arguments: str) -> list[dict[str, str]]:
    """The claims that `verify` does not find the same; it must end with exit code 1."""
    result = json.loads(run("verify", *arguments, "--json", expect=1).stdout)
    assert result["same"] < result["claims"]
    return [claim for claim in result["table"] if claim["verdict"] != "same"]


@pytest.mark.slow
def test_a_changed_answer_differs(slippery: Path, tmp_path: Path) -> None:
    pack = tmp_path / "pack.zip"
    run("evidence", str(slippery), "--out", str(pack), "--risk")
    path = changed(pack, tmp_path / "it.zip", "risk.json", digit_of(r'"probability": 0\.(\d+)'))
    claim = next(claim for claim in not_same(path) if claim["claim"] != "dossier")
    assert claim["claim"] == "answer risk"
    assert "probability" in claim["packed"]
    assert "probability" in claim["here"]
    path = changed(pack, tmp_path / "it.zip", DESCRIPTION, digit_of(r'"samples":(\d+)'))
    assert {claim["claim"] for claim in not_same(path)} == {"answer risk"}


@pytest.mark.slow
def test_equal_contents_give_equal_bytes(bare: Path, slippery: Path, tmp_path: Path) -> None:
    run("evidence", str(slippery), "--out", str(tmp_path / "again.zip"))
    assert bare.read_bytes() == (tmp_path / "again.zip").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "pattern", "claims"),
    [
        ("study.toml", r"tyre_friction = 0\.(\d+)", {"study"}),
        ("manifest.json", r'"results": (\d)', {"inputs"}),
        ("manifest.json", r'"f_num_diff": (\d)', {"original vehicle"}),
        ("solutions.csv", r"\n(?:[^,]*,){14}-?\d+\.(\d+)", {"solution nsga2:0:0"}),
        (DESCRIPTION, r'"solutions":(\d+)', {"number of solutions and runs"}),
    ],
)
def test_a_changed_digit_differs_and_is_named(
    bare: Path, tmp_path: Path, name: str, pattern: str, claims: set[str]
) -> None:
    assert {claim["claim"] for claim in not_same(changed(bare, tmp_path / "it.zip", name, digit_of(pattern)))} == claims


@pytest.mark.slow
def test_what_no_claim_covers_is_damage(bare: Path, tmp_path: Path) -> None:
    description, files = read_pack(bare)
    for name in ("1-slippery/answers/risk.json", "2-other/manifest.json"):
        write_pack(tmp_path / "it.zip", description, {**files, name: b"{}"})
        refused("verify", str(tmp_path / "it.zip"), message=(name.removeprefix("1-slippery/"), "belongs to no"))
    write_pack(tmp_path / "it.zip", msgspec.structs.replace(description, studies=[]), {})
    refused("verify", str(tmp_path / "it.zip"), message=("holds no study",))
    for name in ("solutions.csv", "manifest.json", "checks.json"):
        write_pack(tmp_path / "it.zip", description, {**files, f"1-slippery/{name}": b"[" * 100_000})
        refused("verify", str(tmp_path / "it.zip"), message=("1-slippery is damaged",))


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A pack of two files, without a study."""
    write_pack(
        tmp_path / "small.zip", describe([], digests_only=False), {"1/a.csv": b"1.5\n", "1/b.toml": b"x = 2.5\n"}
    )
    return tmp_path / "small.zip"


@pytest.mark.parametrize("name", ["a.csv", "b.toml"])
def test_a_change_without_new_digests_is_damage(small: Path, tmp_path: Path, name: str) -> None:
    path = changed(small, tmp_path / "it.zip", name, digit_of(r"\.(\d+)"), sealed=False)
    refused("verify", path, message=(path, f"{name} was changed", "expected"))


def test_packs_of_other_versions_and_missing_files_are_refused(small: Path, tmp_path: Path) -> None:
    path = changed(small, tmp_path / "it.zip", DESCRIPTION, lambda text: text.replace('"libsumo":"', '"libsumo":"0.'))
    refused("verify", path, message=(path, "made with libsumo 0.", "a pack of this version"))
    with zipfile.ZipFile(small) as archive:
        texts = {entry.filename: archive.read(entry) for entry in archive.infolist()}
    digest = re.sub(rb'("a.csv": ")(.)', rb"\1x", texts[DESCRIPTION].replace(b"1/a", b"a"))
    for change, message in (
        ({DESCRIPTION: None}, "holds no pack.json"),
        ({"1/a.csv": None}, "1/a.csv is missing"),
        ({"extra.py": b"import os"}, "extra.py does not belong to the pack"),
        ({DESCRIPTION: digest}, "pack.json was changed"),
        ({DESCRIPTION: b"[" * 100_000}, "pack.json is damaged"),
    ):
        with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
            for name, text in {**texts, **change}.items():
                if text is not None:
                    archive.writestr(name, text)
        refused("verify", str(tmp_path / "other.zip"), message=("other.zip", message))
    refused("verify", str(tmp_path / "none.zip"), message=("none.zip", "cannot be read", "evidence"))


@pytest.mark.parametrize(
    "name", ["../out.py", "/tmp/out.py", "a/../../out.py", "1/code//tmp/out.py", "1/./out.py", "C:\\out.py"]
)
def test_paths_that_leave_the_pack_are_refused(in_tmp: Path, name: str) -> None:
    with zipfile.ZipFile("it.zip", "w") as archive:
        archive.writestr(name, "x")
    refused("verify", "it.zip", message=("it.zip", "leaves the pack"))
    assert os.listdir() == ["it.zip"]


def test_links_bombs_and_other_files_are_refused(in_tmp: Path) -> None:
    link = zipfile.ZipInfo("link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile("link.zip", "w") as archive:
        archive.writestr(link, "/etc/passwd")
    refused("verify", "link.zip", message=("'link' is a symbolic link",))
    Path("text.zip").write_text("no archive")
    refused("verify", "text.zip", message=("is no zip archive",))
    with zipfile.ZipFile("bomb.zip", "w") as archive:
        archive.writestr("zeros", "")
        archive.filelist[0].file_size = 10_000_000_000
    refused("verify", "bomb.zip", message=("unpacked it has 10.0 GB, at most 1 are allowed",))
    many = [zipfile.ZipInfo(str(number)) for number in range(10_001)]
    _check_entries(Path("many.zip"), many[1:])
    with pytest.raises(InputError, match="holds 10001 files, at most 10000 are allowed"):
        _check_entries(Path("many.zip"), many)


@pytest.mark.slow
def test_user_code_and_an_own_network_travel_along_and_run_only_when_told(mine: Path, in_tmp: Path) -> None:
    run("evidence", str(mine), "--out", "it.zip")
    shutil.rmtree(mine.parent)
    code = ("mine.py", "limits.txt", "roads/scenario.sumocfg")  # SUMO's options may name outputs
    refused("verify", "it.zip", message=("would run code", *code, "--run-code"))
    result = json_of("verify", "it.zip", "--run-code")
    assert result["same"] == result["claims"] > 4
    path = changed(Path("it.zip"), in_tmp / "other.zip", "code/limits.txt", digit_of(r"(\d)\."))
    refused("verify", path, "--run-code", message=("code/limits.txt is not the file of the study's identity",))
    assert sorted(os.listdir()) == ["it.zip", "other.zip"]


@pytest.mark.slow
@pytest.mark.usefixtures("planted")
def test_a_repair_is_packed_and_made_again(in_tmp: Path) -> None:
    study = Path("planted.toml").read_text().replace("gap = 12.0, always", "gap = 30.0, always")
    study = study.replace("at_least = 5", "at_least = 7.9").replace("step_length = 0.005", "step_length = 0.02")
    Path("planted.toml").write_text(re.sub(r"(always|colour) = \{ .*\n", "", study))  # which it keeps already
    run("study", "planted.toml", "--out", "results", "--quiet", "--jobs", "1")
    run("evidence", "results", "--out", "it.zip", "--repair")
    result = json_of("verify", "it.zip", "--run-code")
    assert result["same"] == result["claims"]
    assert "answer repair" in {claim["claim"] for claim in result["table"]}


@pytest.mark.slow
def test_a_pack_of_digests_holds_no_code(mine: Path, in_tmp: Path) -> None:
    run("evidence", str(mine), "--out", "it.zip", "--digests-only")
    with zipfile.ZipFile("it.zip") as archive:
        assert not any("mine.py" in name or "limits" in name for name in archive.namelist())
    claims = not_same("it.zip", "--run-code")
    assert {claim["verdict"] for claim in claims} == {"cannot be made here"}
    assert all("mine.py" in claim["here"] for claim in claims)


@pytest.mark.slow
def test_a_study_that_names_code_outside_the_pack_is_user_code_too(bare: Path, tmp_path: Path) -> None:
    path = changed(
        bare,
        tmp_path / "it.zip",
        "manifest.json",
        lambda text: re.sub(r'("ads": \{\s*"model": )"\w+"', r'\1"antigravity:fly"', text, count=1),
    )
    refused("verify", path, message=("ads.model = 'antigravity:fly'", "--run-code"))


@pytest.mark.slow
def test_a_sample_of_the_claims(bare: Path) -> None:
    assert "5 claims: 5 same, 0 differ, 0 cannot be made here." in run("verify", str(bare), "--sample", "5").stdout
    assert json_of("verify", str(bare), "--sample", "3")["claims"] == 3


@pytest.mark.slow
def test_the_whole_search_again(bare: Path, tmp_path: Path) -> None:
    result = json_of("verify", str(bare), "--search", "--sample", "3")
    assert result["table"][-1]["claim"] == "search"
    assert result["same"] == result["claims"] == 4
    path = changed(bare, tmp_path / "it.zip", DESCRIPTION, digit_of(r'"evaluations":(\d+)'))
    assert {claim["claim"] for claim in not_same(path, "--search")} == {"dossier", "search"}


@pytest.mark.slow
def test_bad_input_is_refused(slippery: Path, tmp_path: Path) -> None:
    (tmp_path / "rows.csv").write_text("a,b\n1,2\n")
    common = ("evidence", str(slippery), "--out", str(tmp_path / "it.zip"), "--reference")
    refused(*common, str(tmp_path / "rows.csv"), message=(str(tmp_path / "rows.csv"), "lacks the columns"))
    assert [path.name for path in tmp_path.iterdir()] == ["rows.csv"]
