"""Limits of characteristics: what a user may write in a study or on the command line, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.results.manifest import evaluation_keys
from safevar_sumo.study import Limit, limits_of, load_study, tables_of

ROWS = load_study("native").vehicle.characteristics


def test_a_text_replaces_a_limit_of_the_study_and_names_follow_the_study() -> None:
    stated = {"decel": Limit(at_least=5, source="workshop"), "mass": Limit(at_most=1900)}
    texts = ["decel >= 6.5", "tau<=.3", " mass >= 1.4e3", "mass <= 1800"]
    limits = limits_of(texts, ROWS, stated)
    assert list(limits) == ["mass", "decel", "tau"]
    assert limits["decel"] == Limit(at_least=6.5)
    assert limits["decel"].interval(ROWS["decel"]) == (6.5, 9.5)
    assert limits["tau"].interval(ROWS["tau"]) == (0.1, 0.3)
    assert limits["mass"].interval(ROWS["mass"]) == (1400, 1800)
    assert limits_of([], ROWS, stated) == {"mass": stated["mass"], "decel": stated["decel"]}


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ("decel", "'decel'\nexpected: \"NAME >= X\""),
        ("decel > 6", "'decel > 6'"),
        ("decel >= 6 m/s^2", "'decel >= 6 m/s^2'"),
        ("6 <= decel", "'6 <= decel'"),
        ("5 <= decel <= 6", "'5 <= decel <= 6'"),
        ("decel >= nan", "'decel >= nan'"),
        ("decel >= 1_0", "'decel >= 1_0'"),
        (">= 6", "'>= 6'"),
        ("", "''"),
        ("decl >= 6", "decl: there is no such characteristic; did you mean 'decel'?"),
        ("decel >= 6, decel >= 7", "decel >= is given twice\nexpected: each limit once"),
        ("decel >= 9, decel <= 8", "decel: at least 9 and at most 8 m/s^2\nexpected: at_least <= at_most"),
        ("decel >= 4", "decel >= 4 is outside its domain\nexpected: a number in [4.5, 9] m/s^2"),
        ("tau <= 1e999", "tau <= inf is outside its domain"),
        ("decel >= 9.2", "decel >= 9.2: the original, 9 m/s^2, does not keep it\nexpected: a number in [4.5, 9] m/s^2"),
        ("tau <= 0.15", "tau <= 0.15: the original, 0.2 s, does not keep it\nexpected: a number in [0.2, 0.6] s"),
    ],
)
def test_a_text_that_is_no_limit_is_refused(texts: str, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(f"--promise: {message}")) as caught:
        limits_of(texts.split(", "), ROWS, source="--promise")
    assert len(str(caught.value).splitlines()) <= 2


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("decl = { at_least = 6 }", "limits.decl: there is no such characteristic; did you mean 'decel'?"),
        ("decel = { source = 'x' }", "limits.decel: neither at_least nor at_most"),
        ("decel = 6", "limits.decel = 6 is not of type 'object'"),
        ("decel = { atleast = 6 }", "limits.decel.atleast: there is no such key; did you mean 'at_least'?"),
        ("decel = { at_least = 3 }", "limits.decel.at_least = 3 is outside its domain"),
        ("decel = { at_least = 9.4 }", "limits.decel.at_least = 9.4: the original, 9 m/s^2, does not keep it"),
        ("decel = { at_least = 9, at_most = 8 }", "limits.decel: at least 9 and at most 8 m/s^2"),
        ("decel = { at_least = nan }", "limits.decel.at_least = nan"),
    ],
)
def test_a_bad_table_of_limits_is_refused(tmp_path: Path, table: str, message: str) -> None:
    (tmp_path / "mine.toml").write_text(f'extends = "native"\n[limits]\n{table}\n')
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        load_study(str(tmp_path / "mine.toml"))
    assert "mine.toml" in str(caught.value)


def test_limits_change_no_result_and_a_study_without_them_keeps_its_tables() -> None:
    study = load_study("native", limits={"decel": {"at_least": 6, "source": "workshop manual"}})
    assert evaluation_keys(study) == evaluation_keys(load_study("native"))
    assert "limits" not in tables_of(load_study("native"))
    assert load_study(tables_of(study)).limits == study.limits
