"""Code of a user, which tests write beside a study: driving systems, and controllers that were
written for TraCI.
"""

from __future__ import annotations

from collections.abc import Callable

from safevar_sumo.sumo.system import System
from tests.support.in_process import write
from tests.support.made_up import system_of

Mine = Callable[..., System]
SCALAR = "from safevar_sumo.ads import ScalarAds\n\n\nclass Mine(ScalarAds):\n"
ADS = '[ads]\nmodel = "mine:Mine"\n'
"""The beginning of a module, and the table of a study that names its class."""
SCRIPT = """
def step(traci, vehicle_id):
    traci.vehicle.setSpeedMode(vehicle_id, 0)
    speed = traci.vehicle.getSpeed(vehicle_id)
    leader = traci.vehicle.getLeader(vehicle_id, 100)
    decel = traci.vehicle.getDecel(vehicle_id)
    needed = 3 + speed * 0.5 + speed ** 2 / (2 * 0.6 * decel)
    if leader and leader[0] == "parked_ahead" and leader[1] < needed:
        traci.vehicle.slowDown(vehicle_id, 0, max(speed / (0.6 * decel), 0.1))
    else:
        traci.vehicle.setSpeed(vehicle_id, 12)


def idle(traci, vehicle_id):
    everybody = {"parked_ahead", "parked_beside", vehicle_id}
    assert traci.vehicle.getIDList() and set(traci.vehicle.getIDList()) == everybody
    assert traci.simulation.getTime() < 17


def jumps(traci, vehicle_id):
    traci.vehicle.moveTo(vehicle_id, "road_0", 50)


class Harsh:
    def start(self, traci, vehicle_id):
        traci.vehicle.setSpeedMode(vehicle_id, 32)

    def step(self, traci, vehicle_id):
        time = traci.simulation.getTime()
        traci.vehicle.setAcceleration(vehicle_id, 2.0 if time < 3 else -100.0, 0.1)
"""


def controlled_by(name: str, script: str = SCRIPT, **tables: object) -> System:
    write("my_controller.py", script)
    ads = {"model": f"my_controller:{name}", "kind": "traci", "parameters": {}}
    return system_of("native", ads=ads, **tables)
