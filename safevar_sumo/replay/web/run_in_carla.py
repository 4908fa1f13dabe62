"""Repeat a simulation in CARLA: python run_in_carla.py [--host HOST] [--port PORT] [--agent
MODULE:CLASS].

Needs a running CARLA server and its Python client. The road comes from `road.xodr`, everything else
from `vehicle.json`, both beside this script. The vehicle gets the recorded throttle and brake, or
those of your agent: `CLASS(vehicle)` with a method `run_step()` that returns a
`carla.VehicleControl`, as CARLA's own agents have. CARLA's y and yaw have the opposite sign of the
file's.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
from pathlib import Path
from typing import Any

import carla

Scene = dict[str, Any]
FOLDER = Path(__file__).resolve().parent
RIDE_HEIGHT = 0.3
"""Height at which actors are placed, above the road [m]."""
SETTLING = 20
"""Steps in which vehicles come to rest on their wheels before the start."""


def apply_values(physics: Any, scene: Scene) -> Any:
    """Set the values that the study varies, of the vehicle and of its wheels; all others stay
    CARLA's.
    """
    for name, value in scene["physics"].items():
        setattr(physics, name, value)
    wheels = list(physics.wheels)
    for wheel in wheels:
        for name, value in scene["wheels"].items():
            setattr(wheel, name, value)
    physics.wheels = wheels
    return physics


def place(x: float, y: float, heading: float, z: float = RIDE_HEIGHT) -> Any:
    """A place of the file in CARLA's left-handed frame."""
    return carla.Transform(
        carla.Location(x=x, y=-y, z=z), carla.Rotation(yaw=-math.degrees(heading))
    )


def place_at(actor: Scene, step: int) -> Any:
    """The recorded place of an actor at a step; the last one after the record's end."""
    _, x, y, heading = actor["places"][min(step, len(actor["places"]) - 1)]
    return place(x, y, heading, 1.0 if actor["kind"] == "pedestrian" else RIDE_HEIGHT)


def pedals(scene: Scene, step: int) -> Any:
    """The recorded pedals of a step; the last ones after the record's end."""
    return carla.VehicleControl(**scene["pedals"][min(step, len(scene["pedals"]) - 1)])


def walk(places: list[list[float]], step: int, seconds: float, location: Any) -> Any:
    """The walker's control that leads it from its location to its next recorded place."""
    _, x, y, _ = places[min(step + 1, len(places) - 1)]
    direction = carla.Vector3D(x=x - location.x, y=-y - location.y, z=0.0)
    distance = math.hypot(direction.x, direction.y)
    if distance > 0:
        direction = carla.Vector3D(
            x=direction.x / distance, y=direction.y / distance, z=0.0
        )
    return carla.WalkerControl(direction=direction, speed=distance / seconds)


def spawn(world: Any, scene: Scene) -> tuple[Any, list[tuple[Scene, Any]]]:
    """Spawn the vehicle with its values, and the other actors, each with its record."""
    library = world.get_blueprint_library()
    vehicle = world.spawn_actor(
        library.filter(scene["blueprint"])[0], place(**scene["start"])
    )
    vehicle.apply_physics_control(apply_values(vehicle.get_physics_control(), scene))
    patterns = {
        "pedestrian": "walker.pedestrian.*",
        "bicycle": "vehicle.*.crossbike",
        "car": scene["blueprint"],
    }
    actors = []
    for actor in scene["actors"]:
        body = world.spawn_actor(
            library.filter(patterns[actor["kind"]])[0], place_at(actor, 0)
        )
        body.set_simulate_physics(False)
        actors.append((actor, body))
    return vehicle, actors


def play(world: Any, scene: Scene, agent_class: Any) -> float | None:
    """Play the scene; returns the speed of the first collision [m/s], None without one."""
    vehicle, actors = spawn(world, scene)
    sensor = world.spawn_actor(
        world.get_blueprint_library().find("sensor.other.collision"),
        carla.Transform(),
        attach_to=vehicle,
    )
    touched = []
    speed = 0.0
    for _ in range(SETTLING):
        vehicle.apply_control(carla.VehicleControl(brake=1.0))
        world.tick()
    sensor.listen(lambda event: touched.append(event.other_actor.type_id))
    heading = scene["start"]["heading"]
    forward = carla.Vector3D(x=math.cos(heading), y=-math.sin(heading), z=0.0)
    vehicle.set_target_velocity(forward * scene["start_speed"])
    agent = agent_class(vehicle) if agent_class else None
    try:
        for step in range(len(scene["pedals"])):
            vehicle.apply_control(agent.run_step() if agent else pedals(scene, step))
            for actor, body in actors:
                # A pedestrian moves its legs; the record places it.
                if actor["kind"] == "pedestrian":
                    body.apply_control(
                        walk(actor["places"], step, scene["step"], body.get_location())
                    )
                body.set_transform(place_at(actor, step))
            speed_before = speed
            speed = math.hypot(vehicle.get_velocity().x, vehicle.get_velocity().y)
            world.tick()
            if touched:
                return max(speed_before, speed)
        return None
    finally:
        sensor.destroy()
        for actor in (vehicle, *(body for _, body in actors)):
            actor.destroy()


def main() -> None:
    parser = argparse.ArgumentParser(description="Repeat a simulation in CARLA.")
    parser.add_argument("--host", default="localhost")
    parser.add_argument("--port", type=int, default=2000)
    parser.add_argument(
        "--agent",
        metavar="MODULE:CLASS",
        help="drive with this agent in place of the recorded pedals",
    )
    options = parser.parse_args()
    agent_class = None
    if options.agent:
        module, _, name = options.agent.partition(":")
        agent_class = getattr(importlib.import_module(module), name)
    scene = json.loads((FOLDER / "vehicle.json").read_text(encoding="utf-8"))
    client = carla.Client(options.host, options.port)
    client.set_timeout(60.0)
    world = client.generate_opendrive_world(
        (FOLDER / "road.xodr").read_text(encoding="utf-8")
    )
    settings = world.get_settings()
    settings.synchronous_mode = True
    settings.fixed_delta_seconds = scene["step"]
    world.apply_settings(settings)
    try:
        speed = play(world, scene, agent_class)
    finally:
        settings.synchronous_mode = False
        settings.fixed_delta_seconds = None
        world.apply_settings(settings)
    print(f"safevar_sumo: {scene['verdict']}")
    print(
        "CARLA: "
        + (f"collides at {speed:.1f} m/s" if speed is not None else "no collision")
    )


if __name__ == "__main__":
    main()
