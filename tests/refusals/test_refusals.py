"""What a user may type or write wrongly, and what the command then says in one or two lines before
it ends with code 2, without a traceback, a changed file or a new one.

Each `[[refused]]` of a table beside this file is one mistake:

- `typed` is the command, and `told` what its message says: a text, or several;
- a key with a dot or a slash is a file that the user has written; a folder, if it ends with a
  slash;
- `in` is a file that is there already, `adds` what is added to it, and `old` and `new` a change of
  it; a message about a command that names the file has its name, too;
- `model` is a class or function of `user_code/`, whose modules the user has written beside the
  study; `{model}` stands for it in files and messages, and the message has the number of the first
  line with the text `line` below its name;
- `folder` is "network" where the user has begun with a copy of a shipped network, `mine`;
- `base` is what the row has in common with others, a table of the same keys above the rows;
  `[default]` is in common to all.
"""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.in_process import SLOW, own_network, refused

USER_CODE = Path(__file__).with_name("user_code")


def rows() -> Iterator[Any]:
    for path in sorted(Path(__file__).parent.glob("*.toml")):
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
        for row in tables["refused"]:
            base = tables["base"][row["base"]] if "base" in row else {}
            whole = {**tables.get("default", {}), **base, **row}
            slow = [SLOW] if whole.get("slow") else []
            told = whole["told"]
            whole["told"] = [told] if isinstance(told, str) else told
            first = whole["told"][0].strip()[:60]
            yield pytest.param(whole, id=f"{path.stem}: {first}", marks=slow)


def with_model(text: str, row: dict[str, Any]) -> str:
    """A text of a row, in which `{model}` is the row's."""
    return text.replace("{model}", row.get("model", ""))


def place_of(row: dict[str, Any]) -> str:
    """The end of a message about the line at which user code fails."""
    module, _, name = row["model"].partition(":")
    source = (USER_CODE / f"{module}.py").read_text()
    place = source.index(row["line"], source.index(name))
    number = source.count("\n", 0, place) + 1
    return f"{module}.py:{number})"


def prepare(folder: Path, row: dict[str, Any]) -> None:
    """Write the files of a row."""
    if row.get("folder") == "network":
        own_network(folder / "mine")
    if "model" in row:
        shutil.copytree(USER_CODE, folder, dirs_exist_ok=True)
    for name in (name for name in row if "." in name or "/" in name):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if name.endswith("/"):
            path.mkdir()
        else:
            path.write_text(with_model(row[name], row))
    if "old" in row or "adds" in row:
        text = (folder / row["in"]).read_text()
        assert row.get("old", "") in text
        changed = text.replace(row.get("old", ""), row.get("new", ""), 1) + row.get(
            "adds", ""
        )
        (folder / row["in"]).write_text(changed)


def files_in(folder: Path) -> dict[Path, bytes]:
    paths = [path for path in folder.rglob("*") if "__pycache__" not in path.parts]
    return {path: path.read_bytes() if path.is_file() else b"" for path in paths}


@pytest.mark.parametrize("row", [*rows()])
def test_what_is_wrong_is_refused(
    row: dict[str, Any],
    in_tmp: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    monkeypatch.setattr("safevar_sumo.campaign.cluster.CONNECT_TIMEOUT", 0.5)
    prepare(in_tmp, row)
    before = files_in(in_tmp)
    typed = row["typed"]
    if "{results}" in typed:
        typed = typed.replace("{results}", str(request.getfixturevalue("slippery")))
    told = [with_model(text, row) for text in row["told"]]
    if "in" in row and row["in"] in typed:
        told.append(row["in"])
    if "line" in row:
        told.append(place_of(row))
    refused(typed, *told)
    assert files_in(in_tmp) == before
