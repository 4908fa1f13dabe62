"""Packs of evidence: every claim is computed again, and whatever was changed in one is named."""

from __future__ import annotations

import html
import json
import os
import random
import re
import shutil
import stat
import sys
import tomllib
import zipfile
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.questions.subject import load
from safevar_sumo.report import claims
from safevar_sumo.report.evidence import _files_of_user
from safevar_sumo.report.pack import DESCRIPTION, _check_entries, digests_of, read_pack
from tests.support.in_process import (
    SLOW,
    json_of,
    own_network,
    refused,
    rewrite,
    rows_of,
    run,
    run_python,
    write,
)
from tests.support.report_pages import draw_few_frames
from tools.manual import PROGRAM, ROOT

MINE = """
from pathlib import Path
from safevar_sumo.ads import ScalarAds


class Mine(ScalarAds):
    def __init__(self, limits):
        self.gap = float(Path(limits).read_text())
        Path(__file__).with_name("undeclared.txt").read_text()

    def drive(self, seen):
        return (0.0, 1.0) if seen.gap < self.gap else (0.4, 0.0)
"""
STUDY = """
extends = "smoke"
name = "mine"
[ads]
model = "mine:Mine"
parameters = { limits = "limits.txt" }
files = ["limits.txt"]
[scenario.parameters]
network = "roads"
[search]
algorithms = ["rs"]
population = 5
evaluations = 20
runs = 1
"""
FILES = {"limits.txt": "6.0", "undeclared.txt": ""}
OF_CARS = """
import safevar_sumo as sv
from safevar_sumo.questions.answer import Answer, contents
from safevar_sumo.questions.permit.fleet import read_fleet


@sv.question
@contents()
def named(subject, evaluator, *, cars: str | None = None, ignore: tuple[str, ...] = ()) -> Answer:
    vehicle = evaluator.characteristics.vehicle
    options = {"others": "new", "ignore": ignore, "answer_columns": ()}
    fleet = read_fleet(evaluator.study, vehicle, cars, (), **options)
    verdict = ", ".join(fleet.names)
    return Answer(
        question="of_cars:named", study=evaluator.study, verdict=verdict, numbers={}, tables={}
    )
"""
DAMAGES = tomllib.loads(Path(__file__).with_name("damages.toml").read_text())["damage"]


@pytest.fixture(scope="session")
def bare(slippery: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pack with one answer."""
    out = tmp_path_factory.mktemp("bare") / "bare.zip"
    with pytest.MonkeyPatch.context() as patch:
        draw_few_frames(patch)
        run(f"evidence {slippery} --ask 'rules --samples 20' --out {out}")
    return out


@pytest.fixture
def mine(in_tmp: Path) -> Path:
    """Results of a study with an own network and user code, which reads a file."""
    there = in_tmp / "there"
    own_network(there / "roads")
    for name, text in {**FILES, "mine.py": MINE, "mine.toml": STUDY}.items():
        (there / name).write_text(text)
    run(f"study {there / 'mine.toml'} --out {there / 'results'} --quiet --jobs 1")
    return there / "results"


def texts_of(pack: Path) -> dict[str, bytes]:
    """The files of a pack."""
    with zipfile.ZipFile(pack) as archive:
        return {entry.filename: archive.read(entry) for entry in archive.infolist()}


def changed(source: Path, target: Path, name: str, change: Callable[[str], str]) -> str:
    """Change a file of a pack, and its digest; returns the path of the changed pack."""
    texts = texts_of(source)
    (path,) = [path for path in texts if path.endswith(name)]
    before = texts[path].decode()
    assert change(before) != before
    return written(
        target, {**texts, path: change(before).encode()}, named=path != DESCRIPTION
    )


def written(target: Path, files: dict[str, bytes], *, named: bool = True) -> str:
    """Write an archive, whose pack.json names the files unless `named` is false; returns its
    path.
    """
    with suppress(KeyError, ValueError, RecursionError):
        described = json.loads(files[DESCRIPTION])
        others = {
            name: content for name, content in files.items() if name != DESCRIPTION
        }
        if named:
            files = {
                **files,
                DESCRIPTION: json.dumps(
                    {**described, "files": digests_of(others)}
                ).encode(),
            }
    with zipfile.ZipFile(target, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return str(target)


def digit_of(pattern: str) -> Callable[[str], str]:
    """A change of the last digit of what the pattern's group matches first."""

    def change(text: str) -> str:
        match = re.search(pattern, text)
        assert match is not None, pattern
        end = match.end(1)
        return f"{text[: end - 1]}{(int(text[end - 1]) + 1) % 10}{text[end:]}"

    return change


def not_same(typed: str) -> list[dict[str, str]]:
    """The claims that `verify` does not find the same; it must end with exit code 1."""
    result = json_of(f"verify {typed}", expect=1)
    numbers, claims = result["numbers"], rows_of(result, "claims")
    counts = [
        numbers[verdict] for verdict in ("same", "differs", "cannot", "unchecked")
    ]
    assert sum(counts) == numbers["claims"] == len(claims)
    assert numbers["unchecked"] == ("--search" not in typed)
    return [claim for claim in claims if claim["verdict"] not in ("same", "unchecked")]


def verified(typed: str) -> list[str]:
    """The claims that `verify` finds the same, all of them that it checks."""
    result = json_of(f"verify {typed}")
    claims = rows_of(result, "claims")
    assert result["numbers"]["passed"]
    assert {claim["verdict"] for claim in claims} <= {"same", "unchecked"}
    return [claim["claim"] for claim in claims if claim["verdict"] == "same"]


@SLOW
@pytest.mark.usefixtures("coarse")
def test_a_pack_holds_the_page_and_the_answers_and_verifies(
    slippery: Path, tmp_path: Path
) -> None:
    pack = tmp_path / "pack.zip"
    asked = "explain --quick", "risk --samples 300"
    run(f"evidence {slippery} --out {pack} --ask '{asked[0]}' --ask '{asked[1]}'")
    _, files = read_pack(pack)
    assert {name.removeprefix("1-slippery/") for name in files} == {
        "manifest.json", "solutions.csv", "study.toml", "answers.json", "report.html",
    }  # fmt: skip
    answers, page = (
        json.loads(files["1-slippery/answers.json"]),
        files["1-slippery/report.html"].decode(),
    )
    assert [answer["question"] for answer in answers] == ["explain", "risk"]
    for answer in answers:
        command = answer.pop("command")
        assert html.escape(command) in page
        typed = command.removeprefix(PROGRAM).replace("results/slippery", f"{slippery}")
        assert answer == json_of(typed), "the page's answer is the command's"
    shares = re.search(r"(\d+) different vehicles\.", page)
    case = load(slippery)
    assert case.solutions.duplicated().any(), "a run returned one twice: no damage"
    assert int(shares[1]) == len(case.evaluations), "the page is about the whole search"

    claims = [
        "files",
        "inputs",
        "study",
        "original vehicle",
        "solutions",
        *(f"answer {text}" for text in asked),
        "report",
    ]
    assert verified(str(pack)) == claims
    (claim,) = not_same(
        changed(
            pack,
            tmp_path / "it.zip",
            "answers.json",
            digit_of(r'"probability": 0\.(\d+)'),
        )
    )
    assert claim["claim"] == "answer risk --samples 300"
    assert claim["packed"].startswith('"probability": 0.')
    assert claim["here"] == f'"probability": {answers[1]["numbers"]["probability"]},'


@SLOW
def test_a_question_of_the_user_is_on_the_page_and_in_a_pack_with_its_file(
    slippery: Path, in_tmp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The example `own_question`."""
    write(
        "my_questions.py",
        (ROOT / "examples/own_question/my_questions.py").read_text("utf-8"),
    )
    monkeypatch.syspath_prepend(str(in_tmp))
    run(f"report {slippery} --ask 'my_questions:ends --unsafe below=0.5' --out it.html")
    page = Path("it.html").read_text()
    assert "Unsafe at an end of the domain: " in page
    assert "<caption>Ends of the domains</caption>" in page
    assert (
        f"python -m safevar_sumo my_questions:ends {slippery} --unsafe below=0.5"
        in page
    )
    run(f"evidence {slippery} --ask my_questions:ends --out it.zip")
    Path("my_questions.py").unlink()
    refused(
        "verify it.zip",
        "would run code",
        "my_questions.py, my_questions:ends",
        "--run-code",
    )
    # In a process that never had the module.
    done = run_python("-m", "safevar_sumo", "verify", "it.zip", "--run-code")
    assert done.stdout.startswith(
        "7 of the 8 claims of the pack are confirmed. These parts"
    )


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_a_pack_holds_a_list_of_cars_without_their_names(
    slippery: Path, in_tmp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write("of_cars.py", OF_CARS)
    write("fleet.csv", "plate;mass;driver\nM-XY 1;2100,5;Ada L.\nM-XY 2;2200;Bob\n")
    monkeypatch.syspath_prepend(str(in_tmp))
    ask = "of_cars:named --cars fleet.csv --ignore driver"
    run(f"evidence {slippery} --ask '{ask}' --out it.zip")
    texts = texts_of(Path("it.zip"))
    (answer,) = json.loads(texts["1-slippery/answers.json"])
    assert answer["verdict"] == "car 1, car 2"
    assert "--cars lists/1.csv --ignore driver" in answer["command"]
    packed = texts["1-slippery/lists/1.csv"].decode().replace('"', "").splitlines()
    assert packed == ["plate;mass;driver", "car 1;2100,5;", "car 2;2200;"]
    assert not [
        name for name, text in texts.items() if b"M-XY" in text or b"Ada L." in text
    ]
    assert len(verified("it.zip --run-code")) == 7
    named_elsewhere = changed(
        Path("it.zip"),
        Path("bad.zip"),
        DESCRIPTION,
        lambda text: text.replace("lists/1", "fleet"),
    )
    refused(f"verify {named_elsewhere} --run-code", "1-slippery/fleet.csv is missing")


def damaged(content: bytes, damage: dict[str, Any]) -> bytes:
    """The contents of a file after a damage of the table."""
    text = content.decode()
    if "digit" in damage:
        text = digit_of(damage["digit"])(text)
    elif "old" in damage:
        olds, news = (
            [one] if isinstance(one, str) else one
            for one in (damage["old"], damage["new"])
        )
        for old, new in zip(olds, news, strict=True):
            text = re.sub(
                old,
                new * damage.get("times", 1),
                text,
                count=0 if "every" in damage else 1,
            )
    return text.encode("latin-1" if "\xff" in text else "utf-8")


@SLOW
@pytest.mark.usefixtures("few_frames")
@pytest.mark.parametrize(
    "damage",
    DAMAGES,
    ids=[f"{row['in']}, {row.get('told', 'different')}" for row in DAMAGES],
)
def test_a_damage_is_refused_or_named(
    damage: dict[str, Any], bare: Path, tmp_path: Path
) -> None:
    texts = texts_of(bare)
    default = (
        damage["in"] if "/manifest" in damage["in"] else f"1-slippery/{damage['in']}"
    )
    path = next((path for path in texts if path.endswith(damage["in"])), default)
    before = texts.pop(path, None)
    if "removed" not in damage:
        texts[path] = damaged(before or b"", damage)
        assert texts[path] != before
    pack = written(
        tmp_path / "it.zip", texts, named=damage.get("named", path != DESCRIPTION)
    )
    if "told" in damage:
        refused(f"verify {pack}", "it.zip", damage["told"])
    else:
        assert {*damage["different"]} == {claim["claim"] for claim in not_same(pack)}


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_what_differs_is_shown_from_both_sides(bare: Path, tmp_path: Path) -> None:
    """A file whose digest is not the one that the pack states was altered."""
    texts = texts_of(bare)
    page = texts["1-slippery/report.html"] + b"\n"
    other = written(tmp_path / "it.zip", {**texts, "1-slippery/report.html": page})
    (claim,) = not_same(other)
    assert (claim["claim"], claim["packed"], claim["here"]) == (
        "report",
        "'\\n'",
        "nothing",
    )
    assert "altered" not in run(f"verify {other}", expect=1).stdout
    answers = {"1-slippery/answers.json": texts["1-slippery/answers.json"] + b" "}
    altered = written(tmp_path / "it.zip", {**texts, **answers}, named=False)
    (claim,) = not_same(altered)
    assert claim["claim"] == "files"
    assert '"1-slippery/answers.json": "' in claim["packed"]
    printed = run(f"verify {altered}", expect=1).stdout
    assert printed.startswith("This pack was altered:")


@pytest.mark.parametrize(
    "change",
    [
        lambda whole: b"<html>" + whole,
        lambda whole: whole + b"<html>",
        lambda whole: whole[:-2] + b"\6\0<html>",  # a comment
        lambda whole: whole.replace(b"PK\1\2", b"<html>PK\1\2", 1),  # behind the files
    ],
)
def test_an_archive_is_its_files_and_nothing_else(
    change: Callable[[bytes], bytes], bare: Path, tmp_path: Path
) -> None:
    (tmp_path / "it.zip").write_bytes(change(bare.read_bytes()))
    refused(f"verify {tmp_path / 'it.zip'}", "it.zip", "bytes that belong to no file")


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_versions_and_machines_that_differ_are_named_and_so_is_what_needs_a_search(
    bare: Path, tmp_path: Path
) -> None:
    path = str(bare)
    altered = {
        "numpy": "manifest.json",
        "machine": "manifest.json",
        "deap": DESCRIPTION,
    }
    for key, name in altered.items():
        path = changed(
            Path(path),
            tmp_path / key,
            name,
            partial(re.sub, f'("{key}": )"', r'\1"9', count=1),
        )
    said = (
        "deap of pack.json: 91.*platform.machine of .*: 9x86.*numpy of .*: 92.*--search"
    )
    found = run(
        f"verify {path} --json", expect=1
    ).stdout  # the page names the version of numpy
    assert re.search(said, found)
    scoring = '"scoring": {"metrics": [], "objectives": []}, "results"'
    path = changed(
        bare,
        tmp_path / "it.zip",
        "manifest.json",
        lambda text: text.replace('"results"', scoring),
    )
    assert [claim["verdict"] for claim in not_same(path)] == ["cannot be run"] * 2
    assert "not compared" not in run(f"verify {bare} --search").stdout


@pytest.mark.parametrize(
    "name",
    [
        "/tmp/out.py",
        "a/../../out.py",
        "1/code//tmp/out.py",
        "1/./out.py",
        "C:\\out.py",
    ],
)
def test_paths_that_leave_the_pack_are_refused(in_tmp: Path, name: str) -> None:
    with zipfile.ZipFile("it.zip", "w") as archive:
        archive.writestr(name, "x")
    refused("verify it.zip", "it.zip", "leaves the pack")
    assert os.listdir() == ["it.zip"]


def test_links_bombs_and_other_files_are_refused(in_tmp: Path) -> None:
    link = zipfile.ZipInfo("link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile("link.zip", "w") as archive:
        archive.writestr(link, "/etc/passwd")
    refused("verify link.zip", "'link' is a symbolic link")
    write("text.zip", "no archive")
    refused("verify text.zip", "is no zip archive")
    with zipfile.ZipFile("bomb.zip", "w") as archive:
        archive.writestr("zeros", "")
        archive.filelist[0].file_size = 10_000_000_000
    refused("verify bomb.zip", "unpacked it has 10.0 GB, at most 1 are allowed")
    many = [zipfile.ZipInfo(str(number)) for number in range(10_001)]
    _check_entries(Path("many.zip"), many[1:])
    with pytest.raises(
        InputError, match="holds 10001 files, at most 10000 are allowed"
    ):
        _check_entries(Path("many.zip"), many)


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_user_code_and_an_own_network_travel_along_and_run_only_when_told(
    mine: Path, in_tmp: Path
) -> None:
    run(f"evidence {mine} --ask 'rules --samples 20' --out it.zip")
    shutil.rmtree(mine.parent)
    code = (
        "mine.py",
        "undeclared.txt",
        "limits.txt",
        "roads/scenario.sumocfg",
    )  # SUMO's options may name outputs
    refused("verify it.zip", "would run code", *code, "--run-code")
    assert len(verified("it.zip --run-code")) == 7
    path = changed(
        Path("it.zip"), in_tmp / "other.zip", "code/limits.txt", digit_of(r"(\d)\.")
    )
    claims = {claim["claim"]: claim["here"] for claim in not_same(f"{path} --run-code")}
    assert "limits.txt has changed since" in claims["inputs"]
    assert sorted(os.listdir()) == ["it.zip", "other.zip"]
    texts = texts_of(Path("it.zip"))
    without = {name: texts[name] for name in texts if not name.endswith("mine.py")}
    told = "mine.py, on which the results depend"
    refused(f"verify {written(Path('it.zip'), without)} --run-code", told)


@pytest.mark.parametrize(
    "named",
    [
        {"ads": {"model": "../files/it.fmu", "kind": "fmu"}},
        {"vehicle": {"files": ["../files/it.fmu"]}},
    ],
    ids=["fmu", "data"],
)
def test_a_file_outside_the_folder_of_the_study_is_refused(
    named: dict[str, Any], in_tmp: Path
) -> None:
    Path("files").mkdir()
    Path("files/it.fmu").write_bytes(b"")
    Path("own").mkdir()
    write("own/it.toml", 'extends = "smoke"')
    study = load_study("own/it.toml", **named)
    with pytest.raises(InputError, match=r"files/.*: lies outside the study's folders"):
        _files_of_user(study, {}, [])


@SLOW
@pytest.mark.parametrize(
    ("code", "file", "error"),
    [
        (
            MINE.replace("Path(limits)", 'Path("secret.txt")'),
            "secret.txt",
            "No such file",
        ),
        (
            MINE.replace("Path(limits).read_text()", '__import__("helper").GAP'),
            "helper.py",
            "No module named 'helper'",
        ),
    ],
    ids=["data", "code"],
)
def test_what_the_pack_lacks_is_not_taken_from_the_folder_of_the_author(
    code: str, file: str, error: str, mine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The code of the user needs what no pack holds, and fails elsewhere."""
    there = mine.parent
    monkeypatch.chdir(there)
    monkeypatch.syspath_prepend(str(there))
    Path(file).write_text("6.0" if file == "secret.txt" else "GAP = 6.0")
    Path("mine.py").write_text(code)
    run("study mine.toml --out own --quiet --jobs 1")
    run("evidence own --ask 'rules --samples 20' --out it.zip")
    texts = {
        name: content
        for name, content in texts_of(Path("it.zip")).items()
        if not name.endswith(file)
    }
    manifest = json.loads(texts["1-mine/manifest.json"])
    manifest["files"].pop(file, None)
    written(
        Path("it.zip"),
        {
            **texts,
            "1-mine/manifest.json": json.dumps(manifest, indent=2).encode() + b"\n",
        },
    )
    claims = {claim["claim"]: claim["here"] for claim in not_same("it.zip --run-code")}
    assert error in claims["solutions"]
    # The command has processes of its own as workers.
    command = "-m", "safevar_sumo", "verify", "it.zip", "--run-code"
    assert run_python(*command, expect=1).stdout.startswith("2 of the 8 ")
    assert os.getcwd() == str(there)
    assert "mine" not in sys.modules


@SLOW
@pytest.mark.usefixtures("planted", "few_frames")
def test_a_repair_is_packed_and_made_again(in_tmp: Path) -> None:
    file = Path("planted.toml")
    rewrite(
        file,
        ("gap = 12.0, always", "gap = 30.0, always"),
        ("at_least = 5", "at_least = 7.9"),  # which it keeps already
        ("step_length = 0.01", "step_length = 0.02"),
    )
    file.write_text(re.sub(r"(always|colour) = \{ .*\n", "", file.read_text()))
    run("study planted.toml --out results --quiet --jobs 1")
    run("evidence results --out it.zip --ask 'repair --quick'")
    assert "answer repair --quick" in verified("it.zip --run-code")


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_the_whole_search_again(bare: Path, tmp_path: Path) -> None:
    assert verified(f"{bare} --search")[-2:] == [
        "search: outcomes",
        "search: solutions",
    ]
    path = changed(
        bare, tmp_path / "it.zip", DESCRIPTION, digit_of(r'"collision": (\d)')
    )
    assert {claim["claim"] for claim in not_same(f"{path} --search")} == {
        "report",
        "search: outcomes",
    }


@SLOW
@pytest.mark.parametrize(
    "method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
)
def test_a_flipped_bit_is_damage_however_the_archive_is_compressed(
    method: int, bare: Path, tmp_path: Path
) -> None:
    path = tmp_path / "it.zip"
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in texts_of(bare).items():
            archive.writestr(name, content)
    whole = path.read_bytes()
    assert read_pack(path)[1]
    for place in random.Random(method).choices(range(len(whole)), k=20):
        path.write_bytes(
            whole[:place] + bytes([whole[place] ^ 16]) + whole[place + 1 :]
        )
        with suppress(InputError):  # any other error fails the test
            read_pack(path)


def test_what_cannot_be_run_has_its_reason() -> None:
    def fail() -> bytes:
        raise InputError("model", "is not installed", "an extra")

    row = claims.compare_claim("mine", claims.Claim("answer", b"", fail))
    assert row[2:] == (
        "cannot be run",
        "",
        "model: is not installed expected: an extra",
    )
