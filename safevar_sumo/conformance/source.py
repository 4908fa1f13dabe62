"""An author's source code: the line that ran last, the line that raised, and lines that look like the cause of a defect."""

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
    """An author's code: its file, and the line that returned last.

    Parameters
    ----------
    member
        The subject; a metric or objective is represented by its function.
    """

    def __init__(self, member: Member) -> None:
        self._object = getattr(member.target, "function", member.target)
        self._is_fmu, self.file = bool(member.file), member.file or self._file()
        self._folder = str(Path(self.file).parent)
        self._last: tuple[str, int] | None = None
        self._of_author: dict[CodeType, bool] = {}

    def _file(self) -> str:
        try:
            return inspect.getsourcefile(self._object) or inspect.getfile(self._object)
        except TypeError:
            return str(getattr(sys.modules.get(getattr(self._object, "__module__", "")), "__file__", "") or "")

    @contextmanager
    def watched(self) -> Iterator[None]:
        """A context that remembers the last line of the author's code that returned."""
        before = sys.getprofile()
        sys.setprofile(self._note)
        try:
            yield
        finally:
            sys.setprofile(before)

    def _note(self, frame: FrameType, event: str, _: Any) -> None:
        if event != "return":
            return
        code = frame.f_code
        if self._is_authors(code):
            self._last = code.co_filename, frame.f_lineno

    def _is_authors(self, code: CodeType) -> bool:
        if code not in self._of_author:
            self._of_author[code] = code.co_filename.startswith(self._folder) and "site-packages" not in code.co_filename
        return self._of_author[code]

    def of_error(self, error: BaseException) -> tuple[str, int]:
        """The innermost line of the author's code that an exception passed through; else the line that returned last."""
        if self._is_fmu:
            return self.definition()
        one: BaseException | None = error
        while one is not None:
            frame, place = one.__traceback__, None
            while frame is not None:
                if self._is_authors(frame.tb_frame.f_code):
                    place = frame.tb_frame.f_code.co_filename, frame.tb_lineno
                frame = frame.tb_next
            if place is not None and not isinstance(one, InputError):
                return place
            one = one.__cause__ or one.__context__
        return self._last or self.definition()

    @property
    def last(self) -> tuple[str, int]:
        return self._last or self.definition()

    def definition(self, *methods: str) -> tuple[str, int]:
        """The line of the first of these methods that exists, else of the subject itself; line 1 of an FMU."""
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

    def line_of_text(self, pattern: str) -> tuple[str, int] | None:
        """The first line of the file that holds a pattern."""
        text = _text(self.file).splitlines()
        return next(((self.file, number) for number, line in enumerate(text, 1) if re.search(pattern, line)), None)

    def suspect(self, check: str) -> tuple[str, int] | None:
        """The line of the file that looks like the cause of a difference; None if no line does."""
        if self._is_fmu:
            return None
        try:
            tree = _part_of(ast.parse(_text(self.file)), str(getattr(self._object, "__name__", "")))
        except (SyntaxError, ValueError):
            return None
        lines = sorted({*SUSPECTS[check](tree)})
        return (self.file, lines[0]) if lines else None


@lru_cache(maxsize=64)
def _text(file: str) -> str:
    try:
        return Path(file).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


RANDOM = re.compile(r"(^|\.)(random|randint|uniform|gauss|normal|choice|shuffle|urandom|uuid\d|token_\w+|time|time_ns|perf_counter|"
                    r"perf_counter_ns|monotonic|monotonic_ns|process_time|now|today|utcnow|getpid|default_rng|id)$")
OVER_VEHICLES = ("mean", "sum", "max", "min", "std", "var", "median", "average", "any", "all", "cumsum", "sort", "argsort", "argmax",
                 "argmin", "linspace", "arange", "percentile", "quantile", "ptp", "prod", "dot", "norm", "accumulate", "roll", "unique")
MUTATORS = ("append", "add", "update", "setdefault", "extend", "insert", "pop", "remove", "clear", "popleft", "appendleft")


def _part_of(tree: ast.Module, name: str) -> ast.Module:
    """The parts of a module that a class or function of that name uses: classes and functions that it names, and all assignments."""
    defined = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)}
    used, waiting = set[str](), [name]
    while waiting:
        one = waiting.pop()
        if one in defined and one not in used:
            used.add(one)
            waiting += [node.id for node in ast.walk(defined[one]) if isinstance(node, ast.Name)]
    if not used:
        return tree
    return ast.Module([node for node in tree.body if getattr(node, "name", "") in used or not isinstance(
        node, ast.ClassDef | ast.FunctionDef)], [])


def _functions(tree: ast.AST) -> Iterator[ast.FunctionDef]:
    yield from (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


def _calls(function: ast.FunctionDef) -> Iterator[tuple[str, int]]:
    """The name and the line of every call."""
    yield from ((ast.unparse(node.func), node.lineno) for node in ast.walk(function) if isinstance(node, ast.Call))


def _random_lines(tree: ast.AST) -> Iterator[int]:
    """Lines that call random numbers or clocks, except the `rng` of an algorithm."""
    yield from (line for function in _functions(tree) for name, line in _calls(function)
                if RANDOM.search(name) and not name.startswith(("rng.", "problem.", "self.rng.")))


def _batch_lines(tree: ast.AST) -> Iterator[int]:
    """Lines that reduce over vehicles, or depend on the number of vehicles."""
    yield from (line for function in _functions(tree) if function.name != "__init__" for name, line in _calls(function)
                if name.rpartition(".")[2] in OVER_VEHICLES)


def _state_lines(tree: ast.AST) -> Iterator[int]:
    """Lines that assign to classes or modules, or to models in methods that do not begin a run."""
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    owners = {one.name for one in classes} | {"cls", "type(self)", "self.__class__"}
    shared = {target.id for body in (getattr(tree, "body", []), *(one.body for one in classes)) for node in body
              if isinstance(node, ast.Assign | ast.AnnAssign)
              for target in (node.targets if isinstance(node, ast.Assign) else [node.target]) if isinstance(target, ast.Name)}
    scalar = {id(one) for one in classes if any("ScalarAds" in ast.unparse(base) for base in one.bases)}
    for function in _functions(tree):
        declared = {name for node in ast.walk(function) if isinstance(node, ast.Global | ast.Nonlocal) for name in node.names}
        for default in [*function.args.defaults, *filter(None, function.args.kw_defaults)]:
            if isinstance(default, ast.List | ast.Dict | ast.Set):
                yield function.lineno
        own = next((one for one in classes if function in one.body), None)
        begins = function.name in ("__init__", "__post_init__", "start") or (own is not None and (id(own) in scalar or any(
            isinstance(node, ast.FunctionDef) and node.name == "step" for node in own.body)))
        for node in ast.walk(function):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AugAssign) else []
            for target in targets:
                base: ast.expr = target.value if isinstance(target, ast.Attribute | ast.Subscript) else target
                text = ast.unparse(base)
                if text in owners or (isinstance(target, ast.Name) and target.id in declared) \
                        or (isinstance(target, ast.Subscript) and text.rpartition(".")[2] in shared) \
                        or (isinstance(target, ast.Attribute) and text == "self" and not begins):
                    yield target.lineno
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in MUTATORS:
                receiver = ast.unparse(node.func.value)
                if receiver.rpartition(".")[2] in shared or (receiver.startswith("self.") and not begins) or receiver in owners:
                    yield node.lineno
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("next", "setattr") and node.args \
                    and ast.unparse(node.args[0]) in shared | owners:
                yield node.lineno


SUSPECTS = {"determinism": _random_lines, "batch": _batch_lines, "state": _state_lines}
