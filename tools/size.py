"""Size of the package and of its tests and tools; `python -m tools.size` prints it.

Elements are nodes of the syntax trees without docstrings: neither line length nor blank lines nor
documentation change their number.
"""

from __future__ import annotations

import ast

from tools.manual import ROOT

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
    """The modules of a folder, by their paths in it; none if there is no such folder."""
    root = ROOT / folder
    return {
        path.relative_to(root).as_posix(): path.read_text(encoding="utf-8")
        for path in sorted(root.rglob("*.py"))
    }


def elements_below(*folders: str) -> int:
    """The number of elements of all modules of some folders."""
    total = 0
    for folder in folders:
        for source in sources_of(folder).values():
            total += elements_in(source)
    return total


def sizes() -> dict[str, int]:
    """The sizes that `pyproject.toml` limits, by its keys."""
    return {
        "package_elements": elements_below("safevar_sumo"),
        "test_elements": elements_below("tests", "tools"),
    }


if __name__ == "__main__":
    print(sizes())
