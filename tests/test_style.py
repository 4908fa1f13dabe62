"""Rules of the house that the source shows: how large the package and its tests are, and that a
public name stands for one thing in the whole package.
"""

from __future__ import annotations

import ast
import os
import tomllib
from collections import defaultdict
from collections.abc import Iterator

from tests.support.in_process import SLOW, run_python
from tests.support.needs import NOTHING_MISSING
from tools.manual import ROOT
from tools.size import elements_in, sizes, sources_of

LIMITS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
DOUBLE = {"Found", "Search"}
"""Names that still have several meanings."""
VERSIONS = {"FORMAT"}
"""Numbers that several modules have: each format of a file has its version."""
COLLECTION = """
import sys
libraries = ["ad_rss", "cma", "distributed", "fmpy", "highway_env", "pymoo", "sumo"]
libraries += ["carla", "jmetal", "nbclient", "optuna", "panda3d", "selenium"]
sys.modules.update(dict.fromkeys(libraries))
import pytest
sys.exit(pytest.main(["--collect-only", "-m", ""]))
"""


def test_every_folder_with_code_is_installed() -> None:
    listed = (ROOT / "setup.cfg").read_text(encoding="utf-8").split()
    for file in (ROOT / "safevar_sumo").rglob("__init__.py"):
        assert ".".join(file.parent.relative_to(ROOT).parts) in listed


def public_names_in(source: str) -> Iterator[str]:
    """The functions, classes and types that a module defines."""
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names = [node.name]
        elif isinstance(node, ast.Assign):
            targets = [
                target.id for target in node.targets if isinstance(target, ast.Name)
            ]
            names = [
                name for name in targets if name[:1].isupper() and not name.isupper()
            ]
        else:
            names = []
        yield from (name for name in names if not name.startswith("_"))


def numbers_in(source: str) -> Iterator[str]:
    """The constants of a module whose values are numbers."""
    for node in ast.parse(source).body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant):
            (target,) = node.targets
            is_number = type(node.value.value) in (int, float)
            if is_number and isinstance(target, ast.Name):
                yield target.id


def test_sizes_are_within_their_limits() -> None:
    for name, size in sizes().items():
        assert size <= LIMITS["size"][name], name


def test_a_public_name_is_defined_once() -> None:
    places = defaultdict(list)
    for path, source in sources_of("safevar_sumo").items():
        if "/web/" not in path:  # scripts that are exported with a simulation
            for name in public_names_in(source):
                places[name].append(path)
    assert {name for name, paths in places.items() if len(paths) > 1} == DOUBLE


def test_a_number_has_a_name_of_its_own() -> None:
    """A number has a meaning and mostly a unit, which its name alone tells where it is imported."""
    places = defaultdict[str, list[str]](list)
    for path, source in sources_of("safevar_sumo").items():
        for name in numbers_in(source):
            places[name].append(path)
    double = {name: paths for name, paths in places.items() if len(paths) > 1}
    assert not {name: paths for name, paths in double.items() if name not in VERSIONS}


@SLOW
def test_tests_are_collected_without_the_extras() -> None:
    environment = {**os.environ}
    environment.pop(NOTHING_MISSING, None)
    run_python("-c", COLLECTION, cwd=ROOT, env=environment)


def test_the_rules_find_what_breaks_them() -> None:
    function = "def long():\n    '''One\n    two.'''\n\n    # Pass.\n    pass\n"
    assert elements_in(function) == elements_in("def long():\n    pass\n")
    assert [
        *public_names_in(
            "class World: ...\nPair = tuple\nSIZE = 1\n_Own = int\ndef play(): ...\n"
        )
    ] == ["World", "Pair", "play"]
