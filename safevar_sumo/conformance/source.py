"""Locations (file and line) in user code: where it raised, where it returned last, and what may cause a defect."""

from __future__ import annotations

import ast
import inspect
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

from safevar_sumo.errors import InputError
from safevar_sumo.plugins import Member


class Source:
    """A source file of user code, and the last line in it that returned.

    Parameters
    ----------
    member
        The subject; a metric or objective is represented by its function.
    """

    def __init__(self, member: Member) -> None:
        self._object = getattr(member.target, "function", member.target)
        self._is_fmu, self.file = bool(member.file), member.file or self._file()
        self._folder = str(Path(self.file).parent)
        self._last_location: tuple[str, int] | None = None
        self._user_code_flags: dict[CodeType, bool] = {}

    def _file(self) -> str:
        try:
            return inspect.getsourcefile(self._object) or inspect.getfile(self._object)
        except TypeError:
            return str(getattr(sys.modules.get(getattr(self._object, "__module__", "")), "__file__", "") or "")

    @contextmanager
    def watch_returns(self) -> Iterator[None]:
        """In a block, note the last line of user code that returned."""
        previous = sys.getprofile()
        sys.setprofile(self._note_return)
        try:
            yield
        finally:
            sys.setprofile(previous)

    def _note_return(self, frame: FrameType, event: str, _: Any) -> None:
        if event != "return":
            return
        code = frame.f_code
        if self._is_user_code(code):
            self._last_location = code.co_filename, frame.f_lineno

    def _is_user_code(self, code: CodeType) -> bool:
        if code not in self._user_code_flags:
            self._user_code_flags[code] = code.co_filename.startswith(self._folder) and "site-packages" not in code.co_filename
        return self._user_code_flags[code]

    def location_of_error(self, error: BaseException) -> tuple[str, int]:
        """File and innermost line of user code in which an exception arose; without one, `last_location`."""
        if self._is_fmu:
            return self.location_of_definition()
        exception: BaseException | None = error
        while exception is not None:
            frame, location = exception.__traceback__, None
            while frame is not None:
                if self._is_user_code(frame.tb_frame.f_code):
                    location = frame.tb_frame.f_code.co_filename, frame.tb_lineno
                frame = frame.tb_next
            if location is not None and not isinstance(exception, InputError):
                return location
            exception = exception.__cause__ or exception.__context__
        return self.last_location

    @property
    def last_location(self) -> tuple[str, int]:
        """File and line of user code that returned last; the definition if none did."""
        return self._last_location or self.location_of_definition()

    def location_of_definition(self, *methods: str) -> tuple[str, int]:
        """File and line that define the first existing method of `methods`, or else the subject; line 1 of an FMU."""
        if self._is_fmu:
            return self.file, 1
        for name in methods:
            function = inspect.unwrap(getattr(self._object, name, None) or object)
            code = getattr(function, "__code__", None)
            if code is not None and code.co_filename.startswith(self._folder):
                return code.co_filename, code.co_firstlineno
        try:
            return self.file, max(inspect.getsourcelines(self._object)[1], 1)
        except (OSError, TypeError):
            return self.file, 1

    def location_of_text(self, pattern: str) -> tuple[str, int] | None:
        """The file, and its first line that matches a pattern; None without such a line."""
        text = _read_text(self.file).splitlines()
        return next(((self.file, number) for number, line in enumerate(text, 1) if re.search(pattern, line)), None)

    def location_of_suspect(self, check: str) -> tuple[str, int] | None:
        """The file, and its first line that may cause a failure of `check`; None without such a line."""
        if self._is_fmu:
            return None
        try:
            tree = _used_part(ast.parse(_read_text(self.file)), str(getattr(self._object, "__name__", "")))
        except (SyntaxError, ValueError):
            return None
        lines = sorted({*SUSPECT_LINES[check](tree)})
        return (self.file, lines[0]) if lines else None


@lru_cache(maxsize=64)
def _read_text(file: str) -> str:
    try:
        return Path(file).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


RANDOM_CALLS = re.compile(r"(^|\.)(random|randint|uniform|gauss|normal|choice|shuffle|urandom|uuid\d|token_\w+|time|time_ns|perf_counter|"
                          r"perf_counter_ns|monotonic|monotonic_ns|process_time|now|today|utcnow|getpid|default_rng|id)$")
REDUCTIONS = ("mean", "sum", "max", "min", "std", "var", "median", "average", "any", "all", "cumsum", "sort", "argsort", "argmax",
              "argmin", "linspace", "arange", "percentile", "quantile", "ptp", "prod", "dot", "norm", "accumulate", "roll", "unique")
MUTATING_METHODS = ("append", "add", "update", "setdefault", "extend", "insert", "pop", "remove", "clear", "popleft", "appendleft")


def _used_part(tree: ast.Module, name: str) -> ast.Module:
    """The classes and functions of a module that the class or function `name` uses, and all other statements of the module."""
    definitions = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)}
    used_names, names_left = set[str](), [name]
    while names_left:
        used_name = names_left.pop()
        if used_name in definitions and used_name not in used_names:
            used_names.add(used_name)
            names_left += [node.id for node in ast.walk(definitions[used_name]) if isinstance(node, ast.Name)]
    if not used_names:
        return tree
    return ast.Module([node for node in tree.body if getattr(node, "name", "") in used_names or not isinstance(
        node, ast.ClassDef | ast.FunctionDef)], [])


def _functions_in(tree: ast.AST) -> Iterator[ast.FunctionDef]:
    yield from (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


def _calls_in(function: ast.FunctionDef) -> Iterator[tuple[str, int]]:
    """The name and the line of every call."""
    yield from ((ast.unparse(node.func), node.lineno) for node in ast.walk(function) if isinstance(node, ast.Call))


def _random_lines(tree: ast.AST) -> Iterator[int]:
    """Lines that draw random numbers or read clocks; draws from the `rng` of an algorithm do not count."""
    yield from (line for function in _functions_in(tree) for name, line in _calls_in(function)
                if RANDOM_CALLS.search(name) and not name.startswith(("rng.", "problem.", "self.rng.")))


def _batch_lines(tree: ast.AST) -> Iterator[int]:
    """Lines that reduce over vehicles, or depend on the number of vehicles."""
    yield from (line for function in _functions_in(tree) if function.name != "__init__" for name, line in _calls_in(function)
                if name.rpartition(".")[2] in REDUCTIONS)


def _state_lines(tree: ast.AST) -> Iterator[int]:
    """Lines that assign to classes, to modules or, outside methods that begin a run, to models."""
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    owners = {class_def.name for class_def in classes} | {"cls", "type(self)", "self.__class__"}
    shared_names = {target.id for body in (getattr(tree, "body", []), *(class_def.body for class_def in classes)) for node in body
                    if isinstance(node, ast.Assign | ast.AnnAssign)
                    for target in (node.targets if isinstance(node, ast.Assign) else [node.target]) if isinstance(target, ast.Name)}
    scalar_classes = {id(class_def) for class_def in classes if any("ScalarAds" in ast.unparse(base) for base in class_def.bases)}
    for function in _functions_in(tree):
        outer_names = {name for node in ast.walk(function) if isinstance(node, ast.Global | ast.Nonlocal) for name in node.names}
        for default in [*function.args.defaults, *filter(None, function.args.kw_defaults)]:
            if isinstance(default, ast.List | ast.Dict | ast.Set):
                yield function.lineno
        owner = next((class_def for class_def in classes if function in class_def.body), None)
        begins_run = function.name in ("__init__", "__post_init__", "start") or (owner is not None and (id(owner) in scalar_classes or any(
            isinstance(node, ast.FunctionDef) and node.name == "step" for node in owner.body)))
        for node in ast.walk(function):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AugAssign) else []
            for target in targets:
                base: ast.expr = target.value if isinstance(target, ast.Attribute | ast.Subscript) else target
                text = ast.unparse(base)
                if text in owners or (isinstance(target, ast.Name) and target.id in outer_names) \
                        or (isinstance(target, ast.Subscript) and text.rpartition(".")[2] in shared_names) \
                        or (isinstance(target, ast.Attribute) and text == "self" and not begins_run):
                    yield target.lineno
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in MUTATING_METHODS:
                receiver = ast.unparse(node.func.value)
                if receiver.rpartition(".")[2] in shared_names or (receiver.startswith("self.") and not begins_run) or receiver in owners:
                    yield node.lineno
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("next", "setattr") and node.args \
                    and ast.unparse(node.args[0]) in shared_names | owners:
                yield node.lineno


SUSPECT_LINES = {"determinism": _random_lines, "batch": _batch_lines, "state": _state_lines}
"""Functions that list the suspicious lines of a syntax tree, by check."""
