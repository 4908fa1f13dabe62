"""The gate `--fail-if "KEY > X"`: a condition on a number of a command's own JSON; exit code 3 if it holds."""

from __future__ import annotations

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
        try:
            assert match is not None
            return cls(match[1], match[2], float(match[3]))
        except (AssertionError, ValueError):
            expected = '"KEY > X" with <, <=, > or >= and a number, such as "probability > 0.01"'
            raise InputError("--fail-if", repr(text), expected) from None

    def fulfilments(self, answer: Any) -> Iterator[str]:
        """A sentence for each number of the answer for which the condition holds; a note if a number is undefined."""
        for value in _values(answer, self.key.split("."), self.key):
            if value is None:
                print_note(f"--fail-if: {self.key} is undefined here")
            elif isinstance(value, bool) or not isinstance(value, int | float):
                raise InputError("--fail-if", f"{self.key} is no number", "the key of a number of the command's JSON")
            elif OPERATORS[self.operator](value, self.limit):
                yield f"{self.key} = {value:g} {self.operator} {self.limit:g}"


def _values(answer: Any, names: Sequence[str], key: str) -> Iterator[Any]:
    """The values under names in the JSON; in a list, an element by its index, or all elements that have the name."""
    if not names:
        yield answer
    elif isinstance(answer, list) and names[0].isdecimal() and int(names[0]) < len(answer):
        yield from _values(answer[int(names[0])], names[1:], key)
    elif isinstance(answer, list):
        elements = [element for element in answer if isinstance(element, dict) and names[0] in element]
        if not elements and answer:
            raise _unknown(names[0], key, {name for element in answer if isinstance(element, dict) for name in element})
        for element in elements:
            yield from _values(element, names, key)
    elif isinstance(answer, dict) and names[0] in answer:
        yield from _values(answer[names[0]], names[1:], key)
    else:
        raise _unknown(names[0], key, answer if isinstance(answer, dict) else ())


def _unknown(name: str, key: str, known: Any) -> InputError:
    return unknown_name("--fail-if", f"{key}: the command's JSON has no {name!r} there", name, sorted(known))


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
