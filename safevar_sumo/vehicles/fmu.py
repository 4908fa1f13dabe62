"""A vehicle that is an FMU: pedals are inputs, the speed is an output, and its parameters are the characteristics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError, UserCodeError, unknown_name
from safevar_sumo.fmu import REAL_TYPES, Description, Fleet, History, Instances
from safevar_sumo.fmu.description import COMMON_UNITS, Unit
from safevar_sumo.plugins import POSITIVE, UserCode, open_rows
from safevar_sumo.records import BoolArray, Command, FloatArray, Observation
from safevar_sumo.study.schema import Parameters
from safevar_sumo.vehicles.base import (
    LEGAL_STATE,
    LEVEL,
    Characteristics,
    DelayedSignal,
    Sensors,
    Slope,
    SumoType,
    Vehicle,
    sensed_observation,
)

PEDALS: Mapping[str, str] = {"throttle": "-", "brake": "-"}
CONSTANTS: Mapping[str, str] = {"road_friction": "-", "grade": "-", "wet": "-", "initial_speed": "m/s", "step": "s"}
"""Quantities that are constant during a run: inputs of the FMU, or parameters that are set at the start. A grade is
rise over run.
"""
OUTPUTS: Mapping[str, str] = {"speed": "m/s", "throttle": "-", "brake": "-", "gear": "-"}
TYPE_UNITS: Mapping[str, str] = {
    "mass": "kg",
    "accel": "m/s^2",
    "decel": "m/s^2",
    "max_speed": "m/s",
    "actuator_lag": "s",
}
SPEED_ROUNDING = 1e-9
"""Relative tolerance of speeds."""
SPEED_TOLERANCE = 1e-6
"""Largest difference between an FMU's speed at the start and the initial speed [m/s]."""
DEFAULT_LAG = 0.1
"""Actuator lag that a driving system assumes if the study gives no `actuator_lag` [s]."""
SENSOR_UNITS: Mapping[str, str] = {"latency": "s", "range": "m"}
SENSOR_FIELDS = {"latency": "latency", "range": "reach"}  # fields of `Sensors` by the study's names
REQUIRED = {
    "inputs": (PEDALS, "the input for that pedal"),
    "outputs": (("speed",), "the output that holds the speed"),
    "sumo_type": (TYPE_UNITS, "a number in SI units; or a characteristic, or an output or parameter of the FMU"),
}
"""Required quantities in tables of the study, and what they may be."""
CHARACTERISTICS = "vehicle.characteristics"
READABLE_CAUSALITIES = ("output", "calculatedParameter", "parameter", "local")


class _Prepared(NamedTuple):
    """Constants of a run: inputs, types and sensors of the vehicles, and their FMU instances."""

    fleet: Fleet
    inputs: Mapping[str, FloatArray]
    types: SumoType
    sensors: Sensors
    step: float


class _State(NamedTuple):
    """State of N vehicles; `seen` is the history of observations, `history` that of the FMU instances."""

    speed: FloatArray
    throttle: FloatArray
    brake: FloatArray
    gear: FloatArray
    seen: DelayedSignal | None
    history: History


class FmuVehicle(Vehicle):
    """N vehicles, each an instance of an FMU; see `Vehicle`.

    Parameters
    ----------
    description
        The FMU.
    units
        The characteristics of the study and their units.
    table
        The study's table `vehicle`.
    code
        Calls the FMU and checks its results.

    Raises
    ------
    InputError
        If the study does not fit the FMU.
    """

    UNITS: Mapping[str, str]

    def __init__(self, description: Description, units: Mapping[str, str], table: Parameters, code: UserCode) -> None:
        source, self._code, self.UNITS = code.source, code, dict(units)
        self._communication_step = description.communication_step(table["step"], source, "vehicle")
        self._sensor_entries, self._type_entries = table["sensors"], {"actuator_lag": DEFAULT_LAG, **table["sumo_type"]}
        for key, entries in {**table, "sumo_type": self._type_entries}.items():
            names, expected = REQUIRED.get(key, ((), ""))
            for name in names:
                if name not in entries:
                    raise InputError(source, f"vehicle.{key}.{name} is missing", expected)
        self._units: dict[str, tuple[Unit, Unit]] = {}
        self._read_entries("sensors", self._sensor_entries, SENSOR_UNITS, description, table)
        variables = self._read_entries("sumo_type", self._type_entries, TYPE_UNITS, description, table)
        quantities = {**PEDALS, **CONSTANTS}
        inputs = description.ports(table["inputs"], quantities, ("input",), source, "vehicle.inputs", CONSTANTS)
        outputs = description.ports(table["outputs"], OUTPUTS, ("output",), source, "vehicle.outputs")
        types = description.ports(variables, TYPE_UNITS, READABLE_CAUSALITIES, source, "vehicle.sumo_type")
        only_of_sensors = set(self._sensor_entries.values()) - description.variables.keys()
        names = {name: name for name in units if name not in only_of_sensors}
        characteristics = description.ports(names, units, ("parameter",), source, CHARACTERISTICS, types=REAL_TYPES)
        self._has_grade, self._has_initial_speed = "grade" in inputs, "initial_speed" in inputs
        inputs |= {f"{CHARACTERISTICS}.{name}": port for name, port in characteristics.items()}
        constants = description.constants(table["parameters"], inputs.values(), source, "vehicle.parameters")
        self._instances = Instances(description, inputs, outputs | types, constants)
        self._reads_type = bool(types)
        self.max_vehicles = self._instances.max_vehicles
        if "road_friction" not in inputs:
            self.remarks = [
                f"{code.name} has no vehicle.inputs.road_friction: weather has no effect on how it "
                "accelerates and brakes"
            ]

    def _read_entries(
        self,
        key: str,
        entries: Mapping[str, str | float],
        quantities: Mapping[str, str],
        description: Description,
        table: Parameters,
    ) -> dict[str, str]:
        """Check the study's table `vehicle.sensors` or `vehicle.sumo_type`, and keep the units of its characteristics.

        Entries are numbers, characteristics or, in `sumo_type`, variables of the FMU, which are returned.
        """
        source, variables = self._code.source, {}
        for name, entry in entries.items():
            entry_key, characteristic = f"vehicle.{key}.{name}", table["characteristics"].get(entry)
            if name not in quantities:
                raise unknown_name(source, f"{entry_key}: there is no such quantity", name, quantities)
            if characteristic is None and isinstance(entry, str):
                if key == "sensors":
                    problem = f"{entry_key} = {entry!r}: there is no such characteristic"
                    raise unknown_name(source, problem, entry, self.UNITS, ", or a number")
                variables[name] = entry
                continue
            lowest = float(entry) if characteristic is None else characteristic.lower
            if lowest < 0 or (lowest == 0 and name != "latency"):
                problem = f"vehicle.characteristics.{entry}.lower = {lowest:g}, the value of {entry_key}"
                if characteristic is None:
                    problem = f"{entry_key} = {lowest:g}"
                raise InputError(source, problem, f"a number {'of at least' if name == 'latency' else 'above'} 0")
            if characteristic is not None:
                unit, si_unit = description.unit(characteristic.unit), COMMON_UNITS[quantities[name]]
                if unit is None or unit.exponents != si_unit.exponents:
                    problem = f"{entry_key} = {entry!r}: the unit of that characteristic is {characteristic.unit!r}"
                    raise InputError(source, problem, f"a unit of {quantities[name]}")
                self._units[name] = unit, si_unit
        return variables

    def prepare(
        self,
        characteristics: Characteristics,
        road_friction: float | FloatArray,
        step: float,
        slope: Slope = LEVEL,
        wet: bool | BoolArray = False,
    ) -> _Prepared:
        n = len(next(iter(characteristics.values())))
        if slope is not LEVEL and not self._has_grade:
            self._refuse_start("grade", "the road has a grade", "grade 0")
        zeros = np.zeros(n)
        inputs = {
            "throttle": zeros,
            "brake": zeros,
            "road_friction": zeros + road_friction,
            "wet": zeros + wet,
            "grade": zeros + slope.back / slope.down,
            "step": zeros + step,
            "initial_speed": zeros,
            **{f"{CHARACTERISTICS}.{name}": values for name, values in characteristics.items()},
        }
        fleet, outputs = Fleet(self._instances, n, step, self._communication_step), dict[str, FloatArray]()
        if self._reads_type:
            outputs, _ = self._code.call("initialisation", fleet.start, inputs)

        def quantity(name: str, entry: str | float) -> FloatArray:
            """Values of a quantity, shape (n,): its entry is a number, a characteristic, or an output of the FMU."""
            if not isinstance(entry, str):
                return zeros + entry
            if name not in self._units:
                return outputs[name]
            unit, si_unit = self._units[name]
            return unit.to(si_unit, characteristics[entry])

        types = {name: quantity(name, self._type_entries[name]) for name in TYPE_UNITS}
        checked = [
            self._code.check_numbers("sumo_type", name, values, (n,), POSITIVE) for name, values in types.items()
        ]
        sensors = {SENSOR_FIELDS[name]: quantity(name, entry) for name, entry in self._sensor_entries.items()}
        return _Prepared(fleet, inputs, SumoType(*checked), Sensors.perfect(n)._replace(**sensors), step)

    def _refuse_start(self, name: str, reason: str, otherwise: str) -> None:
        problem = f"{self._code.name} has no vehicle.inputs.{name}, and {reason}"
        raise UserCodeError(self._code.source, problem, f"a variable for it, or scenarios with {otherwise}")

    def sumo_type(self, prepared: _Prepared) -> SumoType:
        return prepared.types

    def at_rest(self, prepared: _Prepared) -> _State:
        return self.at_start(prepared, np.zeros_like(prepared.types.mass))

    def at_speed(self, prepared: _Prepared, speed: FloatArray) -> _State:
        return self.at_start(prepared, speed)

    def at_start(self, prepared: _Prepared, speed: FloatArray) -> _State:
        """The initial state at a speed [m/s], shape (N,)."""
        if np.any(speed > 0) and not self._has_initial_speed:
            self._refuse_start("initial_speed", "the traffic puts it onto the road in motion", "departSpeed 0")
        inputs = {**prepared.inputs, "initial_speed": speed}
        outputs, history = self._code.call("initialisation", prepared.fleet.start, inputs)
        released = Command(np.zeros_like(speed), np.zeros_like(speed))
        state = self._state(outputs, released, None, history)
        for i in np.flatnonzero(np.abs(state.speed - speed) > SPEED_TOLERANCE)[:1]:
            expected = f"{speed[i]:g} m/s, the initial speed"
            raise self._code.wrong("initialisation", f"speed = {float(state.speed[i])}", expected)
        return state._replace(speed=np.asarray(speed, dtype=float))

    def sensors(self, prepared: _Prepared) -> Sensors:
        return prepared.sensors

    def sense(self, prepared: _Prepared, state: _State, seen: Observation) -> tuple[Observation, _State]:
        """Sensors report the scene as it was one latency ago, and nothing beyond their range times the visibility."""
        if not self._sensor_entries:
            return seen, state
        sensed, past = sensed_observation(
            seen, state.seen, prepared.sensors.latency, prepared.sensors.reach, prepared.step
        )
        return sensed, state._replace(seen=past)

    def advance(self, prepared: _Prepared, state: _State, command: Command) -> _State:
        inputs = {**prepared.inputs, **command._asdict()}
        outputs, at_end, history = self._code.call("doStep", prepared.fleet.advance, state.history, inputs)
        next_state = self._state({**outputs, "speed": at_end["speed"]}, command, state.seen, history)
        max_speed = prepared.types.max_speed
        for i in open_rows(next_state.speed > np.maximum(max_speed, state.speed) * (1 + SPEED_ROUNDING))[:1]:
            expected = f"up to vehicle.sumo_type.max_speed = {max_speed[i]:g}"
            raise self._code.wrong("doStep", f"speed = {float(next_state.speed[i])}", expected)
        return next_state

    def _state(
        self, outputs: Mapping[str, FloatArray], command: Command, seen: DelayedSignal | None, history: History
    ) -> _State:
        n, speed = command.throttle.shape, outputs["speed"]
        values = {"gear": np.ones(n), **command._asdict(), **outputs}
        values["speed"] = np.where(np.abs(speed) < SPEED_ROUNDING, 0.0, speed)
        columns = {
            name: self._code.check_numbers("doStep", name, values[name], n, legal)
            for name, legal in LEGAL_STATE.items()
        }
        return _State(**columns, seen=seen, history=history)
