"""A driving system that is an FMU: its inputs are observations, its outputs are pedals or an acceleration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from safevar_sumo.ads.base import Ads, Trim, pedals_for, trim_at
from safevar_sumo.errors import InputError
from safevar_sumo.fmu import Description, Fleet, History, Instances
from safevar_sumo.plugins import SHARE, UserCode
from safevar_sumo.records import BoolArray, Command, Nominal, Observation
from safevar_sumo.study.schema import Parameters

OBSERVATION_UNITS: Mapping[str, str] = {
    "time": "s",
    "speed": "m/s",
    "gap": "m",
    "closing_speed": "m/s",
    "lateral": "m",
    "lateral_speed": "m/s",
    "visibility": "-",
    "obstacle_speed": "m/s",
    "throttle": "-",
    "brake": "-",
    "detected": "-",
}
"""Quantities that an ADS observes, and their units; `detected` is 1 while an obstacle is detected."""
CONSTANT_UNITS: Mapping[str, str] = {
    "nominal_mass": "kg",
    "nominal_accel": "m/s^2",
    "nominal_decel": "m/s^2",
    "nominal_max_speed": "m/s",
    "nominal_actuator_lag": "s",
    "step": "s",
}
"""Facts about the original vehicle, and the time between two calls: inputs, or parameters that are set at the start."""
NOMINAL_PREFIX = "nominal_"
OUTPUT_UNITS: Mapping[str, str] = {"throttle": "-", "brake": "-", "acceleration": "m/s^2", "warns": "-"}
"""Quantities that the FMU outputs, and their units."""
WARNING = 0.5
"""Value of the output `warns` above which it is a warning [-]."""


class _Memory(NamedTuple):
    """What `FmuAds` remembers of N vehicles.

    Attributes
    ----------
    fleet, history
        Instances of the FMU, and what they were given so far; None before the first call.
    constants
        Constant inputs by name.
    nominal
        The original vehicle.
    trim
        The trim at the first call; None before that call, and for an FMU that outputs pedals.
    warns
        Which drivers are warned, shape (N,); None if the FMU never warns.
    """

    fleet: Fleet
    constants: Mapping[str, float]
    nominal: Nominal
    history: History | None = None
    trim: Trim | None = None
    warns: BoolArray | None = None


class FmuAds(Ads):
    """Drives each of N vehicles with an instance of an FMU; see `Ads`.

    Parameters
    ----------
    description
        The FMU.
    inputs, outputs, parameters, step
        Values of these keys in the study.
    code
        Calls the FMU and checks its results.

    Raises
    ------
    InputError
        If the study does not fit the FMU.
    """

    def __init__(
        self,
        description: Description,
        inputs: Mapping[str, str],
        outputs: Mapping[str, str],
        parameters: Parameters,
        step: float | None,
        code: UserCode,
    ) -> None:
        source = code.source
        self._code, self._communication_step = code, description.communication_step(step, source, "ads")
        quantities = {**OBSERVATION_UNITS, **CONSTANT_UNITS}
        input_ports = description.ports(inputs, quantities, ("input",), source, "ads.inputs", CONSTANT_UNITS)
        output_ports = description.ports(outputs, OUTPUT_UNITS, ("output",), source, "ads.outputs")
        if ("acceleration" in output_ports) == bool({"throttle", "brake"} & output_ports.keys()):
            raise InputError(
                source, f"ads.outputs = {sorted(outputs)}", "throttle, brake or both; alternatively acceleration"
            )
        if not input_ports.keys() & OBSERVATION_UNITS.keys():
            raise InputError(source, "ads.inputs: no observed quantity", f"some of {', '.join(OBSERVATION_UNITS)}")
        constants = description.constants(parameters, input_ports.values(), source, "ads.parameters")
        self._instances = Instances(description, input_ports, output_ports, constants)
        self.max_vehicles = self._instances.max_vehicles

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        names = (name for name in CONSTANT_UNITS if name.startswith(NOMINAL_PREFIX))
        constants = {"step": step, **{name: getattr(nominal, name.removeprefix(NOMINAL_PREFIX)) for name in names}}
        return _Memory(Fleet(self._instances, n, step, self._communication_step), constants, nominal)

    def drive(self, seen: Observation, memory: _Memory) -> tuple[Command, _Memory]:
        values = {**seen._asdict(), "detected": np.isfinite(seen.gap), **memory.constants}
        history = memory.history or self._code.call("initialisation", memory.fleet.start, values)[1]
        outputs, _, history = self._code.call("doStep", memory.fleet.advance, history, values)
        warns = None if "warns" not in outputs else outputs["warns"] > WARNING
        memory = memory._replace(history=history, warns=warns)
        shape = seen.speed.shape
        if "acceleration" in outputs:
            acceleration = self._code.check_numbers("doStep", "acceleration", outputs["acceleration"], shape)
            initial_trim = memory.trim or trim_at(memory.nominal, seen)
            command = pedals_for(memory.nominal, seen.speed, acceleration, initial_trim)
            return command, memory._replace(trim=initial_trim)
        released = np.zeros(shape)
        pedals = (
            self._code.check_numbers("doStep", name, outputs.get(name, released), shape, SHARE)
            for name in Command._fields
        )
        return Command(*pedals), memory

    def warns(self, memory: _Memory) -> BoolArray | None:
        return memory.warns
