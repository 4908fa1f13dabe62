"""The study that the tests of campaigns search."""

from __future__ import annotations

import msgspec
import pytest

from safevar_sumo.search import ALGORITHMS
from safevar_sumo.study import Study, load_study


@pytest.fixture
def study() -> Study:
    smoke = load_study("smoke")
    return msgspec.structs.replace(smoke, search=msgspec.structs.replace(smoke.search, algorithms=sorted(ALGORITHMS)))
