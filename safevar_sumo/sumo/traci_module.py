"""Substitutes for traci and libsumo, whose functions refer to the vehicle that a controller drives; and TraCI's subscriptions."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from types import ModuleType
from typing import Any

from safevar_sumo.errors import InputError
from safevar_sumo.sumo.engine import Engine, engine_api
from safevar_sumo.sumo.traci_view import TraciView, positional_arguments, real_traci, refuse_own_loop, traci_exception

VARIABLES: Mapping[str, str] = {
    "TRACI_ID_LIST": "getIDList", "ID_COUNT": "getIDCount", "VAR_POSITION": "getPosition", "VAR_POSITION3D": "getPosition3D",
    "VAR_SPEED": "getSpeed", "VAR_ANGLE": "getAngle", "VAR_ROAD_ID": "getRoadID", "VAR_LANE_ID": "getLaneID",
    "VAR_LANE_INDEX": "getLaneIndex", "VAR_LANEPOSITION": "getLanePosition", "VAR_LANEPOSITION_LAT": "getLateralLanePosition",
    "VAR_SPEED_LAT": "getLateralSpeed", "VAR_ACCELERATION": "getAcceleration", "VAR_SIGNALS": "getSignals", "VAR_LEADER": "getLeader",
    "VAR_DISTANCE": "getDistance", "VAR_LENGTH": "getLength", "VAR_WIDTH": "getWidth", "VAR_HEIGHT": "getHeight", "VAR_TYPE": "getTypeID",
    "VAR_VEHICLECLASS": "getVehicleClass", "VAR_MINGAP": "getMinGap", "VAR_ALLOWED_SPEED": "getAllowedSpeed",
    "VAR_MAXSPEED": "getMaxSpeed", "VAR_ACCEL": "getAccel", "VAR_DECEL": "getDecel", "VAR_TAU": "getTau", "VAR_ROUTE_ID": "getRouteID",
    "VAR_WAITING_TIME": "getWaitingTime", "VAR_TIME": "getTime", "VAR_DELTA_T": "getDeltaT",
}
"""TraCI's variables for subscriptions, each with the function that returns the same value."""
CONTEXT_DOMAINS = {"CMD_GET_VEHICLE_VARIABLE": "vehicle", "CMD_GET_PERSON_VARIABLE": "person"}
DEFAULT_VARIABLES = ("VAR_ROAD_ID", "VAR_LANEPOSITION")


class Subscriptions:
    """A controller's subscriptions; each variable has the value that its function returns, as the sensors report it."""

    def __init__(self, view: TraciView) -> None:
        self._view = view
        self._subscriptions: dict[tuple[str, str], dict[int, tuple[Any, ...]]] = {}
        self._context_subscriptions: dict[tuple[str, str], tuple[str, float, dict[int, tuple[Any, ...]]]] = {}

    def call(self, domain: str, name: str, arguments: tuple[Any, ...], named: Mapping[str, Any]) -> Any:
        """Call a function of a domain that subscribes, unsubscribes or returns results."""
        if name.startswith("get"):
            results = self._context_results(domain) if "Context" in name else self._results(domain)
            key = "" if domain == "simulation" else str(next(iter((*arguments, *named.values())), ""))
            return results if name.startswith("getAll") else results.get(key, {})
        functions: dict[str, Callable[..., None]] = {
            "subscribe": self._subscribe, "subscribeLeader": self._subscribe_to_leader, "unsubscribe": self._unsubscribe,
            "subscribeContext": self._subscribe_around, "unsubscribeContext": self._unsubscribe_around}
        if name not in functions:
            raise InputError(f"traci.{domain}.{name}", "is not for a controller", "subscribe, subscribeContext, and filters in your code")
        positional = positional_arguments(domain, name, arguments, named)
        functions[name](domain, *(("", *positional) if domain == "simulation" else positional))
        return None

    def _subscribe(self, domain: str, actor: str, variables: Any = None, begin: float = 0, end: float = 0, parameters: Any = None) -> None:
        self._subscriptions[domain, actor] = _requested_variables(domain, variables, parameters)

    def _subscribe_to_leader(self, domain: str, actor: str, dist: float = 0.0, begin: float = 0, end: float = 0) -> None:
        self._subscriptions[domain, actor] = {_constant("VAR_LEADER"): (dist,)}

    def _subscribe_around(self, domain: str, actor: str, around: int, dist: float, variables: Any = None, begin: float = 0, end: float = 0,
                          parameters: Any = None) -> None:
        domains = {_constant(name): other_domain for name, other_domain in CONTEXT_DOMAINS.items()}
        if domain != "vehicle" or around not in domains:
            raise InputError(f"traci.{domain}.subscribeContext", f"around {actor!r}, domain = {around!r}",
                             f"vehicles or persons around a vehicle: {', '.join(CONTEXT_DOMAINS)}")
        self._context_subscriptions[domain, actor] = domains[around], dist, _requested_variables(domains[around], variables, parameters)

    def _unsubscribe(self, domain: str, actor: str = "") -> None:
        self._subscriptions.pop((domain, actor), None)

    def _unsubscribe_around(self, domain: str, actor: str, around: int = 0, dist: float = 0.0) -> None:
        self._context_subscriptions.pop((domain, actor), None)

    def _results(self, domain: str) -> dict[str, dict[int, Any]]:
        actors = self._view.call(domain, "getIDList", (), {}) if domain in CONTEXT_DOMAINS.values() else None
        return {actor: self._values(domain, actor, variables) for (other_domain, actor), variables in self._subscriptions.items()
                if other_domain == domain and (actors is None or actor in actors)}

    def _context_results(self, domain: str) -> dict[str, dict[str, dict[int, Any]]]:
        results = {}
        for (centre_domain, actor), (other_domain, dist, variables) in self._context_subscriptions.items():
            if centre_domain == domain and actor in self._view.call(domain, "getIDList", (), {}):
                others = self._view.call(other_domain, "getIDList", (), {})
                results[actor] = {other: self._values(other_domain, other, variables) for other in others
                              if self._distance((domain, actor), (other_domain, other)) <= dist}
        return results

    def _distance(self, *actors: tuple[str, str]) -> float:
        (x, y), (other_x, other_y) = (self._view.call(domain, "getPosition", (name,), {}) for domain, name in actors)
        return float(((x - other_x) ** 2 + (y - other_y) ** 2) ** 0.5)

    def _values(self, domain: str, actor: str, variables: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        functions = {_constant(name): function for name, function in VARIABLES.items()}
        return {variable: self._view.call(domain, functions[variable], (*((actor,) if actor else ()), *arguments), {})
                for variable, arguments in variables.items()}


def _requested_variables(domain: str, requested: Any, parameters: Any) -> dict[int, tuple[Any, ...]]:
    """The requested variables, each with the arguments of its function after the actor's id."""
    names_by_constant = {_constant(name): name for name in VARIABLES}
    default = ("VAR_TIME",) if domain == "simulation" else DEFAULT_VARIABLES
    variables = [*map(_constant, default)] if requested is None else list(requested)
    for variable in variables:
        if variable not in names_by_constant:
            raise InputError(f"traci.{domain}.subscribe", f"variable {variable!r}", f"traci.constants.{', '.join(VARIABLES)}")
    arguments = {variable: value[1:] if isinstance(value, tuple) else (value,) for variable, value in (parameters or {}).items()}
    return {variable: arguments.get(variable, ()) for variable in variables}


def _constant(name: str) -> int:
    return int(getattr(real_traci().constants, name))


_driven_vehicles: list[tuple[TraciView, Subscriptions]] = []
"""Vehicles whose controllers run at the moment, innermost last."""


@contextmanager
def bind_traci(view: TraciView, subscriptions: Subscriptions) -> Iterator[None]:
    """Context in which TraCI's functions refer to this vehicle."""
    _driven_vehicles.append((view, subscriptions))
    try:
        yield
    finally:
        _driven_vehicles.pop()


@contextmanager
def substitute_traci() -> Iterator[None]:
    """Context in which `import traci` and `import libsumo` import the substitutes for controllers."""
    real_traci()
    modules = {name: sys.modules.get(name) for name in ("traci", "libsumo")}
    sys.modules.update({name: traci_module(name) for name in modules})
    try:
        yield
    finally:
        for name, module in modules.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


@cache
def traci_module(name: str = "traci") -> ModuleType:
    """The substitute for the module traci or libsumo."""
    return _Module(engine_api(Engine(name)))


class _Module(ModuleType):
    """A substitute for traci or libsumo: constants and classes are the original ones, functions are those of the driven vehicle."""

    def __init__(self, real: ModuleType) -> None:
        super().__init__(real.__name__, real.__doc__)
        self.__path__, self.__file__, self.__spec__, self._real = real.__path__, real.__file__, real.__spec__, real

    def __getattr__(self, name: str) -> Any:
        if name in ("getConnection", "getLabel"):
            return lambda *_: self if name == "getConnection" else "default"
        if name == "TraCIException":
            return traci_exception()
        real = getattr(self._real, name)
        if hasattr(real, "subscribe") or name in ("simulation", "gui"):
            return _Domain(name, real)
        return real if isinstance(real, type | ModuleType) or not callable(real) else _make_function("", name)


class _Domain:
    """A domain of TraCI, such as `traci.vehicle`."""

    def __init__(self, name: str, real: Any) -> None:
        self._name, self._real = name, real

    def __getattr__(self, name: str) -> Any:
        member = getattr(self._real, name)
        return _make_function(self._name, name) if callable(member) and not isinstance(member, type) else member


@cache
def _make_function(domain: str, name: str) -> Callable[..., Any]:
    def function(*arguments: Any, **named: Any) -> Any:
        if not _driven_vehicles:
            full_name = f"traci.{domain}.{name}".replace("..", ".")
            refuse_own_loop(domain, name, full_name)
            raise InputError(full_name, "is called while no vehicle is driven",
                             "calls within start and step, not where a module is imported")
        view, subscriptions = _driven_vehicles[-1]
        if domain and "subscri" in name.lower():
            with view.translated_errors():
                return subscriptions.call(domain, name, arguments, named)
        return view.call(domain, name, arguments, named)

    function.__name__ = name
    return function
