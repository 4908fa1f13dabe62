"""Exports the simulation of a solution for other simulators: as OpenSCENARIO XML with OpenDRIVE, or
as a script for CARLA.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from safevar_sumo.api.simulation import simulate_with_original
from safevar_sumo.errors import EnvironmentFault, InputError, about
from safevar_sumo.output import temporary_folder
from safevar_sumo.questions.options import PointName
from safevar_sumo.records import TIME_DECIMALS, FloatArray, JsonObject, NamedValues
from safevar_sumo.replay.animation import PLAYER_FOLDER, template_environment
from safevar_sumo.replay.comparison import Comparison, comparison_of
from safevar_sumo.replay.simulate import load_target
from safevar_sumo.results import make_directory, write_whole
from safevar_sumo.scenarios import VUT
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.study import PHASE
from safevar_sumo.sumo.network import (
    NetworkFiles,
    built_network,
    program_of_sumo,
    run_program,
)
from safevar_sumo.sumo.system import assemble

ROAD = "road.xodr"
SCENARIO = "scenario.xosc"
SCRIPT = "run_in_carla.py"
VEHICLE = "vehicle.json"
BLUEPRINT = "vehicle.lincoln.mkz*2017"
"""The Lincoln MKZ of CARLA 0.9.10 (`mkz2017`) and of later versions (`mkz_2017`)."""
CARLA_PHYSICS = {
    "max_rpm": "max_rpm",
    "dampRateFullT": "damping_rate_full_throttle",
    "dampRateZeroT_CE": "damping_rate_zero_throttle_clutch_engaged",
    "dampRateZeroT_CD": "damping_rate_zero_throttle_clutch_disengaged",
    "gearSwitchTime": "gear_switch_time",
    "clutchStrength": "clutch_strength",
    "mass": "mass",
    "dragCoeff": "drag_coefficient",
}
"""Attributes of CARLA's `VehiclePhysicsControl`, by the characteristic that has the same meaning
and unit.
"""
CARLA_WHEELS = {
    "tireFric": "tire_friction",
    "dampRate": "damping_rate",
    "radius": "radius",
    "maxBrakeTorque": "max_brake_torque",
}
"""Attributes of each `WheelPhysicsControl` of CARLA, by the characteristic that has the same
meaning and unit; the radius is in cm in both.
"""
EGO = "Ego"
"""Name of the vehicle under test in OpenSCENARIO."""
WHEELBASE_SHARE = 0.58
"""Assumed wheelbase over the length of a vehicle [-]; its two overhangs are equal."""
HEIGHTS = {"pedestrian": 1.8, "bicycle": 1.7, "car": 1.5}
"""Assumed heights by kind of actor [m], because SUMO has no third dimension."""
BICYCLE_WIDTH = 1.0
"""Width below which a vehicle is a bicycle [m]."""
DROPPED_ATTRIBUTES = {
    "outline": ("id", "fillType", "outer", "closed", "laneType"),
    "cornerLocal": ("id",),
    "header": ("date",),
}
"""Attributes, by element, that are removed from netconvert's OpenDRIVE 1.4: only later versions of
OpenDRIVE have them, or (`date`) they differ between two conversions.
"""


class Poses(NamedTuple):
    """An actor at the T samples at which it is on the road. Columns have the shape (T,): time [s],
    x and y of its middle [m], and heading counter-clockwise from x [rad].
    """

    name: str
    kind: str
    length: float
    width: float
    time: FloatArray
    x: FloatArray
    y: FloatArray
    heading: FloatArray
    start_speed: float = 0.0

    @property
    def height(self) -> float:
        return HEIGHTS[self.kind]

    @property
    def to_axle(self) -> float:
        """Distance from the middle back to the point by which OpenSCENARIO places an actor [m]: the
        rear axle of a vehicle, the middle of a person (0).
        """
        if self.kind == "pedestrian":
            return 0.0
        return self.length * WHEELBASE_SHARE / 2

    def places(self, distance: float = 0.0) -> list[list[float]]:
        """For each sample the time [s], x, y [m] and heading [rad] of the point that is `distance`
        behind the middle [m].
        """
        x = self.x - distance * np.cos(self.heading)
        y = self.y - distance * np.sin(self.heading)
        places: list[list[float]] = np.column_stack(
            [self.time, x, y, self.heading]
        ).tolist()
        return places


def poses_of(comparison: Comparison) -> list[Poses]:
    """All actors in the run of the changed vehicle (of the original, if nothing is changed), until
    the end of this run. The vehicle under test comes first.
    """
    row = comparison.rows[-1]
    actors = []
    end = comparison.moments[row].end + 1

    time = np.round(comparison.runs.trace.time[:end], TIME_DECIMALS)
    for name, track in sorted(
        comparison.tracks.items(), key=lambda item: item[0] != VUT
    ):
        x = track.x[:end, row]
        y = track.y[:end, row]
        is_present = np.isfinite(x)
        if not is_present.any():
            continue
        heading = track.heading[:end, row]
        kind = "bicycle" if track.width < BICYCLE_WIDTH else "car"
        middle_distance = track.length / 2
        if track.is_person:
            kind = "pedestrian"
            middle_distance = 0.0
        x = x - middle_distance * np.cos(heading)
        y = y - middle_distance * np.sin(heading)

        samples = np.stack([time, x, y, heading])[:, is_present]
        actor = Poses(name, kind, track.length, track.width, *samples)
        if name == VUT:
            actor = actor._replace(
                name=EGO, start_speed=float(comparison.runs.trace.speed[0, row])
            )
        actors.append(actor)
    return actors


def _with_next_place(actor: Poses) -> Poses:
    """The actor with a further place, one step after its last place, which continues the last
    change of speed: a simulator that derives speeds from two places then finds the speed at the end
    of the run.
    """
    lengths = np.hypot(*np.diff([actor.x[-3:], actor.y[-3:]]))
    if len(lengths) < 2 or not lengths[1]:
        return actor
    share = max(2 - lengths[0] / lengths[1], 0.0)
    longer = dict[str, Any]()
    for name, step in {"time": 1.0, "x": share, "y": share, "heading": 0.0}.items():
        values = getattr(actor, name)
        longer[name] = np.append(values, values[-1] + step * (values[-1] - values[-2]))
    return actor._replace(**{**longer, "time": np.round(longer["time"], TIME_DECIMALS)})


def open_drive(network: NetworkFiles) -> str:
    """The network as OpenDRIVE 1.4: from the file beside a shipped network, or by netconvert.

    Raises
    ------
    EnvironmentFault
        If netconvert fails.
    InputError
        If netconvert is not installed.
    """
    if network.folder.parent == NETWORKS and not network.lane_changes:
        return network.path(ROAD).read_text(encoding="utf-8")
    return converted(network)


def converted(network: NetworkFiles) -> str:
    """The network as OpenDRIVE 1.4 by netconvert, without `DROPPED_ATTRIBUTES`. Raises the errors
    of `open_drive`.
    """
    netconvert = program_of_sumo("netconvert", f"an export of {network.folder}")
    with temporary_folder() as folder:
        exit_code, errors = run_program(
            Path(folder),
            netconvert,
            "-s",
            str(built_network(network)),
            "--opendrive-output",
            ROAD,
            "-o",
            "net.xml",
        )
        if exit_code != 0:
            raise EnvironmentFault(
                f"{network.folder}: netconvert writes no OpenDRIVE: {errors}"
            )
        root = ElementTree.parse(Path(folder) / ROAD).getroot()
    for element in root.iter():
        for name in DROPPED_ATTRIBUTES.get(element.tag, ()):
            element.attrib.pop(name, None)
    return (
        '<?xml version="1.0"'
        f' encoding="UTF-8"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'
    )


def carla_physics(setting: NamedValues) -> dict[str, NamedValues]:
    """The values of a setting by CARLA's attributes of the vehicle ("physics") and of each of its
    wheels ("wheels").

    Raises
    ------
    InputError
        If a characteristic has no attribute in CARLA, or an attribute has no characteristic.
    """
    names = {**CARLA_PHYSICS, **CARLA_WHEELS}

    if surplus := [name for name in setting if name not in names]:
        verb = "has" if len(surplus) == 1 else "have"
        raise InputError(
            "",
            f"{', '.join(surplus)} of its vehicle {verb} no counterpart in CARLA",
            f"the vehicle `carla`, with {', '.join(names)}; or `to=openscenario`",
        )
    if lacking := [name for name in names if name not in setting]:
        raise InputError(
            "",
            f"its vehicle has no {', '.join(lacking)}",
            "the vehicle `carla`, or `to=openscenario`",
        )
    physics = {attribute: setting[name] for name, attribute in CARLA_PHYSICS.items()}
    wheels = {attribute: setting[name] for name, attribute in CARLA_WHEELS.items()}
    return {"physics": physics, "wheels": wheels}


def carla_scene(
    comparison: Comparison, physics: Mapping[str, NamedValues], handle: str
) -> JsonObject:
    """The content of `vehicle.json`: physics, pedals, and places in SUMO's coordinates (x east, y
    north, headings counter-clockwise).
    """
    row = comparison.rows[-1]
    trace = comparison.runs.trace
    vut, *actors = poses_of(comparison)
    _, *start = vut.places()[0]
    samples = slice(0, comparison.moments[row].end + 1)
    commands = zip(trace.throttle[samples, row], trace.brake[samples, row], strict=True)
    pedals = [{"throttle": throttle, "brake": brake} for throttle, brake in commands]
    return {
        "solution": handle,
        "title": comparison.title,
        "verdict": comparison.verdict(row),
        "blueprint": BLUEPRINT,
        **physics,
        "step": trace.step,
        "start": dict(zip(("x", "y", "heading"), start, strict=True)),
        "start_speed": float(trace.speed[0, row]),
        "route": np.stack([vut.x, vut.y], axis=1).tolist(),
        "pedals": pedals,
        "actors": [
            {
                "name": actor.name,
                "kind": actor.kind,
                "length": actor.length,
                "places": actor.places(),
            }
            for actor in actors
        ],
    }


def export(
    directory: str,
    *,
    solution: Annotated[str, "ALG:RUN:N"],
    to: Literal["carla", "openscenario"],
    out: Path,
    point: PointName = None,
    as_it_is_now: bool = False,
) -> str:
    """Write the simulation of one solution for another simulator. CARLA gets a script and the
    values of the vehicle; OpenSCENARIO gets a scenario with an OpenDRIVE road.

    Example: python -m safevar_sumo export results/rain --solution nsga2:0:0 --to carla --out
    in_carla

    Parameters
    ----------
    solution
        Solution to export, such as nsga2:3:0. Runs and solutions are counted from 0.
    to
        Form of the files: for CARLA, or OpenSCENARIO with OpenDRIVE.
    out
        New directory for the files.
    point
        Export this test case of the study.
    as_it_is_now
        Use the present files and versions, although the results were computed with other files or
        versions. Default: an error.
    """
    if out.exists() or out.is_symlink():
        raise InputError("out", f"{out} exists", "a new directory")
    target = load_target(directory, solution, as_it_is_now, point)
    system = assemble(target.study)
    system.require("roads", "export")
    setting = target.setting(system)
    if system.characteristics.named(setting).get(PHASE):
        raise InputError(
            directory,
            f"solution {solution} has a {PHASE}, which another simulator does not have",
            "a solution of a study that does not search it",
        )
    values = system.characteristics.vehicle.named(
        setting[system.characteristics.of_vehicle]
    )
    with about(directory):
        physics = {}
        if to == "carla":
            physics = carla_physics(values)
    comparison = comparison_of(
        simulate_with_original(target.study, system, setting, filtered=False)
    )
    write_files(comparison, to, out, solution, physics)
    return f"{to}: {out}"


def write_files(
    comparison: Comparison,
    to: str,
    out: Path,
    handle: str,
    physics: Mapping[str, NamedValues],
) -> None:
    """Write the last run of a comparison into a new directory, as files for `to`: "carla" (with the
    values `physics`) or "openscenario". `handle` names the solution in these files.
    """
    files = {ROAD: open_drive(comparison.network)}
    if to == "carla":
        scene = carla_scene(comparison, physics, handle)
        files[SCRIPT] = (PLAYER_FOLDER / SCRIPT).read_text(encoding="utf-8")
        files[VEHICLE] = json.dumps(scene, indent=1, allow_nan=False) + "\n"
    else:
        ego, *actors = poses_of(comparison)
        template = template_environment().get_template(f"{SCENARIO}.j2")
        files[SCENARIO] = template.render(
            title=f"{comparison.title}, {handle}: {comparison.verdict(comparison.rows[-1])}",
            road=ROAD,
            actors=[ego, *(_with_next_place(actor) for actor in actors)],
            end=float(ego.time[-1]),
            wheelbase=WHEELBASE_SHARE,
        )
    make_directory(out)
    for name, text in files.items():
        write_whole(out / name, text)
