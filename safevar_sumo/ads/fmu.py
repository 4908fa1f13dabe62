"""A driving system that is an FMU (of FMI 2.0 or 3.0, for co-simulation). The FMU's inputs are
observations, and its outputs are pedals or an acceleration, in SI units. Each vehicle has an
instance of the FMU.
"""

from __future__ import annotations

import sys
import weakref
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zipfile import ZipFile

import numpy as np

from safevar_sumo.ads.base import Pedals, ScalarAds, Trim, trim_at
from safevar_sumo.errors import InputError, check_name, missing_extra, unknown_name
from safevar_sumo.output import MAX_UNPACKED, read_file
from safevar_sumo.plugins import UserCode
from safevar_sumo.records import NamedValues, Nominal, Observation
from safevar_sumo.study.encounters import ModelTable

NOMINAL = "nominal_"
"""Prefix of the names of numbers of the original vehicle that an FMU may receive."""
NOMINAL_UNITS: Mapping[str, str] = {
    "mass": "kg",
    "accel": "m/s2",
    "decel": "m/s2",
    "max_speed": "m/s",
    "actuator_lag": "s",
    "length": "m",
    "width": "m",
}
"""The numbers of the original vehicle that an FMU may receive, with their units."""
UNITS: Mapping[str, str] = {
    "speed": "m/s",
    "closing_speed": "m/s",
    "lateral_speed": "m/s",
    "obstacle_speed": "m/s",
    "gap": "m",
    "lateral": "m",
    "obstacle_width": "m",
    "obstacle_length": "m",
    "throttle": "1",
    "brake": "1",
    "visibility": "1",
    "detected": "1",
    "warns": "1",
    "time": "s",
    "step": "s",
    "acceleration": "m/s2",
    **{f"{NOMINAL}{name}": unit for name, unit in NOMINAL_UNITS.items()},
}
"""Quantities that an FMU may receive or return, with their units.

The FMU may receive observations, numbers of the original vehicle (such as `nominal_decel`), and the
`step` between two calls. `detected` is 1 while an obstacle is detected. The FMU returns throttle
and brake, or an acceleration. Above 0.5, `warns` is a warning.
"""
COMMANDS = ("throttle", "brake", "acceleration", "warns")
MAX_INSTANCES = 200
"""Largest number of vehicles at once. Each vehicle has an instance of the FMU."""
REAL_TYPES = ("Real", "Float64", "Float32")


class Fmu:
    """The FMU at `path`. The study's table [ads] names the variables that the FMU receives and
    returns.

    Raises
    ------
    InputError
        If the file is no such FMU, or the study does not fit the FMU.
    """

    def __init__(self, path: str, table: ModelTable, code: UserCode) -> None:
        self.code = code
        self._folder = TemporaryDirectory(prefix="fmu", ignore_cleanup_errors=True)

        expected = (
            "an FMU of FMI 2.0 or 3.0 for co-simulation, of which a process may have"
            " many instances"
        )
        try:
            from fmpy import extract, read_model_description

            with ZipFile(BytesIO(read_file(Path(path)))) as archive:
                size = sum(entry.file_size for entry in archive.infolist())
            if size > MAX_UNPACKED:
                raise ValueError(f"unpacked it has {size / 1e9:.1f} GB")
            extract(path, self._folder.name)
            self._model = read_model_description(self._folder.name, validate=False)
        except ImportError:
            raise missing_extra("", f"{path} needs FMPy", "fmu") from None
        # FMPy may raise any exception for a user's file.
        except Exception as error:
            raise InputError(
                "", f"{table.model}: {type(error).__name__}: {error}", expected
            ) from None

        kind = self._model.coSimulation
        if (
            kind is None
            or self._model.fmiVersion < "2"
            or kind.canBeInstantiatedOnlyOncePerProcess
        ):
            raise InputError("", f"{table.model} is another FMU", expected)
        if ("acceleration" in table.outputs) == bool(
            {"throttle", "brake"} & table.outputs.keys()
        ):
            expected = "throttle, brake or both; alternatively acceleration"
            raise InputError("", f"ads.outputs = {sorted(table.outputs)}", expected)

        observed = [name for name in UNITS if name not in ("acceleration", "warns")]
        self.inputs = {
            key: self._variable("input", key, name, observed)
            for key, name in table.inputs.items()
        }
        self.outputs = {
            key: self._variable("output", key, name, COMMANDS)
            for key, name in table.outputs.items()
        }
        self._parameters = [
            (self._variable("parameter", name, name, [name]), value)
            for name, value in table.parameters.items()
        ]

    def _variable(
        self, causality: str, quantity: str, name: str, quantities: Any
    ) -> Any:
        """Find the FMU's real variable with a name and a causality (input, output or parameter),
        and check that its unit is the unit of a `quantity`. Only `quantities` are legal.
        """
        key = f"ads.{causality}s.{quantity}"
        check_name("", f"{key}: there is no such quantity", quantity, quantities)

        variables = {
            variable.name: variable
            for variable in self._model.modelVariables
            if variable.causality == causality
        }
        if name not in variables or variables[name].type not in REAL_TYPES:
            raise unknown_name(
                "", f"{key} = {name!r}: no real {causality} of the FMU", name, variables
            )
        variable = variables[name]

        unit = (
            (variable.unit or getattr(variable.declaredType, "unit", None) or "")
            .replace("^", "")
            .replace("-", "1")
        )
        if unit and unit != UNITS.get(quantity, unit):
            raise InputError(
                "",
                f"{key} = {name!r}: its unit is {unit!r}",
                f"a variable in {UNITS[quantity]}",
            )
        return variable

    def new_instance(self, step: float) -> Any:
        """Create an instance of the FMU, at the beginning of its time."""
        from fmpy.simulation import instantiate_fmu

        # An FMU with a fixed step must have the study's step.
        kind = self._model.coSimulation
        experiment = self._model.defaultExperiment
        fixed_step = getattr(kind, "fixedInternalStepSize", None)
        if not kind.canHandleVariableCommunicationStepSize and experiment:
            fixed_step = fixed_step or experiment.stepSize
        if fixed_step and float(fixed_step) != step:
            raise InputError(
                "",
                f"ads.model: the FMU takes steps of {fixed_step} s",
                f"the study's step, {step:g} s",
            )
        # An FMU that is written in Python must import its own modules. A loaded module of the same
        # name would be used instead.
        for file in Path(self._folder.name, "resources").glob("*.py"):
            sys.modules.pop(file.stem, None)
        slave = instantiate_fmu(
            self._folder.name, self._model, "CoSimulation", logger=lambda *_: None
        )
        for variable, value in self._parameters:
            write(slave, variable, float(value))
        if self._model.fmiVersion < "3":
            slave.setupExperiment(startTime=0.0)
        slave.enterInitializationMode()
        slave.exitInitializationMode()
        return slave


class FmuAds(ScalarAds):
    """Drives one vehicle with an instance of an FMU; see `ScalarAds`."""

    def __init__(self, fmu: Fmu) -> None:
        self._fmu = fmu
        self._calls = 0
        self._trim: Trim | None = None

    def start(self, nominal: Nominal, step: float) -> None:
        super().start(nominal, step)
        self._known = {
            f"{NOMINAL}{name}": getattr(nominal, name) for name in NOMINAL_UNITS
        } | {"step": step}
        self._slave = self._fmu.code.call(
            "initialisation", self._fmu.new_instance, step
        )
        self._end = weakref.finalize(self, _free, self._slave)
        self._end.atexit = False

    def drive(self, observation: Observation) -> Pedals:
        outputs = self._fmu.code.call(
            "doStep",
            self._step,
            {
                **observation._asdict(),
                "detected": np.isfinite(observation.gap),
                **self._known,
            },
        )
        self._calls += 1
        self.warns = outputs.get("warns", 0.0) > 0.5
        if "acceleration" not in outputs:
            return outputs.get("throttle", 0.0), outputs.get("brake", 0.0)
        self._trim = self._trim or trim_at(self.nominal, observation)
        return self.pedals(outputs["acceleration"], observation.speed, self._trim)

    def _step(self, values: NamedValues) -> NamedValues:
        """Let the instance take a step with these observed values, and return its outputs."""
        slave = self._slave
        time = self._calls * self.step
        try:
            for name, variable in self._fmu.inputs.items():
                write(slave, variable, float(values[name]))
            result = slave.doStep(time, self.step)
            # In FMI 3.0, `doStep` returns whether the FMU wants to end the simulation or returned
            # early.
            if result and any(result[1:3]):
                raise RuntimeError("it ends the simulation or returns early")
            return {
                name: read(slave, variable)
                for name, variable in self._fmu.outputs.items()
            }
        # FMPy may raise any exception. After a failure, FMI forbids further calls of the instance:
        # the instance is not freed.
        except Exception as error:
            self._end.detach()
            raise RuntimeError(f"{str(error).splitlines()[0]} at {time:g} s") from None


def read(slave: Any, variable: Any) -> Any:
    """The value of a real variable of an FMU's instance."""
    (value,) = getattr(slave, f"get{variable.type}")([variable.valueReference])
    return value


def write(slave: Any, variable: Any, value: float) -> None:
    """Set a real variable of an FMU's instance."""
    getattr(slave, f"set{variable.type}")([variable.valueReference], [value])


def _free(slave: Any) -> None:
    slave.terminate()
    slave.freeInstance()
