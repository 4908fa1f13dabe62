"""The files of code that a study brings with it: those of its models from outside, and what they import from beside them."""

from __future__ import annotations

import ast
import importlib.util
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

DIGITS = 16
"""Of a digest that tells files apart."""
PACKAGE = Path(__file__).resolve().parents[1]
NOT_COUNTED = (
    "__init__.py", "__main__.py", "analysis", "answers", "api", "cli", "computing", "errors.py", "options.py", "progress.py",
    "reference", "report", "results", "shipped.py", "showing", "terminal")
"""What of the package only carries, shows, asks or compares: no evaluation is made there."""
INSTALLED = tuple(Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib", "purelib", "platlib"))


def digest_of(path: Path) -> str:
    """Tells files of different content apart; how a platform ends its lines is no difference."""
    return sha256(path.read_bytes().replace(b"\r\n", b"\n")).hexdigest()[:DIGITS]


@cache
def package_code() -> dict[str, str]:
    """Digests of the package's files that can change a result, by their names in the package."""
    files = [path for top in sorted(PACKAGE.iterdir()) if top.name not in NOT_COUNTED
             for path in ([top] if top.is_file() else sorted(top.rglob("*.py"))) if path.suffix == ".py"]
    return {path.relative_to(PACKAGE).as_posix(): digest_of(path) for path in files}


def foreign_code(modules: Iterable[str], parameters: Iterable[Any]) -> dict[str, str]:
    """Digests of the files behind a study's plug-ins, by their names beside the plug-in's.

    Parameters
    ----------
    modules
        Of the plug-ins.
    parameters
        Of the models; a text among them that is the path of a file counts with its content.
    """
    found: dict[str, Path] = {}
    for module in modules:
        _follow(module, module.partition(".")[0], found)
    files = {name: digest_of(path) for name, path in found.items()}
    return dict(sorted({**files, **{text: digest_of(Path(text)) for one in parameters for text in _files_in(one)}}.items()))


def _follow(module: str, own: str, found: dict[str, Path]) -> None:
    """Take in a module's files and, as far as they are no installed library's, those of what it imports."""
    for name, path in _files_of(module, own):
        if name not in found:
            found[name] = path
            if path.suffix == ".py":
                for imported in _imports(path, module if path.stem == "__init__" else module.rpartition(".")[0]):
                    _follow(imported, own, found)


def _files_of(module: str, own: str) -> Iterator[tuple[str, Path]]:
    """The files that an import of a module loads: its packages' and its own."""
    parts = module.split(".")
    top = _place_of(parts[0])
    if top is None or (parts[0] != own and any(top.is_relative_to(installed) for installed in INSTALLED)):
        return
    for depth in range(1, len(parts) + 1):
        inner = top.joinpath(*parts[1:depth]) if top.is_dir() else top
        for path in (inner / "__init__.py", inner.with_suffix(".py"), *sorted(inner.parent.glob(f"{inner.name}.*.so")),
                     *sorted(inner.parent.glob(f"{inner.name}.*.pyd")), inner):
            if path.is_file():
                yield path.relative_to(top.parent).as_posix(), path
                break


def _place_of(top: str) -> Path | None:
    """The file or folder of a module at the top; None for those of the interpreter and of this package."""
    if not top or top in sys.stdlib_module_names or top == PACKAGE.name:
        return None
    try:
        spec = importlib.util.find_spec(top)
    except (ImportError, ValueError, AttributeError):
        return None
    if spec is None:
        return None
    if spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations))).resolve()
    return Path(spec.origin).resolve() if spec.origin and Path(spec.origin).is_file() else None


def _imports(path: Path, package: str) -> Iterator[str]:
    """Names of modules that a file may import; some of them may be no modules."""
    try:
        tree = ast.parse(path.read_bytes())
    except (SyntaxError, ValueError):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[:len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            yield from (one for one in (base, *(f"{base}.{alias.name}" for alias in node.names)) if one)
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in ("import_module", "__import__"):
            yield from (one.value for one in node.args[:1] if isinstance(one, ast.Constant) and isinstance(one.value, str))


def _files_in(value: Any) -> Iterator[str]:
    """Texts anywhere in a value that are paths of files."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for one in value:
            yield from _files_in(one)
    elif isinstance(value, str):
        try:
            if Path(value).is_file():
                yield value
        except (OSError, ValueError):
            return
