"""A controller that was written for SUMO: it reads the running simulation and commands the vehicle through TraCI.

The controller's `step(traci, vehicle_id)` sees one copy of the network, with the ids of the traffic file, and other
actors through the vehicle's sensors. Queries of the vehicle's type return the values of the original vehicle. Commanded
speeds and accelerations are converted to pedal positions of the vehicle model.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from safevar_sumo.ads import Ads
from safevar_sumo.ads.base import Trim, pedals_for, trim_at
from safevar_sumo.plugins import Guard
from safevar_sumo.records import Command, Nominal, Observation
from safevar_sumo.scenarios import VUT
from safevar_sumo.sumo.perception import SensedTraffic
from safevar_sumo.sumo.traci_module import CommandedSpeed, bind_traci, substitute_traci, traci_module
from safevar_sumo.sumo.traci_view import TraciView
from safevar_sumo.sumo.world import current_world
from safevar_sumo.vehicles import SumoType

Controller = Callable[..., None]
"""A user's function `step(traci, vehicle_id)`, or an object with such a method and, perhaps, `start`."""


class TraciController(Ads):
    """Drives each vehicle with a controller of its own: a function `step(traci, vehicle_id)`, or a class with `step`.

    Parameters
    ----------
    create
        Creates a vehicle's controller.
    """

    def __init__(self, create: Callable[[], Controller], guard: Guard) -> None:
        self._create, self._guard = create, guard

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        world, drivers = current_world(), []
        values = nominal.mass, nominal.accel, nominal.decel, nominal.max_speed, nominal.actuator_lag
        world.set_types(SumoType(*(np.full(n, value) for value in values)))
        traffic = SensedTraffic(world, step)
        traffic.record_step()
        with substitute_traci():
            for copy in range(n):
                view, controller = TraciView(world, copy, traffic, CommandedSpeed(nominal, step)), self._create()
                if hasattr(controller, "start"):
                    self._call(view, "start", controller.start)
                drivers.append((view, getattr(controller, "step", controller)))
        return _Memory(nominal, traffic, drivers, initial_trim=None)

    def drive(self, seen: Observation, memory: _Memory) -> tuple[Command, _Memory]:
        initial_trim = trim_at(memory.nominal, seen) if memory.initial_trim is None else memory.initial_trim
        accelerations = np.zeros(len(memory.drivers))
        if memory.initial_trim is not None:  # `start` recorded the first step
            memory.traffic.record_step()
        with substitute_traci():
            for i, (view, step) in enumerate(memory.drivers):
                if view.on_the_road:
                    view.time, speed = seen.time, float(seen.speed[i])
                    self._call(view, "step", step)
                    accelerations[i] = view.commands.acceleration(speed, seen.time, view.speed_of_sumo(speed))
        command = pedals_for(memory.nominal, seen.speed, accelerations, initial_trim)
        return command, memory._replace(initial_trim=initial_trim)

    def _call(self, view: TraciView, method: str, function: Callable[..., None]) -> None:
        with bind_traci(view.call):
            self._guard.call(method, function, traci_module(), VUT)
        if view.last_error is not None:  # the controller caught the error and continued
            raise self._guard.failure(method, view.last_error)


class _Memory(NamedTuple):
    """The original vehicle, the sensed traffic, view and step function of each vehicle, and the trim at first."""

    nominal: Nominal
    traffic: SensedTraffic
    drivers: list[tuple[TraciView, Controller]]
    initial_trim: Trim | None
