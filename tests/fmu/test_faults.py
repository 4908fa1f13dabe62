"""What is wrong with an FMU, or with how a study uses it, is message in one line; what it needs is given to it."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.plugins.check import check
from safevar_sumo.records import Nominal, Observation
from safevar_sumo.sumo.system import System
from tests.fmu.exported import changed

Make = Callable[..., System]
Edit = Callable[[Path], object]
OUT = """outputs = { brake = "pedal" }"""
IN = """inputs = { gap = "gap" }"""


def edited(old: str, new: str) -> Edit:
    """Replaces text in a model description."""

    def edit(fmu: Path) -> None:
        copy = fmu.with_suffix(".copy")
        changed(fmu, copy, lambda text: re.sub(old, new, text))
        assert copy.read_bytes() != fmu.read_bytes()
        copy.replace(fmu)

    return edit


def with_step(step: str) -> Edit:
    """Requires a step, as FMI 2.0 does: the default step, if no other step will do."""
    handles_steps = 'canHandleVariableCommunicationStepSize="true"(.*?)<ModelVariables>'
    return edited(f"(?s){handles_steps}", f'\\1<DefaultExperiment stepSize="{step}"/><ModelVariables>')


def without_binaries(fmu: Path) -> None:
    copy = fmu.with_suffix(".copy")
    changed(
        fmu, copy, str, lambda name: not name.startswith("binaries/linux") and not name.startswith("binaries/darwin")
    )
    copy.replace(fmu)


@pytest.mark.parametrize(
    ("edit", "table", "message"),
    [
        (edited('fmiVersion="2.0"', 'fmiVersion="1.0"'), "", "cannot be read as an FMU"),
        (edited("CoSimulation", "ModelExchange"), "", "is of FMI 2.0, not for co-simulation"),
        (without_binaries, "", "has no binary for this machine"),
        (lambda fmu: fmu.write_text("no archive"), "", "cannot be read as an FMU: BadZipFile"),
        (Path.unlink, "", "there is no such file"),
        (
            str,
            'inputs = { gap = "gap", speed = "gap" }\n' + OUT,
            "ads: 'gap' and 'gap' have one value, and two keys set it",
        ),
        (
            edited('(name="speed" valueReference=)"1"', '\\1"0"'),
            'inputs = { gap = "gap", speed = "speed" }\n' + OUT,
            "ads: 'gap' and 'speed' have one value, and two keys set it",
        ),
        (with_step("1e9"), "", "requires a step of 1e+09 s"),
        (with_step("1e-9"), "", "requires a step of 1e-09 s"),
        (str, IN + "\n" + OUT + "\nparameters = { where = true }", "ads.parameters.where = True"),
        (
            str,
            IN.replace('"gap" }', '"gsp" }') + "\n" + OUT,
            "ads.inputs.gap = 'gsp' is no input of Small.fmu that holds a number; did you mean 'gap'?",
        ),
        (str, IN.replace('"gap" }', '"pedal" }') + "\n" + OUT, "ads.inputs.gap = 'pedal' is no input of Small.fmu"),
        (str, IN + '\noutputs = { brake = "where" }', "ads.outputs.brake = 'where' is no output of Small.fmu"),
        (str, IN + '\noutputs = { gas = "pedal" }', "ads.outputs.gas: there is no such quantity"),
        (
            str,
            IN + '\noutputs = { brake = "pedal", acceleration = "steps" }',
            "ads.outputs = ['acceleration', 'brake']",
        ),
        (str, IN + "\n" + OUT + "\nparameters = { wear = 1 }", "is no parameter or structuralParameter of Small.fmu"),
        (str, IN + "\n" + OUT + '\nparameters = { where = "far" }', "ads.parameters.where = 'far'"),
        (
            edited('(name="gap"[^>]*>\\s*<Real) ', '\\1 unit="kg" '),
            IN + "\n" + OUT,
            "ads.inputs.gap = 'gap': its unit is 'kg'",
        ),
        (edited('(name="gap"[^>]*>\\s*<Real) ', '\\1 unit="ell" '), IN + "\n" + OUT, "its unit is 'ell'"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(small: Make, edit: Edit, table: str, message: str) -> None:
    with pytest.raises(InputError) as error:
        small(table=table, edit=edit)
    assert message in error.value.problem
    assert "\n" not in error.value.problem
    assert error.value.exit_code == 2


@pytest.mark.slow
def test_check_names_the_fmu_whose_driver_brakes_with_nobody_in_sight(small: Make) -> None:
    small("self.pedal = 1.0")
    assert [(finding.check, finding.where) for finding in check("small.toml")] == [
        ("reaction", "ads.model = 'Small.fmu'")
    ]


def test_without_fmpy_the_extra_is_named(small: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with pytest.raises(InputError, match=r"pip install '\.\[fmu\]'"):
        small()


NOMINAL = Nominal(1500.0, 3.0, 8.0, 40.0, 0.1, lambda: None)  # type: ignore[arg-type, return-value]


def driven(system: System, gaps: list[float], step: float = 0.1) -> np.ndarray:
    """Commands of one vehicle that sees gaps one after the other, shape (2, T)."""
    memory, commands = system.ads.start(1, NOMINAL, step), []
    for sample, gap in enumerate(gaps):
        one = np.ones(1)
        command, memory = system.ads.drive(
            Observation(sample * step, 10 * one, gap * one, 10 * one, one, one, 1.0), memory
        )
        commands.append([command.throttle[0], command.brake[0]])
    return np.array(commands).T


@pytest.mark.parametrize(
    ("then", "message"),
    [
        ("raise ValueError('the map is empty')", "while it is at 0.2 s"),
        ("self.pedal = 3.0", "returned brake = 3.0 from doStep"),
        ("self.pedal = float('nan')", "returned brake = nan from doStep"),
    ],
)
def test_what_it_does_wrong_is_told_and_when(small: Make, then: str, message: str) -> None:
    system = small(then)
    with pytest.raises(UserCodeError) as error:
        driven(system, [100.0, 50.0, 20.0, 10.0])
    assert error.value.problem.startswith("ads.model = 'Small.fmu'")
    assert message in error.value.problem
    assert "\n" not in error.value.problem
    np.testing.assert_array_equal(driven(system, [100.0, 50.0]), 0, err_msg="it drives again after the fault")
