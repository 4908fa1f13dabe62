"""What ruff does not check."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

from safevar_sumo.questions.sampling import Stream
from tests.in_process import ROOT


def unrelated_assignments(function: ast.AST) -> Iterator[ast.Assign]:
    """`a, b = x, y` in a function, unless y needs the old value of a, as an exchange does."""
    for node in ast.walk(function):
        if (
            isinstance(node, ast.Assign)
            and isinstance(node.targets[0], ast.Tuple)
            and isinstance(node.value, ast.Tuple)
        ):
            targets = [ast.unparse(target) for target in node.targets[0].elts]
            read = [{ast.unparse(part) for part in ast.walk(value)} for value in node.value.elts]
            is_starred = any(
                isinstance(part, ast.Starred) for part in [*node.targets[0].elts, *node.value.elts]
            )
            if not is_starred and not any(
                target in later
                for number, target in enumerate(targets)
                for later in read[number + 1 :]
            ):
                yield node


def test_a_line_of_a_function_assigns_one_thing() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {ast.unparse(node)}"
        for path in sorted((ROOT / "safevar_sumo").rglob("*.py"))
        for function in ast.walk(ast.parse(path.read_text()))
        if isinstance(function, ast.FunctionDef)
        for node in unrelated_assignments(function)
    ]
    assert not found, "\n".join(found)


def test_an_exchange_is_one_thing() -> None:
    exchange, pair = (ast.parse(f"def f():\n    {line}") for line in ("a, b = b, a", "a, b = b, 1"))
    assert not [*unrelated_assignments(exchange)]
    assert len([*unrelated_assignments(pair)]) == 1


def test_no_two_uses_of_random_numbers_share_a_stream() -> None:
    """Nor is one a number without a name; two share theirs, as answers depend on it."""
    numbered = re.compile(r"default_rng\(\(.*\d|= [\w.]*seed, \d")
    texts = [path.read_text() for path in (ROOT / "safevar_sumo" / "questions").rglob("*.py")]
    assert not [line for text in texts for line in numbered.findall(text)]
    shared = [name for name, stream in Stream.__members__.items() if name != stream.name]
    assert shared == ["WIDER_SCOPE_FROM"]
