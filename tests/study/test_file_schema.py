"""The shipped JSON schema of study files, as an editor uses it."""

from __future__ import annotations

import json
import tomllib

import jsonschema
import msgspec
import pytest

from safevar_sumo.shipped import STUDIES
from safevar_sumo.study import load_study, study_names, write_study
from safevar_sumo.study.file_schema import SCHEMA_FILE, schema_text
from tests.study.test_study import ADDITIONS, REPLACEMENTS

SCHEMA = json.loads((STUDIES / SCHEMA_FILE).read_text())
VALIDATOR = jsonschema.Draft7Validator(SCHEMA)
NOT_OF_FORM = (
    *("lower = ", "original = 5800.0", "original = 0", "there is no study", "nothing", "leads back", "is no FMU"),
    *("lower = 9999", "did you mean 'mass'", "up to 1e+12", "each metric once", "is not rated", "'characteristics' is"),
    "is no parameter of the study",
)
"""Mistakes that only the other keys, files or models show."""


def is_accepted(text: str) -> bool:
    """An editor has no number that is not one: it becomes null."""
    return VALIDATOR.is_valid(msgspec.json.decode(msgspec.json.encode(tomllib.loads(text))))


def test_the_shipped_schema_is_that_of_the_code_and_describes_every_key() -> None:
    assert schema_text() == (STUDIES / SCHEMA_FILE).read_text(encoding="utf-8")
    jsonschema.Draft7Validator.check_schema(SCHEMA)
    for table in (SCHEMA, *SCHEMA["$defs"].values()):
        assert all(key["description"] for key in table["properties"].values())
    assert "[s]" in SCHEMA["properties"]["step_length"]["description"]


@pytest.mark.parametrize("name", study_names())
def test_a_shipped_study_names_the_schema_which_accepts_it_and_all_that_it_extends(name: str, tmp_path) -> None:  # type: ignore[no-untyped-def]
    text = (STUDIES / f"{name}.toml").read_text()
    assert text.startswith(f"#:schema ./{SCHEMA_FILE}\n")
    assert is_accepted(text)
    write_study(tmp_path / "whole.toml", load_study(name), "")
    assert is_accepted((tmp_path / "whole.toml").read_text())


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        *(((STUDIES / "sun.toml").read_text().replace(old, new, 1), said) for old, new, said in REPLACEMENTS),
        *((text if text.startswith("extends") else f'extends = "smoke"\n{text}', said) for text, said in ADDITIONS),
    ],
    ids=lambda text: text[:30],
)
def test_the_schema_refuses_mistakes_of_form_and_no_others(text: str, expected: str) -> None:
    try:
        accepted = is_accepted(text)
    except tomllib.TOMLDecodeError:
        accepted = False
    said = expected.partition("\n")
    of_form = not any(part in expected for part in NOT_OF_FORM) or ".lower = '" in said[0]
    assert accepted is not of_form
