"""The shipped studies' numbers, to the bit where that is promised."""

from __future__ import annotations

import json
import platform

import pytest

from safevar_sumo.results import RESULTS
from tests.golden.renew import FILE, WHY, computed, platform_here

CHANGED = (
    "results changed: if that is meant, raise RESULTS in safevar_sumo/results/manifest.py, renew golden.json and "
    "say why"
)
GOLDEN = json.loads(FILE.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", WHY)
def test_a_shipped_studys_results_are_those_of_ever(name: str) -> None:
    here, expected = computed(name), GOLDEN["studies"][name]
    numbers = {key: value for key, value in expected["original"].items() if isinstance(value, float)}
    assert {key: here["original"][key] for key in numbers} == pytest.approx(numbers, rel=1e-4), (
        "other results, not only other bits"
    )
    if platform_here() == GOLDEN["platform"]:
        assert here == expected, CHANGED


def test_results_and_the_number_that_stands_for_them_change_together() -> None:
    assert GOLDEN["results"] == RESULTS, (
        "RESULTS is not the one of golden.json: renew it with python -m tests.golden.renew"
    )


@pytest.mark.skipif(
    (platform.system(), platform.machine()) != ("Linux", "x86_64"), reason="bytes are promised for Linux on x86-64"
)
def test_this_is_the_platform_that_bytes_are_promised_for() -> None:
    assert platform_here() == GOLDEN["platform"], (
        "the C library rounds powers differently: NSGA-II finds other last bits here"
    )
