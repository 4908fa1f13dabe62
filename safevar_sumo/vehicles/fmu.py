"""A vehicle that is an FMU: pedals are inputs, the speed is an output, and its parameters are the characteristics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError, UserCodeError, unknown_name
from safevar_sumo.fmu import (
    COMMON_UNITS,
    REAL_TYPES,
    SI,
    Description,
    Fleet,
    History,
    Instances,
    Port,
    Unit,
    constants_of,
    declared,
    ports_of,
)
from safevar_sumo.plugins import POSITIVE, Guard, open_rows
from safevar_sumo.records import BoolArray, Command, FloatArray, Observation
from safevar_sumo.study import CharacteristicTable
from safevar_sumo.study.schema import Parameters
from safevar_sumo.vehicles.base import LEGAL_STATE, LEVEL, SPEED_ROUNDING, Characteristics, Slope, SumoType, Vehicle
from safevar_sumo.vehicles.sensors import Sensors, sensed_observation

PEDALS: Mapping[str, str] = {"throttle": "-", "brake": "-"}
CONSTANTS: Mapping[str, str] = {"road_friction": "-", "grade": "-", "wet": "-", "initial_speed": "m/s", "step": "s"}
"""Quantities that are constant during a run: inputs of the FMU, or parameters that are set at the start. A grade is
rise over run.
"""
OUTPUTS: Mapping[str, str] = {"speed": "m/s", "throttle": "-", "brake": "-", "gear": "-"}
TYPE_UNITS: Mapping[str, str] = {"mass": "kg", "accel": "m/s^2", "decel": "m/s^2", "max_speed": "m/s", "tau": "s"}
DEFAULT_LAG = 0.1
"""Actuator lag that a driving system assumes if the study gives no `tau` [s]."""
SENSOR_UNITS: Mapping[str, str] = {"latency": "s", "range": "m"}
SENSOR_FIELDS = {"latency": "latency", "range": "reach"}  # fields of `Sensors` by the study's names
LEGAL_ENTRIES = {
    "inputs": "the input for that pedal",
    "outputs": "the output that holds the speed",
    "sumo_type": "a number in SI units; or a characteristic, or an output or parameter of the FMU",
}
READABLE_CAUSALITIES = ("output", "calculatedParameter", "parameter", "local")


class _Prepared(NamedTuple):
    """Constants of a run: inputs, characteristics, types and sensors of the vehicles, and their FMU instances."""

    fleet: Fleet
    inputs: Mapping[str, FloatArray]
    characteristics: Characteristics
    types: SumoType
    sensors: Sensors
    step: float


class _State(NamedTuple):
    """State of N vehicles; `seen` is the history of observations, `history` that of the FMU instances."""

    speed: FloatArray
    throttle: FloatArray
    brake: FloatArray
    gear: FloatArray
    seen: FloatArray | None
    history: History


class FmuVehicle(Vehicle):
    """N vehicles with an instance of an FMU each; see `Vehicle`.

    Parameters
    ----------
    description
        The FMU.
    units
        The characteristics of the study and their units.
    table
        The study's table `vehicle`.
    guard
        Calls the FMU and checks its results.

    Raises
    ------
    InputError
        If the study does not fit the FMU.
    """

    UNITS: Mapping[str, str]

    def __init__(self, description: Description, units: Mapping[str, str], table: Parameters, guard: Guard) -> None:
        source, self._guard = guard.source, guard
        self._communication_step = description.communication_step(table["step"], source, "vehicle")
        self.UNITS = dict(units)
        self._sensor_entries, self._type_entries = dict(table["sensors"]), {"tau": DEFAULT_LAG, **table["sumo_type"]}
        self._check_entries("sensors", self._sensor_entries, SENSOR_UNITS, table["characteristics"])
        self._check_entries("sumo_type", self._type_entries, TYPE_UNITS, table["characteristics"])
        input_ports = ports_of(
            description,
            table["inputs"],
            {**PEDALS, **CONSTANTS},
            ("input",),
            source,
            "vehicle.inputs",
            constants=CONSTANTS,
        )
        output_ports = ports_of(description, table["outputs"], OUTPUTS, ("output",), source, "vehicle.outputs")
        for key, entries, required in (
            ("inputs", input_ports, PEDALS),
            ("outputs", output_ports, ("speed",)),
            ("sumo_type", self._type_entries, TYPE_UNITS),
        ):
            for name in required:
                if name not in entries:
                    raise InputError(source, f"vehicle.{key}.{name} is missing", LEGAL_ENTRIES[key])
        self._characteristic_units = {
            **self._characteristic_units_of(description, "sensors", self._sensor_entries, SENSOR_UNITS),
            **self._characteristic_units_of(description, "sumo_type", self._type_entries, TYPE_UNITS),
        }
        characteristic_ports = {
            name: self._characteristic_port(description, name, unit)
            for name, unit in units.items()
            if name in description.variables or name not in self._sensor_entries.values()
        }
        type_variables = {
            name: entry for name, entry in self._type_entries.items() if isinstance(entry, str) and entry not in units
        }
        type_ports = ports_of(
            description, type_variables, TYPE_UNITS, READABLE_CAUSALITIES, source, "vehicle.sumo_type"
        )
        self._inputs, self._characteristics = tuple(input_ports), tuple(characteristic_ports)
        self._outputs, self._reads_type = (*output_ports, *type_ports), bool(type_ports)
        ports = [*input_ports.values(), *characteristic_ports.values()]
        constants = constants_of(description, table["parameters"], ports, source, "vehicle.parameters")
        self._instances = Instances(description, ports, [*output_ports.values(), *type_ports.values()], constants)
        self.max_vehicles = self._instances.max_vehicles
        self.takes_slope, self.can_start_moving = "grade" in input_ports, "initial_speed" in input_ports
        if "road_friction" not in input_ports:
            self.remarks = [
                f"{guard.name} has no vehicle.inputs.road_friction: weather has no effect on how it "
                "accelerates and brakes"
            ]

    def _check_entries(
        self,
        key: str,
        entries: Mapping[str, str | float],
        quantities: Mapping[str, str],
        table: Mapping[str, CharacteristicTable],
    ) -> None:
        """Refuse names of no quantity, and wrong values, in the study's table `vehicle.sensors` or
        `vehicle.sumo_type`.
        """
        for name, entry in entries.items():
            if name not in quantities:
                raise unknown_name(
                    self._guard.source, f"vehicle.{key}.{name}: there is no such quantity", name, quantities
                )
            if key == "sensors" and isinstance(entry, str) and entry not in self.UNITS:
                raise unknown_name(
                    self._guard.source,
                    f"vehicle.{key}.{name} = {entry!r}: there is no such characteristic",
                    entry,
                    self.UNITS,
                    ", or a number",
                )
            self._refuse_too_small(table, f"vehicle.{key}.{name}", entry, may_be_0=name == "latency")

    def _refuse_too_small(
        self, table: Mapping[str, CharacteristicTable], key: str, entry: str | float, *, may_be_0: bool
    ) -> None:
        """Refuse a negative number, or a characteristic with a negative lower end; 0 is legal only with `may_be_0`."""
        lower = table[entry].lower if isinstance(entry, str) and entry in table else entry
        if not isinstance(lower, str) and (lower < 0 or (lower == 0 and not may_be_0)):
            problem = (
                f"{key} = {lower:g}"
                if lower is entry
                else f"vehicle.characteristics.{entry}.lower = {lower:g}, the value of {key}"
            )
            raise InputError(self._guard.source, problem, "a number of at least 0" if may_be_0 else "a number above 0")

    def _characteristic_port(self, description: Description, name: str, unit: str) -> Port:
        key = f"vehicle.characteristics.{name}"
        variable = description.variable(name, ("parameter",), self._guard.source, key, REAL_TYPES)
        variable_unit = declared(variable, "unit")
        if unit == (variable_unit or unit) or (unit == "-" and variable_unit in ("", "1")):
            return Port(variable, SI["-"], SI["-"])
        defined_unit = description.units.get(unit) or COMMON_UNITS.get(unit)
        if defined_unit is None:
            raise InputError(self._guard.source, f"{key}.unit = {unit!r}: the unit is not defined", repr(variable_unit))
        return Port(
            variable,
            description.unit_for(variable, defined_unit, unit, self._guard.source, f"{key}.unit"),
            defined_unit,
        )

    def _characteristic_units_of(
        self, description: Description, key: str, entries: Mapping[str, str | float], quantities: Mapping[str, str]
    ) -> dict[str, tuple[Unit, Unit]]:
        """The units of the characteristics that set quantities, and of those quantities."""
        pairs = {}
        for name, unit in quantities.items():
            if isinstance(entry := entries.get(name), str) and entry in self.UNITS:
                defined_unit = description.units.get(self.UNITS[entry]) or COMMON_UNITS.get(self.UNITS[entry])
                if defined_unit is None or not defined_unit.fits(SI[unit]):
                    raise InputError(
                        self._guard.source,
                        f"vehicle.{key}.{name} = {entry!r}: the unit of that characteristic is {self.UNITS[entry]!r}",
                        f"a unit of {unit}",
                    )
                pairs[entry] = defined_unit, SI[unit]
        return pairs

    def prepare(
        self,
        characteristics: Characteristics,
        road_friction: float | FloatArray,
        step: float,
        slope: Slope = LEVEL,
        wet: bool | BoolArray = False,
    ) -> _Prepared:
        n = len(next(iter(characteristics.values())))
        if slope is not LEVEL and not self.takes_slope:
            raise UserCodeError(
                self._guard.source,
                f"{self._guard.name} has no vehicle.inputs.grade, and the road has a grade",
                "a variable for the grade, or scenarios with grade 0",
            )
        zeros = np.zeros(n)
        inputs = {
            "throttle": zeros,
            "brake": zeros,
            "road_friction": zeros + road_friction,
            "wet": zeros + wet,
            "grade": zeros + slope.back / slope.down,
            "step": zeros + step,
            "initial_speed": zeros,
        }
        fleet = Fleet(self._instances, n, step, self._communication_step)
        outputs = {}
        if self._reads_type:
            outputs = dict(
                zip(self._outputs, self._start(fleet, self._input_array(inputs, characteristics))[0], strict=True)
            )

        def quantity_values(entry: str | float, name: str) -> FloatArray:
            """Values of the quantity `name`, shape (n,): its entry is a number, a characteristic, or an output of the
            FMU.
            """
            if not isinstance(entry, str):
                return zeros + entry
            if entry not in characteristics:
                return np.asarray(outputs[name])
            unit, quantity_unit = self._characteristic_units[entry]
            return np.asarray(unit.to(quantity_unit, characteristics[entry]))

        types = SumoType(
            *(
                self._guard.numbers("sumo_type", name, quantity_values(self._type_entries[name], name), (n,), POSITIVE)
                for name in TYPE_UNITS
            )
        )
        sensors = Sensors.perfect(n)._replace(
            **{SENSOR_FIELDS[name]: quantity_values(entry, name) for name, entry in self._sensor_entries.items()}
        )
        return _Prepared(fleet, inputs, characteristics, types, sensors, step)

    def sumo_type(self, prepared: _Prepared) -> SumoType:
        return prepared.types

    def at_rest(self, prepared: _Prepared) -> _State:
        return self.at_start(prepared, np.zeros_like(prepared.types.mass))

    def at_speed(self, prepared: _Prepared, speed: FloatArray) -> _State:
        return self.at_start(prepared, speed)

    def at_start(self, prepared: _Prepared, speed: FloatArray) -> _State:
        """The initial state at a speed [m/s], shape (N,)."""
        if np.any(speed > 0) and not self.can_start_moving:
            problem = (
                f"{self._guard.name} has no vehicle.inputs.initial_speed, and the traffic puts it onto the road "
                "in motion"
            )
            raise UserCodeError(
                self._guard.source, problem, "a variable for the initial speed, or traffic that departs with speed 0"
            )
        inputs = self._input_array({**prepared.inputs, "initial_speed": speed}, prepared.characteristics)
        outputs, history = self._start(prepared.fleet, inputs)
        released = Command(np.zeros_like(speed), np.zeros_like(speed))
        state = self._state(dict(zip(self._outputs, outputs, strict=True)), released, None, history)
        for i in np.flatnonzero(np.abs(state.speed - speed) > 1e-6)[:1]:
            raise self._guard.wrong_value(
                "initialisation", "speed", float(state.speed[i]), f"{speed[i]:g} m/s, the initial speed"
            )
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
        inputs = self._input_array({**prepared.inputs, **command._asdict()}, prepared.characteristics)
        (point_outputs, step_outputs), history = self._guard.call(
            "doStep", prepared.fleet.advance, state.history, inputs
        )
        outputs = dict(zip(self._outputs, point_outputs, strict=True))
        outputs["speed"] = dict(zip(self._outputs, step_outputs, strict=True))["speed"]
        next_state, max_speed = self._state(outputs, command, state.seen, history), prepared.types.max_speed
        for i in open_rows(next_state.speed > np.maximum(max_speed, state.speed) * (1 + SPEED_ROUNDING))[:1]:
            raise self._guard.wrong_value(
                "doStep", "speed", float(next_state.speed[i]), f"up to vehicle.sumo_type.max_speed = {max_speed[i]:g}"
            )
        return next_state

    def _start(self, fleet: Fleet, inputs: FloatArray) -> tuple[FloatArray, History]:
        outputs, history = self._guard.call("initialisation", fleet.start, inputs)
        return outputs, history

    def _input_array(self, inputs: Mapping[str, FloatArray], characteristics: Characteristics) -> FloatArray:
        return np.stack(
            [*(inputs[name] for name in self._inputs), *(characteristics[name] for name in self._characteristics)]
        )

    def _state(
        self, outputs: Mapping[str, FloatArray], command: Command, seen: FloatArray | None, history: History
    ) -> _State:
        n = command.throttle.shape
        speed = np.where(np.abs(outputs["speed"]) < SPEED_ROUNDING, 0.0, outputs["speed"])
        values = {"gear": np.ones(n), **command._asdict(), **outputs, "speed": speed}
        columns = {
            name: self._guard.numbers("doStep", name, values[name], n, legal) for name, legal in LEGAL_STATE.items()
        }
        return _State(**columns, seen=seen, history=history)
