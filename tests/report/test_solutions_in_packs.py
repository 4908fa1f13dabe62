"""The table of solutions in a pack: columns or rows that are there twice, missing or new are
refused, and every byte is compared with the table computed anew.
"""

from __future__ import annotations

import random
import re
import zipfile
from contextlib import suppress
from pathlib import Path

import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.report.pack import read_pack
from safevar_sumo.results import load_runs
from tests.in_process import refused, run, searched
from tests.report.test_evidence import bare as bare, changed, not_same, texts_of, verified


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        (r"^", "2041.0,", "mass"),
        (r",outcome$|,(stopped|collision)$", "", "outcome"),
        (r"$", ",1.0", "1.0"),
        (r",mass,", ",weight,", "column mass"),
        (r"(?s)(\n[^\n]+)$", r"\1\1", "rows"),
        (r"(?s)\n[^\n]+$", "", "rows"),
        (r"(?s)(\n[^\n]+)\n[^\n]+$", r"\1\1", "rows"),
        (r"(?s)\n(\w+,)0(,[^\n]+)$", r"\n\g<1>0\2\n\g<1>7\2", "rows"),
        (r"rs,", "rt,", "rows"),
    ],
    ids=[
        "first",
        "missing",
        "new",
        "renamed",
        "row twice",
        "row missing",
        "row replaced",
        "run",
        "algorithm",
    ],
)
def test_columns_and_rows_that_are_twice_missing_or_new_are_refused(
    old: str, new: str, word: str, bare: Path, tmp_path: Path
) -> None:
    frame = texts_of(bare)["1-slippery/solutions.csv"].decode().rstrip("\n")
    text = re.sub(old, new, frame, flags=0 if "(?s)" in old else re.MULTILINE)
    text = text.replace("2041.0,", "mass,", 1)
    path = changed(bare, tmp_path / "it.zip", "solutions.csv", lambda _: text + "\n")
    refused("verify", path, message=("it.zip", "1-slippery is damaged", word))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new"), [("\n", "\r\n"), ("0,", "0000,"), ("nsga2", '"nsga2"'), ("tet,tit", "tit,tet")]
)
def test_the_bytes_are_compared_and_not_the_values(
    old: str, new: str, bare: Path, tmp_path: Path
) -> None:
    claims = not_same(
        changed(bare, tmp_path / "it.zip", "solutions.csv", lambda text: text.replace(old, new, 1))
    )
    assert "solutions" in {claim["claim"] for claim in claims}


@pytest.mark.slow
def test_a_solution_that_a_run_returns_twice_is_no_damage(tmp_path: Path) -> None:
    results = searched(load_study("smoke", search={"algorithms": ["nsga2"]}), tmp_path / "results")
    assert load_runs(results).solutions.duplicated().any()
    run("evidence", str(results), "--ask", "rules --samples 20", "--out", str(tmp_path / "it.zip"))
    assert "solutions" in verified(str(tmp_path / "it.zip"))


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_flipped_bit_is_damage_however_the_archive_is_compressed(
    method: int, bare: Path, tmp_path: Path
) -> None:
    path = tmp_path / "it.zip"
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in texts_of(bare).items():
            archive.writestr(name, content)
    whole = path.read_bytes()
    assert read_pack(path)[1]
    for place in random.Random(method).choices(range(len(whole)), k=60):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 16]) + whole[place + 1 :])
        with suppress(InputError):  # any other error fails the test
            read_pack(path)
