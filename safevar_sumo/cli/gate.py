"""The gate `--fail-if "KEY > X"`: a condition on a number of a command's own JSON; exit code 3 if it holds."""

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
        values = list(_values(answer, self.key.split("."), self.key))
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


def _values(answer: Any, names: Sequence[str], key: str) -> Iterator[Any]:
    """The values under names in the JSON; in a list, an element by its index, or all elements that have the name."""
    if not names:
        yield answer
        return
    name, *further = names
    if isinstance(answer, list) and name.isdecimal():
        if int(name) >= len(answer):
            raise InputError("--fail-if", f"{key}: there is no element {name}", f"an index below {len(answer)}")
        nearer = [answer[int(name)]]
    else:
        tables = [table for table in (answer if isinstance(answer, list) else [answer]) if isinstance(table, dict)]
        nearer = [table[name] for table in tables if name in table]
        if not nearer and answer != []:
            known = sorted({known for table in tables for known in table})
            raise unknown_name("--fail-if", f"{key}: the command's JSON has no {name!r} there", name, known)
    for value in nearer:
        yield from _values(value, further, key)


def gated(command: CommandFunction) -> CommandFunction:
    """A command with the option --fail-if; the command returns its JSON, and has printed its answer."""

    @wraps(command)
    def run(*arguments: Any, conditions: tuple[str, ...], **options: Any) -> None:
        parsed = [Condition.parse(text) for text in conditions]
        answer = command(*arguments, **options)
        sentences = [sentence for condition in parsed for sentence in condition.fulfilments(answer)]
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
