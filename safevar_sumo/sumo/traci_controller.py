"""A controller that was written for SUMO: it reads the running simulation and commands the vehicle
through TraCI.

The controller's `step(traci, vehicle_id)` sees one copy of the network, with the ids of the traffic
file, and other actors through the vehicle's sensors. Queries of the vehicle's type return the
values of the original vehicle. Commanded speeds and accelerations are converted to pedal positions
of the vehicle model.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from types import ModuleType
from typing import NamedTuple

import numpy as np

from safevar_sumo.ads import Ads
from safevar_sumo.ads.base import Trim, pedals_for, trim_at
from safevar_sumo.errors import subject
from safevar_sumo.plugins import user_error_of, user_errors
from safevar_sumo.plugins.process import temporary_entries
from safevar_sumo.records import Command, Nominal, Observation
from safevar_sumo.scenarios import VUT
from safevar_sumo.sumo.bodies import VehicleWorld
from safevar_sumo.sumo.traci_view import (
    OWN_LOOP,
    SensedTraffic,
    TraciView,
    Value,
    real_traci,
    refused,
)
from safevar_sumo.sumo.world import SumoWorld
from safevar_sumo.vehicles import Sensors, SumoType

Controller = Callable[..., None]
"""A user's function `step(traci, vehicle_id)`, or an object with such a method and, perhaps,
`start`.
"""


class TraciController(Ads):
    """Drives each vehicle with a controller of its own: a function `step(traci, vehicle_id)`, or a
    class with `step`.

    Parameters
    ----------
    create
        Creates a vehicle's controller.
    """

    def __init__(self, create: Callable[[], Controller]) -> None:
        self._create = create
        self.world: SumoWorld
        self.sensors: Sensors

    def in_world(self, world: VehicleWorld, sensors: Sensors) -> TraciController:
        """The same controller in a world of SUMO, with the vehicles' sensors as the weather limits
        them.
        """
        assert isinstance(world, SumoWorld)
        controller = copy.copy(self)
        controller.world = world
        controller.sensors = sensors
        return controller

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        world = self.world
        drivers = []
        traffic = SensedTraffic(world, self.sensors, step)
        with substitute_traci():
            for vehicle in range(n):
                view = TraciView(world, vehicle, traffic)
                controller = self._create()
                if hasattr(controller, "start"):
                    self._call(view, controller.start)
                drivers.append((view, getattr(controller, "step", controller)))
        return _Memory(nominal, traffic, drivers, initial_trim=None)

    @staticmethod
    def known_types(nominal: Nominal, types: SumoType) -> SumoType:
        """The SUMO types whose values controllers may query: the values of the original vehicle for
        all N vehicles, but each vehicle's own time headway tau of SUMO's driver.
        """
        columns = (np.full_like(types.mass, value) for value in nominal[:5])
        return SumoType._make((*columns, types.tau))

    def drive(
        self, observation: Observation, memory: _Memory
    ) -> tuple[Command, _Memory]:
        # `start` recorded the traffic of the first step.
        initial_trim = memory.initial_trim
        accelerations = np.zeros(len(memory.drivers))
        if initial_trim is None:
            initial_trim = trim_at(memory.nominal, observation)
        else:
            memory.traffic.record_step()

        with substitute_traci():
            for i, (view, step) in enumerate(memory.drivers):
                if memory.traffic.is_on_road(i):
                    view.time = observation.time
                    self._call(view, step)
                    accelerations[i] = view.commanded_acceleration(
                        float(observation.speed[i])
                    )
        command = pedals_for(
            memory.nominal, observation.speed, accelerations, initial_trim
        )
        return command, memory._replace(initial_trim=initial_trim)

    def _call(self, view: TraciView, function: Callable[..., None]) -> None:
        """Call a function of the user's controller, whose calls of traci go to `view`."""
        global _active_view  # noqa: PLW0603 - controllers call functions of one module
        _active_view = view
        try:
            with user_errors(subject()), np.errstate():
                function(traci_module(), VUT)
        finally:
            _active_view = None
        # The controller may have caught the error and continued.
        if view.last_error is not None:
            raise user_error_of(view.last_error) or view.last_error


class _Memory(NamedTuple):
    """What controllers keep between steps: the original vehicle, the sensed traffic, the view and
    the step function of each vehicle, and the initial trim, which is None before the first step.
    """

    nominal: Nominal
    traffic: SensedTraffic
    drivers: list[tuple[TraciView, Controller]]
    initial_trim: Trim | None


_active_view: TraciView | None = None
"""The view of the vehicle whose controller runs at the moment; None while no controller runs."""


@contextmanager
def substitute_traci() -> Iterator[None]:
    """Context in which `import traci` and `import libsumo` import the substitute that controllers
    use.
    """
    real_traci()
    modules = dict.fromkeys(("traci", "libsumo"), traci_module())
    with temporary_entries(sys.modules, modules):
        yield


@cache
def traci_module() -> ModuleType:
    """The substitute for traci and libsumo."""
    return _Substitute(real_traci())


class _Substitute(ModuleType):
    """A substitute for the module traci, or for one of its domains such as `traci.vehicle`. It has
    traci's constants and classes; its functions call the view of the driven vehicle.
    """

    def __init__(self, real: Value, domain: str = "") -> None:
        super().__init__("traci", real.__doc__)
        self._real = real
        self._domain = domain
        if not domain:
            self.__path__ = real.__path__
            self.__file__ = real.__file__
            self.__spec__ = real.__spec__

    def __getattr__(self, name: str) -> Value:
        if name == "TraCIException":
            return real_traci().exceptions.TraCIException
        real = getattr(self._real, name)
        if hasattr(real, "getIDList") or name in ("simulation", "gui"):
            return _Substitute(real, name)
        if callable(real) and not isinstance(real, type):
            return partial(_call, self._domain, name)
        return real


def _call(domain: str, name: str, /, *arguments: Value, **named: Value) -> Value:
    if _active_view is None:
        raise refused(domain, name, f"is called while no vehicle is driven: {OWN_LOOP}")
    return _active_view.call(domain, name, arguments, named)
