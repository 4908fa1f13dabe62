"""Digests of files, and names for them that hold on every machine: relative to the study's folder or to where modules are looked for."""

from __future__ import annotations

import ast
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

DIGITS = 16
"""Of a digest that tells files apart."""
Files = dict[str, str]
"""Digests of files by their names."""


def digest_of(path: Path | str) -> str:
    """Tells files of different content apart.

    Of a Python file the syntax tree without docstrings counts: a comment changes no result. Of others the content; how a platform
    ends its lines is no difference. A file that is not there has the digest "".
    """
    try:
        at = os.stat(path)
        return _digest(str(path), at.st_mtime_ns, at.st_size, at.st_ino)
    except OSError:
        return ""


@lru_cache(maxsize=4096)
def _digest(path: str, *_: int) -> str:
    """Of a file as it was at a time, of a size."""
    content = Path(path).read_bytes()
    if path.endswith(".py"):
        with suppress(SyntaxError, ValueError, RecursionError):  # no Python that could be run counts as it is
            content = "".join(_tree(ast.parse(content))).encode()
    return sha256(content.replace(b"\r\n", b"\n")).hexdigest()[:DIGITS]


def _tree(node: Any) -> Iterator[str]:
    """A syntax tree without places and docstrings as text, the same in every version of Python that reads the file alike."""
    if isinstance(node, list):
        yield "["
        for one in node:
            yield from _tree(one)
            yield ","
        yield "]"
    elif isinstance(node, ast.Constant):
        yield f"{type(node.value).__name__} {node.value!r}"
    elif isinstance(node, ast.AST):
        yield f"{type(node).__name__}("
        for name, value in ast.iter_fields(node):
            if name == "body" and isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                value = value[1:] if _is_docstring(value) else value
            if value is not None and value != [] and name not in ("type_comment", "type_ignores"):
                yield f"{name}="
                yield from _tree(value)
        yield ")"
    else:
        yield repr(node)


def _is_docstring(body: Sequence[ast.stmt]) -> bool:
    return bool(body) and isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant) and isinstance(body[0].value.value, str)


def digests(paths: Iterable[str], places: Sequence[str]) -> Files:
    """Digests of files by name.

    Parameters
    ----------
    places
        The folders of the study's file and of those that it extends.
    """
    named: dict[str, str] = {}
    for path in sorted(paths):
        parts = 0
        while named.setdefault(_name_of(path, places, parts), path) != path:
            parts += 1
    return {name: digest_of(path) for name, path in sorted(named.items())}


def _name_of(path: str, places: Sequence[str], more: int = 0) -> str:
    """A file's name below the first place that holds it; of one that lies elsewhere its last two parts, and `more`."""
    for root in (*places, *_roots()):
        if not more and Path(path).is_relative_to(root):
            return Path(path).relative_to(root).as_posix()
    return Path(*Path(path).parts[-2 - more:]).as_posix()


def located(name: str, places: Sequence[str]) -> str:
    """The file of that name, or "" where there is none."""
    return next((str(path) for root in (*places, *_roots()) if (path := Path(root, name)).is_file()), "")


def changes(there: Mapping[str, str], here: Mapping[str, str]) -> list[str]:
    """Names of files whose digests differ."""
    return [name for name in sorted({*there, *here}) if there.get(name) != here.get(name)]


def named_files(value: Any, places: Sequence[str]) -> Iterator[str]:
    """Files beside a study's file that texts anywhere in a value name."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for one in value:
            yield from named_files(one, places)
    elif isinstance(value, str):
        path = beside(value, places or (os.getcwd(),))
        if path:
            yield path


def beside(text: str, places: Sequence[str]) -> str:
    """The file that a text in a study's file names: relative to the folder of that file, or of one that it extends; "" if none."""
    try:
        return next((os.path.abspath(path) for place in places if (path := Path(place, text)).is_file()), "")
    except (OSError, ValueError):  # a text that is no path, too long say
        return ""


def _roots() -> list[str]:
    """Folders in which modules are looked for: the working directory, and what Python's path holds."""
    return [os.getcwd(), *(place for place in sys.path if place)]
