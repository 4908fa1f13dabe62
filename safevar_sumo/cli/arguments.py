"""What users type: a study or results and their solutions, output files, changes of characteristics; the completion of
these in the shell; and the conditions on the answer (`--fail-if "KEY > X"`) that end a command with exit code 3.
"""

from __future__ import annotations

import math
import operator
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import wraps
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
import numpy as np
from click.shell_completion import CompletionItem

from safevar_sumo.cli.program import print_note, print_warning
from safevar_sumo.errors import InputError, SafevarError, unknown_name
from safevar_sumo.output import check_writable
from safevar_sumo.questions.changes import NUMBER_PATTERN
from safevar_sumo.questions.subject import study_in
from safevar_sumo.records import FloatArray, JsonObject
from safevar_sumo.results import SOLUTIONS, SolutionId, choose_handle, row_of_handle
from safevar_sumo.study import Study, load_study, study_names, unit_text
from safevar_sumo.vehicles import CharacteristicSet

if TYPE_CHECKING:
    from safevar_sumo.questions.case import Case

PICTURE_ENDINGS = (".png", ".pdf", ".svg")


def check_output(path: Path | None, flag: str, endings: tuple[str, ...] = PICTURE_ENDINGS) -> None:
    """Refuse an output file with an unknown ending, with solutions, or that cannot be written; names the flag."""
    if path is None:
        return
    if path.name == SOLUTIONS and path.exists():
        raise InputError(flag, f"{path} holds results", "another file")
    if path.suffix.lower() not in endings:
        raise InputError(flag, str(path), f"a file that ends in {', '.join(endings)}")
    check_writable(path, flag)


def combine_values(
    values_by_name: dict[str, list[float]], base: FloatArray, characteristics: CharacteristicSet
) -> FloatArray:
    """Make M settings, shape (M, n): `base`, shape (n,), with each of the M combinations of values in turn."""
    combinations = list(product(*values_by_name.values()))
    settings = np.tile(base, (len(combinations), 1))
    settings[:, [characteristics.names.index(name) for name in values_by_name]] = combinations
    return settings


def complete_study(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete names of studies, files and directories."""
    names = [CompletionItem(name) for name in study_names() if name.startswith(incomplete)]
    return [*names, CompletionItem(incomplete, type="file")]


def complete_changes(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete `NAME=` for each characteristic of the study named earlier in the command line, with its domain as
    help.
    """
    # While --set is incomplete, click may not have parsed the study: then it is the first word that is left.
    study = str(ctx.params.get("study") or next(iter(ctx.args), ""))
    if not study or Path(study).is_dir():
        return []
    try:
        characteristics = load_study(study).vehicle.characteristics
    except SafevarError:
        return []
    return [
        CompletionItem(f"{name}=", help=f"{item.lower:g} to {item.upper:g}{unit_text(item.unit)}")
        for name, item in characteristics.items()
        if name.startswith(incomplete)
    ]


CommandFunction = Callable[..., Any]
OptionValue = Any
"""The value of an option, as click converts it."""
JsonAnswer = JsonObject | list[JsonObject]
"""What a command prints with --json."""
Decorator = Callable[[CommandFunction], CommandFunction]


class CommandTarget(NamedTuple):
    """What a command works on: a study, and its name in errors; of a solution to replay, also the handle, the setting,
    and the row of the results.
    """

    study: Study
    source: str
    handle: SolutionId | None = None
    setting: FloatArray | None = None
    row: JsonObject | None = None


def load_target(source: str, solution: str | None, choice: str | None) -> CommandTarget:
    """Load a study by name or path, or the study of a results directory, with the solution that is named or chosen.

    Raises
    ------
    InputError
        If there is no such study, directory or solution.
    """
    if solution is not None and choice is not None:
        raise InputError(
            "--solution", f"{solution!r} and --{choice.replace('_', '-')} both choose a solution", "one of them"
        )
    if solution is None and choice is None:
        return CommandTarget(study_in(_load_subject(source)), source)
    case = load_results_or_study(source, results_only=True)
    assert not isinstance(case, Study)
    case.require_solutions()
    handle = (
        choose_handle(case.solutions, case.unsafe, str(choice), source)
        if solution is None
        else SolutionId.parse(solution)
    )
    row = case.solutions.iloc[row_of_handle(case.solutions, handle)]
    setting = row[list(case.characteristics.names)].to_numpy(dtype=float)
    return CommandTarget(case.study, source, handle, setting, {str(name): value for name, value in row.items()})


def file_option(flag: str, help_text: str, *, metavar: str = "FILE", **options: Any) -> Decorator:
    """An option that names a file or directory to write."""
    return click.option(flag, type=click.Path(path_type=Path), metavar=metavar, help=help_text, **options)


directories_argument = click.argument("directories", nargs=-1, required=True, metavar="DIR...")
jobs_option = click.option(
    "--jobs", type=click.IntRange(1, 1024), help="Worker processes.  [default: the cores of this machine]"
)
point_option = click.option("--point", metavar="NAME", help="Only this point of the study's matrix.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
AS_IT_IS_NOW_KEY = "safevar_sumo.as_it_is_now"
"""Key of the flag --as-it-is-now in a command's context; functions that read results directories look it up."""
as_it_is_now_option = click.option(
    "--as-it-is-now",
    is_flag=True,
    expose_value=False,
    callback=lambda context, _option, value: context.meta.update({AS_IT_IS_NOW_KEY: value}),
    help="If results were computed with other files or versions, simulate with the present ones and say so.",
)


def as_it_is_now() -> bool:
    """Whether the user gave the flag --as-it-is-now."""
    return bool(click.get_current_context().meta.get(AS_IT_IS_NOW_KEY))


def split_names(text: str) -> tuple[str, ...]:
    """Split names at commas."""
    return tuple(name.strip() for name in text.split(","))


def load_results_or_study(source: str, point: str | None = None, *, results_only: bool = False) -> Study | Case:
    """Load a results directory or, unless `results_only`, a study by name or path; `point` restricts it to a point of
    its matrix.

    A note says which runs of a results directory are unfinished.

    Raises
    ------
    InputError
        If there is no such study or results directory, or it has no such point.
    """
    subject = _load_subject(source, point, results_only=results_only)
    if not isinstance(subject, Study) and subject.shortfall:
        print_note(subject.shortfall)
    return subject


def _load_subject(source: str, point: str | None = None, *, results_only: bool = False) -> Study | Case:
    from safevar_sumo.questions.subject import reduce_to_point, study_or_case

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        subject = study_or_case(source, as_it_is_now=as_it_is_now(), results_only=results_only)
    for warning in caught:
        print_warning(warning.message)
    return reduce_to_point(subject, point)


GATE_EXIT_CODE = 3
"""Exit code of a command if a condition of --fail-if holds, or a limit is not kept."""
OPERATORS: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
CONDITION = re.compile(rf"\s*([^\s<>=]+)\s*(<=|>=|<|>)\s*({NUMBER_PATTERN})\s*")


class Condition(NamedTuple):
    """A condition such as `interval.1 > 0.01`: names of the JSON, or indices, joined by dots; an operator; a number."""

    key: str
    operator: str
    limit: float

    @classmethod
    def parse(cls, text: str) -> Condition:
        match = CONDITION.fullmatch(text)
        if match is None or not math.isfinite(limit := float(match[3])):
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


def _values(answer: Any, names: Sequence[str], key: str) -> list[Any]:
    """The values under `names`, one below the other, in the JSON. In a list, an index names an element, and any other
    name a value of each element that has it. Whatever is under an undefined value (None) is undefined.
    """
    values = [answer]
    for name in names:
        lists = [value for value in values if isinstance(value, list | tuple)]
        if name.isdecimal() and lists:
            if int(name) >= len(shortest := min(lists, key=len)):
                problem = f"{key}: there is no element {name}"
                raise InputError("--fail-if", problem, f"an index below {len(shortest)}")
            values = [*(value[int(name)] for value in lists), *(None for value in values if value is None)]
            continue
        elements = [element for value in values for element in (value if isinstance(value, list | tuple) else [value])]
        tables = [element for element in elements if isinstance(element, dict)]
        undefined = [element for element in elements if element is None]
        if elements and not undefined and not any(name in table for table in tables):
            known_names = sorted({known for table in tables for known in table})
            raise unknown_name("--fail-if", f"{key}: the command's JSON has no {name!r} there", name, known_names)
        values = [*(table[name] for table in tables if name in table), *undefined]
    return values


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
