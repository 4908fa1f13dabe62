"""FMUs for tests: sources of slaves that pythonfmu and pythonfmu3 export, and FMUs with an edited model description."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

from pythonfmu.builder import FmuBuilder
from pythonfmu3.builder import FmuBuilder as FmuBuilder3

from safevar_sumo.ads.fmu import OBSERVATION_UNITS
from safevar_sumo.records import Nominal

SEEN = tuple(name for name in OBSERVATION_UNITS if name != "detected")
AEB = '''
import numpy as np
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

from safevar_sumo.ads.aeb import Aeb
from safevar_sumo.records import Nominal, Observation, PedalTables

FACTS, TABLES = {facts}, PedalTables(*(np.array(table) for table in {tables}), {braking})
SEEN = {seen}


class ExportedAeb(Fmi2Slave):
    """The shipped AEB."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.margin, self.interval, self.accelerator, self.brake_pedal = 0.5, 0.0, 0.0, 0.0
        for name in SEEN:
            setattr(self, f"seen_{{name}}", 0.0)
            self.register_variable(Real(f"seen_{{name}}", causality=Fmi2Causality.input))
        for name in ("margin", "interval"):
            self.register_variable(Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.fixed))
        for name in ("accelerator", "brake_pedal"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))
        self.memory = None

    def do_step(self, time, step):
        ads = Aeb(margin=self.margin, cruise_speed=8.0)
        if self.memory is None:
            self.memory = ads.start(1, Nominal(*FACTS, tables=lambda: TABLES), self.interval)
        values = {{name: np.array([getattr(self, f"seen_{{name}}")]) for name in SEEN}}
        command, self.memory = ads.drive(Observation(**values), self.memory)
        self.accelerator, self.brake_pedal = float(command.throttle[0]), float(command.brake[0])
        return True
'''
VEHICLE = '''
import numpy as np
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

from safevar_sumo.records import Command
from safevar_sumo.vehicles import LEVEL
from safevar_sumo.vehicles.base import Slope
from safevar_sumo.vehicles.sensing import SumoVehicle

PARAMETERS = ("mass", "accel", "decel", "maxSpeed", "tau", "actuatorLag", "brakeDelay", "brakeGain")


class ExportedVehicle(Fmi2Slave):
    """The shipped vehicle, without its sensors."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        for name in (*PARAMETERS, "interval", "friction"):
            setattr(self, name, 1.0)
            self.register_variable(Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.fixed))
        for name in ("accelerator", "brake_pedal", "start_speed"):
            setattr(self, name, 0.0)
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        for name in ("v", "brake_now", "throttle_now", "most_accel", "most_decel"):
            setattr(self, name, 0.0)
            self.register_variable(Real(name, causality=Fmi2Causality.output))

    def exit_initialization_mode(self):
        self.vehicle = SumoVehicle()
        values = {name: np.array([getattr(self, name)]) for name in PARAMETERS}
        values |= {"sensorRange": np.ones(1), "reactionTime": np.ones(1)}
        self.prepared = self.vehicle.prepare(values, self.friction, self.interval)
        types = self.vehicle.sumo_type(self.prepared)
        self.most_accel, self.most_decel = float(types.accel[0]), float(types.decel[0])
        self.state = self.vehicle.at_rest(self.prepared)
        if self.start_speed > 0:
            self.state = self.vehicle.at_speed(self.prepared, np.array([self.start_speed]))
        self.tell()

    def tell(self):
        state = self.state
        self.v, self.throttle_now = float(state.speed[0]), float(state.throttle[0])
        self.brake_now = float(state.brake[0])

    def do_step(self, time, step):
        command = Command(np.array([self.accelerator]), np.array([self.brake_pedal]))
        self.state = self.vehicle.advance(self.prepared, self.state, command)
        self.tell()
        return True
'''
SMALL = '''
import os
import time

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Small(Fmi2Slave):
    """Counts its steps; executes a statement within a gap."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.gap, self.speed, self.where, self.pedal, self.steps, self.length = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for name in ("gap", "speed"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        self.register_variable(Real("where", causality=Fmi2Causality.parameter, variability=Fmi2Variability.fixed))
        for name in ("pedal", "steps", "length"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))

    def do_step(self, now, step):
        self.steps, self.length, self.pedal = self.steps + 1, step, 0.0
        if self.gap < self.where:
            {then}
        return True
'''
CART = '''
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Cart(Fmi2Slave):
    """Accelerates and brakes in proportion to its pedals."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.power, self.grip, self.top, self.accelerator, self.brake_pedal, self.v = 3.0, 8.0, 30.0, 0.0, 0.0, 0.0
        for name in ("power", "grip", "top"):
            self.register_variable(Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable))
        for name in ("accelerator", "brake_pedal"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        self.register_variable(Real("v", causality=Fmi2Causality.output))

    def do_step(self, time, step):
        self.v = max(self.v + (self.power * self.accelerator - self.grip * self.brake_pedal) * step, 0.0)
        return True
'''
SMALL_3 = '''
from pythonfmu3 import Fmi3Causality, Fmi3Slave, Fmi3Variability, Float64, Unit


class Third(Fmi3Slave):
    """Asks for a twentieth of its speed [km/h] as a percentage, and for 100 % within `where` millimetres."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.time, self.speed, self.gap, self.where, self.wish = 0.0, 0.0, 0.0, 0.0, 0.0
        units = [Unit("km/h", m=1, s=-1, factor=1 / 3.6), Unit("mm", m=1, factor=1e-3), Unit("%", factor=0.01)]
        self.register_units(units)
        variability, causality = Fmi3Variability, Fmi3Causality
        self.register_variable(Float64("time", causality=causality.independent, variability=variability.continuous))
        self.register_variable(Float64("speed", causality=Fmi3Causality.input, unit="km/h"))
        self.register_variable(Float64("gap", causality=Fmi3Causality.input, unit="mm"))
        where = Float64("where", causality=causality.parameter, variability=variability.fixed, unit="mm")
        self.register_variable(where)
        self.register_variable(Float64("wish", causality=Fmi3Causality.output, unit="%"))

    def do_step(self, now, step):
        self.wish = 100.0 if self.gap < self.where else self.speed / 20
        return True
'''


def exported(source: str, folder: Path, name: str, *, third: bool = False, **options: str) -> Path:
    """Export a slave; returns its FMU."""
    file = folder / f"{name}_source.py"
    file.write_text(source)
    (FmuBuilder3 if third else FmuBuilder).build_FMU(file, dest=folder, **options)
    (fmu,) = (path for path in folder.glob("*.fmu") if path.stem in source)
    return fmu


def aeb(nominal: Nominal) -> str:
    """The source of the shipped AEB with the data of the original vehicle."""
    tables = nominal.tables()
    return AEB.format(
        facts=tuple(nominal[:5]), tables=[table.tolist() for table in tables[:3]], braking=tables.braking, seen=SEEN
    )


def changed(
    fmu: Path,
    into: Path,
    edit: Callable[[str], str],
    keep: Callable[[str], bool] = lambda name: True,
    other: Callable[[str, bytes], bytes] = lambda name, content: content,
) -> Path:
    """Write an FMU with an edited model description, only the files to `keep`, and `other` contents of these files."""
    with zipfile.ZipFile(fmu) as old, zipfile.ZipFile(into, "w") as new:
        for name in filter(keep, old.namelist()):
            content = old.read(name)
            new.writestr(name, edit(content.decode()) if name == "modelDescription.xml" else other(name, content))
    return into
