"""An FMU drives as the model that it was exported from; what it does wrong, and what a study maps
wrongly, is told.
"""

from __future__ import annotations

import re
import sys
import zipfile
from collections.abc import Callable
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pythonfmu.builder import FmuBuilder
from pythonfmu3.builder import FmuBuilder as FmuBuilder3

from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.records import Nominal
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import System
from tests.support.in_process import write
from tests.support.made_up import seen, system_of, uniform

SOURCE = '''
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Small(Fmi2Slave):
    """Executes a statement within a gap; holds 8 m/s elsewhere."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.gap = self.speed = self.where = 0.0
        self.pedal = self.wish = self.steps = 0.0
        for name in ("gap", "speed"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        fixed = Fmi2Variability.fixed
        parameter = Fmi2Causality.parameter
        self.register_variable(Real("where", causality=parameter, variability=fixed))
        for name in ("pedal", "wish"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))

    def do_step(self, now, step):
        self.steps, self.pedal, self.wish = self.steps + 1, 0.0, 8.0 - self.speed
        if self.gap < self.where:
            {then}
        return True
'''
SOURCE_3 = '''
from pythonfmu3 import Fmi3Causality, Fmi3Slave, Fmi3Variability, Float64


class Small(Fmi3Slave):
    """Brakes within a gap."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.time, self.gap, self.where, self.pedal = 0.0, 0.0, 0.0, 0.0
        continuous, fixed = Fmi3Variability.continuous, Fmi3Variability.fixed
        time = Float64("time", causality=Fmi3Causality.independent, variability=continuous)
        self.register_variable(time)
        self.register_variable(Float64("gap", causality=Fmi3Causality.input))
        where = Float64("where", causality=Fmi3Causality.parameter, variability=fixed)
        self.register_variable(where)
        self.register_variable(Float64("pedal", causality=Fmi3Causality.output))

    def do_step(self, now, step):
        self.pedal = 1.0 if self.gap < self.where else 0.0
        return True
'''
TABLE = 'parameters = { where = 25.0 }\ninputs = { gap = "gap" }\noutputs = { brake = "pedal" }'
NOMINAL = Nominal(1500.0, 3.0, 8.0, 40.0, 0.1, lambda: None)  # type: ignore[arg-type, return-value]
NUMBERS = count()
Make = Callable[..., System]


@pytest.fixture
def small(in_tmp: Path) -> Make:
    """The system of an FMU that runs `then` within a gap of 25 m; in its model description `old`
    becomes `new`.
    """

    def system(
        then: str = "self.pedal = 1.0",
        table: str = TABLE,
        old: str = "",
        new: str = "",
        source: str = SOURCE,
    ):  # type: ignore[no-untyped-def]
        module = in_tmp / f"small_{next(NUMBERS)}.py"  # a process imports a module once
        module.write_text(source.format(then=then) if source is SOURCE else source)
        (FmuBuilder if source is SOURCE else FmuBuilder3).build_FMU(module, dest=in_tmp)
        if old:
            with zipfile.ZipFile("Small.fmu") as archive:
                contents = {name: archive.read(name) for name in archive.namelist()}
            edited = re.sub(old, new, contents["modelDescription.xml"].decode())
            assert edited.encode() != contents["modelDescription.xml"]
            with zipfile.ZipFile("Small.fmu", "w") as archive:
                for name, content in {
                    **contents,
                    "modelDescription.xml": edited.encode(),
                }.items():
                    archive.writestr(name, content)
        write(
            "small.toml",
            'extends = "native"\nname = "small"\n[ads]\nkind = "fmu"\n'
            f'model = "Small.fmu"\n{table}',
        )
        return system_of("small.toml")

    return system


def driven(system: System, gaps: list[float], step: float = 0.1) -> np.ndarray:
    """Commands of two vehicles, the second one 10 m farther, shape (T, 2, 2)."""
    memory = system.ads.start(2, NOMINAL, step)
    commands = []
    for sample, gap in enumerate(gaps):
        now = seen(sample * step, 10.0, gap + np.array([0.0, 10.0]))
        command, memory = system.ads.drive(now, memory)
        commands.append([command.throttle, command.brake])
    return np.array(commands)


@pytest.mark.parametrize("source", [SOURCE, SOURCE_3])
def test_each_vehicle_has_an_instance_of_an_fmu_of_either_standard(
    small: Make, source: str
) -> None:
    commands = driven(small(source=source), [40.0, 20.0, 10.0])
    assert_array_equal(commands[:, 0], 0)
    assert_array_equal(commands[:, 1], [[0, 0], [1, 0], [1, 1]])


def test_instances_begin_anew_in_each_run(small: Make) -> None:
    system = small("self.pedal = self.steps / 10")
    for _ in range(2):
        assert_allclose(driven(system, [20.0] * 3)[:, 1, 0], [0.1, 0.2, 0.3])


def test_an_acceleration_drives_as_the_same_law_in_python(small: Make) -> None:
    table = TABLE.replace("25", "15").replace('"gap" }', '"gap", speed = "speed" }')
    fmu = small(
        "self.wish = -9.0", table.replace('brake = "pedal"', 'acceleration = "wish"')
    )
    write(
        "law.py",
        """
import numpy as np
from safevar_sumo.ads.base import Ads, pedals_for, trim_at


class Law(Ads):
    def start(self, n, nominal, step):
        return nominal, None

    def drive(self, seen, memory):
        nominal, trim = memory
        trim = trim or trim_at(nominal, seen)
        wish = np.where(seen.gap < 15.0, -9.0, 8.0 - seen.speed)
        return pedals_for(nominal, seen.speed, wish, trim), (nominal, trim)
""",
    )
    write("law.toml", 'extends = "native"\nname = "law"\n[ads]\nmodel = "law:Law"')
    law = system_of("law.toml")
    settings = uniform(law.characteristics, 12, 5)
    expected = drive_and_score(law, settings)
    results = drive_and_score(fmu, settings)
    assert_array_equal(results.outcome, expected.outcome)
    assert_array_equal(results.f_safe, expected.f_safe)
    assert len({*expected.outcome}) > 1


@pytest.mark.parametrize(
    ("then", "message"),
    [
        ("raise ValueError('the map is empty')", "at 0.2 s"),
        ("self.pedal = 3.0", "brake = 3.0"),
        ("self.pedal = float('nan')", "brake = nan"),
    ],
)
def test_what_it_does_wrong_is_told_and_when(
    small: Make, then: str, message: str
) -> None:
    system = small(then)
    with pytest.raises(UserCodeError) as error:
        driven(system, [100.0, 50.0, 20.0, 10.0])
    assert error.value.problem.startswith("ads.model = 'Small.fmu'")
    assert message in error.value.problem
    assert "\n" not in error.value.problem
    assert_array_equal(
        driven(system, [100.0, 50.0]), 0, err_msg="it drives again after the fault"
    )


@pytest.mark.parametrize(
    ("old", "new", "table", "message"),
    [
        ('fmiVersion="2.0"', 'fmiVersion="1.0"', TABLE, "Small.fmu"),
        ("CoSimulation", "ModelExchange", TABLE, "is another FMU"),
        (
            '(canBeInstantiatedOnlyOncePerProcess=")false',
            "\\1true",
            TABLE,
            "is another FMU",
        ),
        (
            '(name="gap"[^>]*>\\s*<Real) ',
            '\\1 unit="km" ',
            TABLE,
            "ads.inputs.gap = 'gap': its unit is 'km'",
        ),
        (
            "",
            "",
            TABLE.replace('"gap"', '"gsp"'),
            "gsp': no real input of the FMU; did you mean 'gap'?",
        ),
        ("", "", TABLE.replace("brake =", "gas ="), "ads.outputs = ['gas']"),
        (
            "",
            "",
            TABLE.replace("brake =", 'gas = "wish", brake ='),
            "ads.outputs.gas: there is no such quantity",
        ),
        (
            "",
            "",
            TABLE.replace("{ brake", '{ acceleration = "wish", brake'),
            "ads.outputs = ['acceleration', 'brake']",
        ),
        (
            "",
            "",
            TABLE.replace("where", "wear"),
            "ads.parameters.wear = 'wear': no real parameter",
        ),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(
    small: Make, old: str, new: str, table: str, message: str
) -> None:
    with pytest.raises(InputError) as error:
        small(table=table, old=old, new=new)
    assert message in error.value.problem
    assert "\n" not in error.value.problem


def test_a_step_that_an_fmu_cannot_change_has_to_be_the_studys(small: Make) -> None:
    fixed = '\\1<DefaultExperiment stepSize="0.1"/><ModelVariables>'
    system = small(
        old='(?s)canHandleVariableCommunicationStepSize="true"(.*?)<ModelVariables>',
        new=fixed,
    )
    assert driven(system, [20.0])[0, 1, 0] == 1
    with pytest.raises(InputError, match=r"takes steps of 0\.1 s"):
        driven(system, [20.0], 0.05)


def test_without_fmpy_the_extra_is_named(
    small: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with pytest.raises(InputError, match="needs FMPy"):
        small()
