"""A driving system that is an FMU: what it observes are inputs, pedals or an acceleration are outputs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.ads.driver import Trim, pedals, trim
from safevar_sumo.errors import ForeignError, InputError
from safevar_sumo.fmu import Description, Fault, Fleet, Instances, Past, fixed_of, ports_of
from safevar_sumo.plugins import Guard
from safevar_sumo.records import BoolArray, Command, FloatArray, Nominal, Observation

OBSERVED: Mapping[str, str] = {
    "time": "s", "speed": "m/s", "gap": "m", "closing_speed": "m/s", "lateral": "m", "lateral_speed": "m/s", "visibility": "-",
    "obstacle_speed": "m/s", "throttle": "-", "brake": "-", "detected": "-"}
"""Quantities that an ADS observes, and their units; `detected` is 1 while there is somebody."""
KNOWN: Mapping[str, str] = {
    "nominal_mass": "kg", "nominal_accel": "m/s^2", "nominal_decel": "m/s^2", "nominal_max_speed": "m/s", "nominal_actuator_lag": "s",
    "step": "s"}
"""What it may know of the original vehicle, and the time between two calls: inputs, or parameters that are set at the start."""
OF_NOMINAL = "nominal_"
COMMANDED: Mapping[str, str] = {"throttle": "-", "brake": "-", "acceleration": "m/s^2", "warns": "-"}
"""Quantities that it tells; a warning is one above one half."""


class _Memory(NamedTuple):
    """Its instances and how they got here; the pedals that hold the initial speed; whether drivers are warned."""

    fleet: Fleet
    known: Mapping[str, float]
    nominal: Nominal
    past: Past | None = None
    trim: Trim | None = None
    warns: BoolArray | None = None


class FmuAds:
    """N vehicles driven by an instance of an FMU each; see `Ads`.

    Parameters
    ----------
    description
        The FMU.
    inputs, outputs, parameters, step
        As the study has them.
    guard
        Checks what comes of it.
    limit
        How long an instance may take for one step [s].

    Raises
    ------
    InputError
        If what the study says does not fit the FMU.
    """

    def __init__(self, description: Description, inputs: Mapping[str, str], outputs: Mapping[str, str], parameters: Mapping[str, Any],
                 step: float | None, guard: Guard, limit: float) -> None:
        source = guard.source
        self._guard, self._own_step = guard, step or description.step
        given = ports_of(description, inputs, {**OBSERVED, **KNOWN}, ("input",), source, "ads.inputs", constant=KNOWN)
        told = ports_of(description, outputs, COMMANDED, ("output",), source, "ads.outputs")
        if ("acceleration" in told) == bool({"throttle", "brake"} & told.keys()):
            raise InputError(source, f"ads.outputs = {sorted(outputs)}", "throttle, brake or both of them; or acceleration")
        if not given.keys() & OBSERVED.keys():
            raise InputError(source, "ads.inputs: nothing that it observes", f"some of {', '.join(OBSERVED)}")
        self._given, self._told = tuple(given), tuple(told)
        taken = [port.variable.name for port in given.values()]
        self._instances = Instances(description, [*given.values()], [*told.values()],
                                    list(fixed_of(description, parameters, taken, source, "ads.parameters")), limit)
        self.most_vehicles = self._instances.most_vehicles
        if "warns" in told:
            self.warns = self._warns

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        known = {"step": step, **{name: getattr(nominal, name.removeprefix(OF_NOMINAL)) for name in KNOWN if name.startswith(OF_NOMINAL)}}
        return _Memory(Fleet(self._instances, n, step, self._own_step), known, nominal)

    def drive(self, seen: Observation, memory: _Memory) -> tuple[Command, _Memory]:
        inputs = self._inputs(seen, memory.known)
        try:
            past = memory.past or memory.fleet.start(inputs)[1]
            outputs, past = memory.fleet.advance(past, inputs)
        except Fault as fault:
            raise ForeignError(self._guard.source, f"{self._guard.name} {fault}") from None
        told = dict(zip(self._told, outputs[0], strict=True))
        warns = None if "warns" not in told else told["warns"] > 0.5
        memory = memory._replace(past=past, warns=warns)
        if "acceleration" in told:
            wished = self._guard.numbers("doStep", "acceleration", told["acceleration"], seen.speed.shape)
            held = memory.trim or trim(memory.nominal, seen)
            return pedals(memory.nominal, seen.speed, wished, held), memory._replace(trim=held)
        nothing = np.zeros_like(seen.speed)
        return Command(*(self._guard.numbers("doStep", name, told.get(name, nothing), seen.speed.shape, 0.0, 1.0)
                         for name in Command._fields)), memory

    def _inputs(self, seen: Observation, known: Mapping[str, float]) -> FloatArray:
        values = {**seen._asdict(), "detected": np.isfinite(seen.gap), **known}
        return np.stack([np.broadcast_to(np.asarray(values[name], dtype=float), seen.speed.shape) for name in self._given])

    def _warns(self, memory: _Memory) -> BoolArray:
        assert memory.warns is not None
        return memory.warns
