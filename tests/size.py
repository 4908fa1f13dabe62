"""Size of the package and of its tests; `python -m tests.size` prints it.

Elements are nodes of the syntax trees without docstrings: neither line length nor blank lines nor
documentation change their number.
"""

from __future__ import annotations

import ast

from tests.manual import ROOT

LONG_FILE = 500
"""Number of lines above which a file is long."""
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def take_docstrings(tree: ast.Module) -> list[ast.stmt]:
    """The docstrings of a module, which are taken out of its tree."""
    documented = [node for node in ast.walk(tree) if isinstance(node, DOCUMENTED)]
    return [
        node.body.pop(0) for node in documented if ast.get_docstring(node) is not None
    ]


def elements_in(source: str) -> int:
    """The number of elements of a module."""
    tree = ast.parse(source)
    take_docstrings(tree)
    return sum(1 for _ in ast.walk(tree))


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
    return {
        "package_elements": sum(map(elements_in, package.values())),
        "test_elements": sum(map(elements_in, sources_of("tests").values())),
        "long_files": sum(
            source.count("\n") > LONG_FILE for source in package.values()
        ),
    }


if __name__ == "__main__":
    print(sizes())
