"""The table of solutions in a pack: columns or rows that are there twice, missing or new are refused, and every byte is
compared with the table computed anew.
"""

from __future__ import annotations

import random
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.report.pack import read_pack
from safevar_sumo.results import load_runs
from safevar_sumo.study import load_study
from tests.in_process import refused, run, searched
from tests.report.test_evidence import bare as bare, changed, not_same, texts_of, verified

Rows = list[list[str]]
"""The cells of a table, its header first."""
ALTERATIONS: dict[str, tuple[str, Callable[[Rows], Rows]]] = {
    "a column twice, of which the first lies": (
        "mass",
        lambda rows: [["mass" if i == 0 else "2041.0", *row] for i, row in enumerate(rows)],
    ),
    "a column twice": ("outcome", lambda rows: [[*row, row[-1]] for row in rows]),
    "a column missing": ("outcome", lambda rows: [row[:-1] for row in rows]),
    "a column of no metric": ("safe", lambda rows: [[*row, "yes" if i else "safe"] for i, row in enumerate(rows)]),
    "another name": ("column m ", lambda rows: [[cell.replace("mass", "m") for cell in row] for row in rows]),
    "a row twice": ("rows", lambda rows: [*rows, rows[-1]]),
    "a row twice at once": ("rows", lambda rows: [rows[0], rows[1], *rows[1:]]),
    "a row missing": ("rows", lambda rows: rows[:-1]),
    "a row in place of another": ("rows", lambda rows: [*rows[:-1], rows[-2]]),
    "a new row": ("rows", lambda rows: [*rows, [*rows[-1][:2], "4500.0", *rows[-1][3:]]]),
    "a row of a run that is not finished": ("rows", lambda rows: [*rows, [rows[-1][0], "7", *rows[-1][2:]]]),
    "another run": ("rows", lambda rows: [[cell.replace("rs", "rt") for cell in row] for row in rows]),
    "no row": ("rows", lambda rows: rows[:1]),
}  # fmt: skip
SAME_VALUES: dict[str, Callable[[str], str]] = {
    "rows in another order": lambda text: "\n".join([(lines := text.split("\n"))[0], lines[2], lines[1], *lines[3:]]),
    "ends of lines": lambda text: text.replace("\n", "\r\n"),
    "a number with more digits": lambda text: text.replace("0,", "0000,", 1),
    "a cell in quotes": lambda text: text.replace("nsga2", '"nsga2"', 1),
    "columns in another order": lambda text: text.replace("tet,tit", "tit,tet", 1),
}


def with_rows(text: str, alter: Callable[[Rows], Rows]) -> str:
    rows = [line.split(",") for line in text.splitlines()]
    return "".join(",".join(row) + "\n" for row in alter(rows))


@pytest.mark.slow
@pytest.mark.parametrize("name", ALTERATIONS)
def test_columns_and_rows_that_are_twice_missing_or_new_are_refused(name: str, bare: Path, tmp_path: Path) -> None:
    word, alter = ALTERATIONS[name]
    path = changed(bare, tmp_path / "it.zip", "solutions.csv", lambda text: with_rows(text, alter))
    refused("verify", path, message=("it.zip", "1-slippery is damaged", word))


@pytest.mark.slow
@pytest.mark.parametrize("name", SAME_VALUES)
def test_the_bytes_are_compared_and_not_the_values(name: str, bare: Path, tmp_path: Path) -> None:
    claims = not_same(changed(bare, tmp_path / "it.zip", "solutions.csv", SAME_VALUES[name]))
    assert "solutions" in {claim["claim"] for claim in claims}


@pytest.mark.slow
def test_a_solution_that_a_run_returns_twice_is_no_damage(tmp_path: Path) -> None:
    study = load_study("smoke", search={"algorithms": ["nsga2"]})
    results = searched(study, tmp_path / "results")
    assert load_runs(results).solutions.duplicated().any()
    run("evidence", str(results), "--ask", "rules --samples 20", "--out", str(tmp_path / "it.zip"))
    assert "solutions" in verified(str(tmp_path / "it.zip"))


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_flipped_bit_is_damage_however_the_archive_is_compressed(method: int, bare: Path, tmp_path: Path) -> None:
    path = tmp_path / "it.zip"
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in texts_of(bare).items():
            archive.writestr(name, content)
    assert read_pack(path)[1]
    whole = path.read_bytes()
    flips = random.Random(method)
    errors = 0
    for place in flips.choices(range(len(whole)), k=60):
        torn = bytearray(whole)
        torn[place] ^= 1 << flips.randrange(8)
        path.write_bytes(torn)
        with suppress(InputError):  # any other error fails the test
            read_pack(path)
            errors -= 1
        errors += 1
    assert errors > 50, "a few bits of an archive, as of its dates, mean nothing here"
