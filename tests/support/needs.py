"""What a test needs beyond the extra `test`: libraries of the extra `test-all`, and programs.

A test is skipped, and says why, where something is missing. In CI nothing may be missing.
"""

from __future__ import annotations

import os
import shutil
import sys
from importlib import import_module
from typing import Any, NoReturn

import pytest

NOTHING_MISSING = "SAFEVAR_NOTHING_MISSING"
"""The variable that makes a failure of whatever is missing; `.ci/run` sets it."""
LAST_PYTHON = {"carla": (3, 12), "panda3d": (3, 11), "qc_opendrive": (3, 12)}
"""The last version of Python for which a library is built. (MetaDrive needs panda3d.)"""


def is_built_for_this_python(library: str) -> bool:
    """Return whether there are wheels of a library for this version of Python."""
    return sys.version_info[:2] <= LAST_PYTHON.get(library, sys.version_info[:2])


def skip_unless_forbidden(reason: str) -> NoReturn:
    """Skip the test or module that calls this, unless nothing may be missing."""
    if os.environ.get(NOTHING_MISSING):
        pytest.fail(
            f"{reason}, and {NOTHING_MISSING} forbids to skip this", pytrace=False
        )
    pytest.skip(reason, allow_module_level=True)


def need_library(module: str) -> Any:
    """Import and return a module of the extra `test-all`; skip the test if it is missing."""
    library = module.partition(".")[0]
    try:
        return import_module(module)
    except ImportError:
        if not is_built_for_this_python(library):
            pytest.skip(
                f"{library} is not built for this Python", allow_module_level=True
            )
        skip_unless_forbidden(
            f"{library} is missing: pip install --editable '.[test-all]'"
        )


def need_program(*names: str) -> str:
    """The path of the first of these programs that is installed; skip the test if none is."""
    for name in names:
        if path := shutil.which(name):
            return path
    skip_unless_forbidden(f"{names[0]} is not installed")
