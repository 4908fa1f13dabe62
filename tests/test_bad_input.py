"""What a user may type wrongly, and what the command says in one or two lines before it ends with
code 2; whatever is in a study file is a study or an error of one kind, never a traceback.
"""

from __future__ import annotations

import math
import os
import tempfile
from pathlib import Path

import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings, strategies as st

from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.output import MAX_INPUT
from safevar_sumo.records import JsonObject
from safevar_sumo.results import MANIFEST
from safevar_sumo.study import Study, tables_of
from safevar_sumo.sumo.system import assemble
from tests.support.in_process import SLOW, refused, write

PIPES = [
    "simulate pipe",
    "simulate extends.toml",
    "permit wear --cars pipe",
    "verify pipe",
    "report results",
]
TABLES = tables_of(load_study("smoke"))
SCALARS = st.one_of(
    st.integers(),
    st.floats(),
    st.text(max_size=20),
    st.booleans(),
    st.dates(),
    st.datetimes(),
    st.times(),
)
ANYTHING = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(st.text(max_size=8), inner, max_size=3),
    ),
    max_leaves=6,
)


def paths(tables: JsonObject, before: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Every key of nested tables."""
    inner = [
        path
        for key, value in tables.items()
        if isinstance(value, dict)
        for path in paths(value, (*before, key))
    ]
    return [*((*before, key) for key in tables), *inner]


def replaced(tables: JsonObject, path: tuple[str, ...], value: object) -> JsonObject:
    key, *rest = path
    return {
        **tables,
        key: value if not rest else replaced(tables[key], tuple(rest), value),
    }


@SLOW
@settings(max_examples=60, suppress_health_check=list(HealthCheck))
@given(path=st.sampled_from(paths(TABLES)), value=ANYTHING)
def test_a_study_with_anything_in_one_place_is_read_or_refused(
    path: tuple[str, ...], value: object
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "mine.toml"
        try:
            file.write_text(
                tomli_w.dumps(replaced(TABLES, path, value)), encoding="utf-8"
            )
        except (ValueError, UnicodeError):
            return
        try:
            study = load_study(str(file))
            assemble(study)
        except InputError:
            return
        assert isinstance(study, Study)
        numbers = list(study.vehicle.characteristics.values())
        assert all(
            math.isfinite(row.original) and row.lower < row.upper for row in numbers
        )


@pytest.mark.parametrize("command", PIPES)
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_a_pipe_or_device_is_no_input(command: str, kind: str, in_tmp: Path) -> None:
    """Either may never end; /dev/zero does not."""
    Path("results").mkdir()
    for path in Path("pipe"), Path("results", MANIFEST):
        os.mkfifo(path) if kind == "pipe" else path.symlink_to("/dev/zero")
    write("extends.toml", 'extends = "pipe"')
    refused(command, "no regular file of at most")


def test_a_file_that_is_too_large_is_no_input(in_tmp: Path) -> None:
    with open("huge.toml", "wb") as file:
        file.truncate(MAX_INPUT + 1)
    with pytest.raises(
        InputError, match=r"huge\.toml: .*no regular file of at most 100 MB"
    ):
        load_study("huge.toml")
