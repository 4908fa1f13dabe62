"""One set of options, from which flags, Python functions, the report's calls and printed commands follow; the limits
sheet's rounding; answers as a notebook shows them, escaped.
"""

from __future__ import annotations

import inspect
import json
import re
import shlex
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

import safevar_sumo as sv
from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.opinion import OpinionOptions
from safevar_sumo.analysis.options import Options
from safevar_sumo.analysis.rating import RatingOptions
from safevar_sumo.analysis.repair import RepairOptions
from safevar_sumo.analysis.tolerance import ToleranceOptions
from safevar_sumo.cli.program import commands
from safevar_sumo.study import load_study
from safevar_sumo.vehicles import CharacteristicSet
from tests.in_process import InlinePool, refused, run


@pytest.mark.parametrize("options", [ExplainOptions, OpinionOptions, RatingOptions, RepairOptions, ToleranceOptions])
def test_a_function_takes_and_documents_the_options_of_its_record(options: type[Options]) -> None:
    function = getattr(sv, options.question)
    arguments = inspect.signature(function).parameters
    record = {one.name: one.default for one in fields(options)}
    assert {name: one.default for name, one in list(arguments.items())[1:]} == {
        **record,
        "pool": None,
        "jobs": None,
        "progress": False,
        "as_it_is_now": False,
        **({} if options is RatingOptions else {"point": None}),
    }
    heads = re.findall(r"^(\w+)\n    \w", inspect.getdoc(function) or "", re.MULTILINE)
    assert sorted(heads) == sorted([*arguments, "InputError", "SimulationError"])


@pytest.mark.parametrize(
    "options",
    [
        ExplainOptions(),
        ExplainOptions(solutions=("nsga2:3:0", "rs:1:2"), unsafe="below=0.5", top=3, limit=12_000),
        ToleranceOptions(unsafe="collision", characteristics=("mass", "tireFric"), margin=0.5),
        OpinionOptions(solutions="nsga2:3:0"),
    ],
)
def test_a_printed_command_asks_for_the_same_options(options: Options) -> None:
    """The command, parsed by its own flags, makes the record that printed it."""
    typed = shlex.split(options.command_line("its results", "CPNA, night"))
    assert typed[:5] == ["python", "-m", "safevar_sumo", options.question, "its results"]
    command: Any = commands.get_command(None, options.question)  # type: ignore[arg-type]
    given = command.make_context(options.question, typed[4:]).params
    assert given["point"] == "CPNA, night"
    assert type(options)(**{name: given[name] for name in options.definitions()}) == options
    assert len(typed) == 7 + sum(
        len(value) * 2 if name == "solutions" else 1 if value is True else 2
        for name, value in vars(options).items()
        if value != getattr(type(options), name)
    )


@pytest.mark.slow
def test_a_question_takes_the_point_that_its_command_takes() -> None:
    point = "CPFA, speed 40, wet"
    typed = ["rules", "wear", "--samples", "64", "--point", point, "--json"]
    answer = sv.rules("wear", samples=64, point=point, pool=InlinePool()).to_dict()
    assert json.dumps(answer, indent=2) == run(*typed).stdout.strip()
    refused("rules", "wear", "--point", "CPFB", message=("--point: 'CPFB'", "expected: one of 26 points"))
    with pytest.raises(sv.InputError, match="point: 'CPFB'"):
        sv.rules("wear", point="CPFB")


@pytest.mark.slow
@pytest.mark.usefixtures("worker_processes")
def test_the_same_bytes_whatever_the_number_of_workers(slippery: Path) -> None:
    for question, *flags in (
        ("explain", "--limit", "1000", "--top", "1", "--fits", "0"),
        ("tolerance", "--characteristics", "mass,tireFric", "--margin", "0.5", "--fits", "0"),
        ("risk", "--samples", "300"),
        ("compare", str(slippery), "--samples", "100"),
    ):
        one, two = (run(question, str(slippery), *flags, "--json", "--jobs", jobs).stdout for jobs in ("1", "2"))
        assert one == two


def test_limits_are_rounded_to_the_safe_side() -> None:
    one = CharacteristicSet.of(load_study("wear")).members[0]
    assert one.rounded(2.3178, upwards=True) == 2.32
    assert one.rounded(2.3278, upwards=False) == 2.32
    assert one.rounded(7.999, upwards=True) == 8
    assert replace(one, original=7.9992).rounded(7.999, upwards=True) == 7.9992, "not beyond the original"
