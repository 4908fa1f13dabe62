"""Rules of the house that the source shows: how long a function is, and that a public name stands
for one thing in the whole package.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator

from tests.manual import ROOT

PACKAGE = ROOT / "safevar_sumo"
SOURCES = {
    path.relative_to(PACKAGE).as_posix(): path.read_text(encoding="utf-8")
    for path in sorted(PACKAGE.rglob("*.py"))
    if path.parent.name != "web"  # scripts that are exported with a simulation
}
LONGEST = 60
"""Largest number of lines of a function."""
LONGER = {"questions/repair/__init__.py:repair", "openscenario/actors.py:move"}
"""Functions that may still be longer."""
DOUBLE = {
    *("Crossing", "FloatArray", "compare", "evaluate"),  # of OpenSCENARIO
    *("Failure", "Failures", "FullBraking", "Parameter", "Search"),  # of repair and tolerance
    *("columns_of", "parameters_of"),
}
"""Names that may still have several meanings."""


def lengths_in(source: str) -> Iterator[tuple[str, int]]:
    """The functions of a module, and their lines of code: docstrings, comments and blank lines do
    not count.
    """
    lines = source.splitlines()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef):
            numbers = {*range(node.lineno, (node.end_lineno or 0) + 1)}
            if ast.get_docstring(node) is not None:
                docstring = node.body[0]
                numbers -= {*range(docstring.lineno, (docstring.end_lineno or 0) + 1)}
            code = [lines[number - 1].strip() for number in numbers]
            yield node.name, sum(bool(line) and not line.startswith("#") for line in code)


def public_names_in(source: str) -> Iterator[str]:
    """The functions, classes and types that a module defines."""
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names = [node.name]
        elif isinstance(node, ast.Assign):
            targets = [target.id for target in node.targets if isinstance(target, ast.Name)]
            names = [name for name in targets if name[:1].isupper() and not name.isupper()]
        else:
            names = []
        yield from (name for name in names if not name.startswith("_"))


def test_functions_have_at_most_60_lines_of_code() -> None:
    long = {
        f"{path}:{name}"
        for path, source in SOURCES.items()
        for name, length in lengths_in(source)
        if length > LONGEST
    }
    assert long <= LONGER


def test_a_public_name_is_defined_once() -> None:
    places = defaultdict(list)
    for path, source in SOURCES.items():
        for name in public_names_in(source):
            places[name].append(path)
    assert {name for name, paths in places.items() if len(paths) > 1} <= DOUBLE


def test_the_rules_find_what_breaks_them() -> None:
    function = "def long():\n    '''One\n    two.'''\n\n    # Pass.\n" + "    pass\n" * 60
    assert [*lengths_in(function)] == [("long", 61)]
    module = "class World: ...\nPair = tuple\nSIZE = 1\n_Own = int\ndef play(): ...\n"
    assert [*public_names_in(module)] == ["World", "Pair", "play"]
