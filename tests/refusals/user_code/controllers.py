"""Controllers of a user, in SUMO's own language, that do more than drive their vehicle."""

from contextlib import suppress


def make_a_step_without_an_error(traci, v):
    with suppress(Exception):
        traci.simulationStep()


def drive_another_vehicle(traci, v):
    traci.vehicle.setSpeed("parked_ahead", 3)


def drive_at_an_undefined_speed(traci, v):
    traci.vehicle.setSpeed(v, speed=float("nan"))


def set_half_a_mode(traci, v):
    traci.vehicle.setSpeedMode(v, 1.5)


def look_at_neighbours(traci, v):
    traci.vehicle.getNeighbors(v, 1)


def look_at_the_route_of_another_vehicle(traci, v):
    traci.vehicle.getRoute("parked_ahead")


def jump(traci, v):
    traci.vehicle.moveTo(v, "road_0", 50)


def become_another_vehicle(traci, v):
    traci.vehicle.setType(v, "parked")


def change_lanes(traci, v):
    traci.vehicle.setLaneChangeMode(v, 1621)


def drive_at_random(traci, v):
    traci.vehicle.setImperfection(v, 0.5)


def make_a_step(traci, v):
    traci.simulationStep()


def start_sumo(traci, v):
    traci.start(["sumo", "-c", "scenario.sumocfg"])


def has_no_vehicle(): ...
