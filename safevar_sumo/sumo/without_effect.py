"""Remarks for the user on parts of networks and weathers that are not used or have no effect."""

from __future__ import annotations

import numpy as np

from safevar_sumo.scenarios import equals_clear
from safevar_sumo.sumo.network_check import ACTING_ATTRIBUTES, network_remarks
from safevar_sumo.sumo.simulated_study import noise_remarks
from safevar_sumo.sumo.system import System
from safevar_sumo.sumo.traci_controller import TraciController
from safevar_sumo.vehicles import prepared_original

UNKNOWN_TO_DRIVER = (
    "SUMO's driver plans with the deceleration and the smallest gap of the traffic file. This"
    " driver knows neither the delays nor the brakes of the vehicle, and may therefore collide"
)
"""Remark on a controller written for TraCI."""
DECEL = "decel"
"""Name of the characteristic that is the largest deceleration by the brakes [m/s^2]."""
NEARLY = 0.999
"""Share of the domain's upper end at which the largest deceleration is compared with that at the
end: it is the same if the tyres limit it, and lower if only the brakes do.
"""


def without_effect(system: System) -> list[str]:
    """Remarks for the user on parts of networks and weathers that are not used or have no
    effect.
    """
    if not system.mover.has("a driving system"):
        return noise_remarks(system.characteristics, system.points)
    uses_traci = isinstance(system.ads, TraciController)
    acting = set()
    if uses_traci:
        acting |= {*ACTING_ATTRIBUTES}
        if _has_tau(system):
            acting.remove("tau")
    remarks = []
    for network in system.networks:
        remarks += network_remarks(network, acting)
    remarks += system.vehicle.remarks
    remarks += _remarks_on_driver(system)
    remarks += _remarks_on_grip(system)
    weathers = {point.weather.name: point.weather for point in system.points}
    for weather in weathers.values():
        if weather.visibility != 1 and uses_traci and not _has_limited_range(system):
            remarks.append(
                f"weather {weather.name!r}: visibility = {weather.visibility:g} has no effect:"
                " the vehicle has no sensor range, so a controller written for TraCI sees"
                " everything"
            )
        if equals_clear(weather) and not (
            system.ads.recognition_delay or system.ads.hesitation
        ):
            remarks.append(
                f"weather {weather.name!r} has no effect: its road and its visibility are those"
                " of clear weather, and no key of [ads.parameters] delays the ADS in it"
            )
    return remarks


def _has_tau(system: System) -> bool:
    prepared = prepared_original(system.vehicle, system.characteristics.vehicle)
    return system.vehicle.sumo_type(prepared).tau is not None


def _remarks_on_driver(system: System) -> list[str]:
    """Remarks on the headway `tau` and on what SUMO's driver does not know."""
    if isinstance(system.ads, TraciController):
        return [UNKNOWN_TO_DRIVER]
    if not _has_tau(system):
        return []
    # The vehicle's tau replaces the headway of an ADS that has such a parameter.
    name = system.ads.tau_parameter
    if not name:
        return [
            "tau has no effect: it is the headway of SUMO's driver, and the study has another ADS"
        ]
    if getattr(system.ads, name) == getattr(type(system.ads)(), name):
        return []
    return [f"ads.parameters.{name} has no effect: the vehicle's tau takes its place"]


def _remarks_on_grip(system: System) -> list[str]:
    """A remark on values of `decel` above what the tyres of the original vehicle carry."""
    members = system.characteristics.vehicle
    if DECEL not in members.names:
        return []

    # If the deceleration still rises at the end of the domain, the brakes limit it, not the tyres.
    upper = members.upper[members.names.index(DECEL)]
    friction = max(point.weather.road_friction for point in system.points)
    nearly, highest = (
        system.vehicle.sumo_type(
            prepared_original(
                system.vehicle, members, friction, decel=np.array([value])
            )
        ).decel[0]
        for value in (NEARLY * upper, upper)
    )
    if highest > nearly:
        return []
    return [
        f"the tyres of the original vehicle carry at most {highest:.2f} m/s^2: a {DECEL} above"
        " that acts on lighter braking alone, and a fully pressed pedal brakes no harder"
    ]


def _has_limited_range(system: System) -> bool:
    prepared = prepared_original(system.vehicle, system.characteristics.vehicle)
    sensors = system.vehicle.sensors(prepared)
    return sensors is not None and bool(np.isfinite(sensors.reach).all())
