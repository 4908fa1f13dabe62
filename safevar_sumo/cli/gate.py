"""Gates, which end a command with exit code 3: `--fail-if "KEY > X"`, if this holds for a number of the command's own
JSON; and what a command itself finds broken.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterator, Sequence
from functools import wraps
from typing import Any, NamedTuple

import click

from safevar_sumo.cli.arguments import CommandFunction
from safevar_sumo.cli.program import print_note
from safevar_sumo.errors import InputError, unknown_name

GATE_EXIT_CODE = 3
FAILURES_KEY = "safevar_sumo.failures"
"""Key of the sentences in a command's context that end it with this exit code."""
OPERATORS: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
FORM = re.compile(r"\s*([^\s<>=]+)\s*(<=|>=|<|>)\s*([^\s<>=]+)\s*")


class Condition(NamedTuple):
    """A condition such as `interval.1 > 0.01`: names of the JSON, or indices, joined by dots; an operator; a number."""

    key: str
    operator: str
    limit: float

    @classmethod
    def parse(cls, text: str) -> Condition:
        match = FORM.fullmatch(text)
        if match is None or not math.isfinite(limit := _number(match[3])):
            expected = '"KEY > X" with <, <=, > or >= and a number, such as "probability > 0.01"'
            raise InputError("--fail-if", repr(text), expected)
        return cls(match[1], match[2], limit)

    def fulfilments(self, answer: Any) -> Iterator[str]:
        """A sentence for each number of the answer for which the condition holds; a note if no number is there."""
        values = _values(answer, self.key.split("."), self.key)
        if None in values or not values:
            print_note(f"--fail-if: {self.key} is {'undefined' if values else 'in no element'} here")
        for value in values:
            if isinstance(value, bool) or not isinstance(value, int | float | None):
                raise InputError("--fail-if", f"{self.key} is no number", "the key of a number of the command's JSON")
            if value is not None and OPERATORS[self.operator](value, self.limit):
                yield f"{self.key} = {value:g} {self.operator} {self.limit:g}"


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _values(answer: Any, names: Sequence[str], key: str) -> list[Any]:
    """The values under names in the JSON; in a list, an element by its index, or all elements that have the name."""
    values = [answer]
    for name in names:
        lists = [value for value in values if isinstance(value, list)]
        if name.isdecimal() and lists:
            if int(name) >= len(shortest := min(lists, key=len)):
                problem = f"{key}: there is no element {name}"
                raise InputError("--fail-if", problem, f"an index below {len(shortest)}")
            values = [value[int(name)] for value in lists]
            continue
        elements = [element for value in values for element in (value if isinstance(value, list) else [value])]
        tables = [element for element in elements if isinstance(element, dict)]
        if elements and not any(name in table for table in tables):
            known = sorted({known for table in tables for known in table})
            raise unknown_name("--fail-if", f"{key}: the command's JSON has no {name!r} there", name, known)
        values = [table[name] for table in tables if name in table]
    return values


def fail(sentence: str) -> None:
    """End the command with exit code 3 after its answer, and with this sentence."""
    click.get_current_context().meta.setdefault(FAILURES_KEY, []).append(sentence)


def gated(command: CommandFunction) -> CommandFunction:
    """A command with the option --fail-if; the command returns its JSON, and has printed its answer."""

    @wraps(command)
    def run(*arguments: Any, conditions: tuple[str, ...], **options: Any) -> None:
        parsed = [Condition.parse(text) for text in conditions]
        answer = command(*arguments, **options)
        sentences = click.get_current_context().meta.get(FAILURES_KEY, [])
        sentences += [sentence for condition in parsed for sentence in condition.fulfilments(answer)]
        for sentence in sentences:
            click.echo(f"failed: {sentence}", err=True)
        if sentences:
            click.get_current_context().exit(GATE_EXIT_CODE)

    return click.option(
        "--fail-if",
        "conditions",
        multiple=True,
        metavar='"KEY > X"',
        help="End with exit code 3 if a number of the command's JSON is so; may be repeated.",
    )(run)
