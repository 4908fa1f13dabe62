"""A controller that was written for SUMO: it reads the running simulation and commands the vehicle through TraCI.

The controller's `step(traci, vehicle_id)` sees one copy of the network, with the ids of the traffic file, and other
actors through the vehicle's sensors. Queries of the vehicle's type return the values of the original vehicle. Commanded
speeds and accelerations are converted to pedal positions of the vehicle model.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.ads import Ads
from safevar_sumo.ads.driver import Trim, pedals_for, trim_at
from safevar_sumo.plugins import Guard
from safevar_sumo.records import Command, Nominal, Observation
from safevar_sumo.scenarios import VUT
from safevar_sumo.sumo.sensing import SensedTraffic
from safevar_sumo.sumo.traci_module import bind_traci, substitute_traci, traci_module
from safevar_sumo.sumo.traci_view import TraciView
from safevar_sumo.sumo.world import current_world
from safevar_sumo.vehicles import SumoType


class TraciController(Ads):
    """Drives each vehicle with a controller of its own: a function `step(traci, vehicle_id)`, or a class with `step`.

    Parameters
    ----------
    create
        Creates a vehicle's controller.
    """

    def __init__(self, create: Callable[[], Any], guard: Guard) -> None:
        self._create, self._guard = create, guard

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        world = current_world()
        values = nominal.mass, nominal.accel, nominal.decel, nominal.max_speed, nominal.actuator_lag
        world.set_types(SumoType(*(np.full(n, value) for value in values)))
        traffic = SensedTraffic(world, step)
        traffic.record_step()
        with substitute_traci():
            drivers = [
                _Driver(TraciView(world, copy, traffic, nominal, step), self._create(), self._guard)
                for copy in range(n)
            ]
        return _Memory(nominal, traffic, drivers, initial_trim=None)

    def drive(self, seen: Observation, memory: _Memory) -> tuple[Command, _Memory]:
        initial_trim = trim_at(memory.nominal, seen) if memory.initial_trim is None else memory.initial_trim
        accelerations = np.zeros(len(memory.drivers))
        if memory.initial_trim is not None:  # `start` recorded the first step
            memory.traffic.record_step()
        with substitute_traci():
            for i, driver in enumerate(memory.drivers):
                if driver.view.on_the_road:
                    accelerations[i] = driver.step(seen.time, float(seen.speed[i]))
        command = pedals_for(memory.nominal, seen.speed, accelerations, initial_trim)
        return command, memory._replace(initial_trim=initial_trim)


class _Memory(NamedTuple):
    """The original vehicle, the sensed traffic, each vehicle's driver, and the trim at the first observation."""

    nominal: Nominal
    traffic: SensedTraffic
    drivers: list[_Driver]
    initial_trim: Trim | None


class _Driver:
    """The controller of one vehicle."""

    def __init__(self, view: TraciView, controller: Any, guard: Guard) -> None:
        self.view, self._guard, self._step = view, guard, getattr(controller, "step", controller)
        if hasattr(controller, "start"):
            self._call("start", controller.start)

    def step(self, time: float, speed: float) -> float:
        """The commanded acceleration [m/s^2]."""
        self.view.time = time
        self._call("step", self._step)
        return self.view.commanded_speed.acceleration(speed, time, self.view.speed_of_sumo(speed))

    def _call(self, method: str, function: Callable[..., Any]) -> None:
        with bind_traci(self.view.call):
            self._guard.call(method, function, traci_module(), VUT)
        if self.view.last_error is not None:  # the controller caught the error and continued
            raise self._guard.failure(method, self.view.last_error)
