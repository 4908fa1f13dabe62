"""Size of the package and of its tests; `python -m tests.size` prints it by folder.

Elements are nodes of the syntax trees without docstrings: neither line length nor blank lines nor
documentation change their number.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from tests.manual import ROOT

LONG_FILE, LONG_FUNCTION = 400, 60
"""Numbers of lines above which a file and a function, by its lines of code, are long."""
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def elements_in(source: str) -> int:
    """The number of elements of a module."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node) is not None:
            del node.body[0]
    return sum(1 for _ in ast.walk(tree))


def function_lengths_in(source: str) -> Iterator[tuple[str, int]]:
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


def sources_of(folder: str) -> dict[str, str]:
    """The modules of a folder, by their paths in it."""
    root = ROOT / folder
    return {
        path.relative_to(root).as_posix(): path.read_text(encoding="utf-8")
        for path in sorted(root.rglob("*.py"))
    }


def sizes() -> dict[str, int]:
    """The sizes that `pyproject.toml` limits, by its keys."""
    package = sources_of("safevar_sumo")
    lengths = [length for source in package.values() for _, length in function_lengths_in(source)]
    return {
        "package_elements": sum(map(elements_in, package.values())),
        "test_elements": sum(map(elements_in, sources_of("tests").values())),
        "long_files": sum(source.count("\n") > LONG_FILE for source in package.values()),
        "long_functions": sum(length > LONG_FUNCTION for length in lengths),
    }


if __name__ == "__main__":
    for name in ("safevar_sumo", "tests"):
        by_folder = Counter[str]()
        for path, source in sources_of(name).items():
            by_folder[str(Path(path).parent)] += elements_in(source)
        for folder, number in by_folder.most_common():
            print(f"{number:9,}  {name}/{folder}")
    for name, size in sizes().items():
        print(f"{size:9,}  {name}")
