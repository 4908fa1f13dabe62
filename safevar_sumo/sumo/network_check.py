"""Checks of a user's network: SUMO must load it. Further checks refuse networks and traffic that
SUMO accepts, but that studies cannot use.
"""

from __future__ import annotations

import re
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterable
from functools import lru_cache, partial
from itertools import product
from pathlib import Path

import numpy as np

from safevar_sumo.errors import (
    EnvironmentFault,
    InputError,
    SimulationError,
    about,
    subject,
)
from safevar_sumo.scenarios import VUT
from safevar_sumo.scenarios.roads import NETWORK_KEY
from safevar_sumo.sumo.copies import ensure_cached, parse_seconds, parse_xml
from safevar_sumo.sumo.engine import STEP_LENGTH, as_arguments, open_world, own_options
from safevar_sumo.sumo.network import (
    OPTIONS_FILE,
    TRAFFIC_FILE,
    NetworkFiles,
    built_network,
    cache_folder_name,
    copied_network,
    is_shipped,
    open_network,
    options_in,
    run_program,
)

SHORTEST_STEP = 0.001
"""SUMO's shortest time step [s]."""
LONGEST_REACTION_STEP = 1.0
"""Longest time step in which a vehicle can still react in time [s]."""
MAX_SLOPE = 0.005
"""Largest difference in height over the length of a lane that counts as level [-]."""
N_STEPS = 600
"""Number of steps in which the traffic of two copies is compared."""
WARNINGS_FILE = "warnings.txt"
LOAD = """
import sys, libsumo
try:
    libsumo.start(["sumo", *sys.argv[1:]])
    libsumo.simulationStep(1.0)
    libsumo.close()
except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
    sys.exit(f"Error: {error}")
"""
"""A program that loads a network in SUMO and simulates its first second."""
DRIVER_ATTRIBUTES = re.compile(
    "carFollowModel|speedFactor|speedDev|sigma.*|desiredMaxSpeed|impatience|laneChangeModel|lc[A-Z].*|jm[A-Z].*"
    "|actionStepLength|startupDelay|delta|stepping|minGapLat|maxSpeedLat|latAlignment"
)
"""Attributes of a vehicle or its type that only SUMO's own driver uses."""
SETTING_ATTRIBUTES = (
    "mass",
    "accel",
    "decel",
    "emergencyDecel",
    "apparentDecel",
    "maxSpeed",
    "tau",
)
"""Attributes of the type of the vehicle under test that the simulation replaces by values of a
setting.
"""
TYPE_KEYS = re.compile(
    rf"(carFollowModel|laneChangeModel|junctionModel)\..*|{DRIVER_ATTRIBUTES.pattern}"
    rf"|{'|'.join(SETTING_ATTRIBUTES)}|vehicleMass|minGap|length|width|height|vClass|guiShape"
)
"""Keys of a `param` that mean an attribute of a type."""
ACTING_ATTRIBUTES = (
    "carFollowModel",
    "tau",
    "decel",
    "emergencyDecel",
    "minGap",
    "speedFactor",
    "desiredMaxSpeed",
    "actionStepLength",
    "delta",
    "stepping",
)
"""Attributes that act on SUMO's driver under a controller written for TraCI. `sigma` is none of
them, because this driver never dawdles.
"""
NO_EFFECT = {"sigma": "0", "speedDev": "0", "speedFactor": "1"}
"""Values that attributes of SUMO's own driver would have anyway: no remark mentions them."""
EXACT_MODELS = ("Krauss", "KraussOrig1", "IDM", "ACC", "CACC")
"""Car-following models with which SUMO's driver under a controller drives exactly as in SUMO."""
SIGMA_MODELS = ("Krauss", "KraussOrig1", "KraussPS")
"""Car-following models that are random unless sigma is 0."""
DETERMINISTIC_MODELS = ("IDM", "IDMM", "ACC", "CACC")
"""Car-following models that are never random."""
DEFAULT_OPTIONS = {"step-method.ballistic": "false"}
"""SUMO's default of an option that every study overrules, and that changes how all actors move."""
SWITCHED_OFF = "-1"
"""A value that switches a waiting time off; every value up to 0 does."""
TRUE_VALUES = ("1", "yes", "true", "on", "x", "t")
"""Words that mean true in SUMO's options."""
LEGAL_OPTIONS = (
    f"a step-length from {SHORTEST_STEP:g} to {LONGEST_REACTION_STEP:g} [s], no remote-port, all"
    f" traffic in {TRAFFIC_FILE}: safevar_sumo starts SUMO itself"
)
LEGAL_VUT = (
    f"type {VUT!r}, a vType of its own, which each setting changes; depart 0; no stops: its ADS"
    " drives it"
)
LEGAL_ROAD = (
    "a level road of friction 1: the scenario's `grade` sets a slope, the weather's `road_friction`"
    " a friction"
)


def check_network(name: str) -> None:
    """Refuse a network that cannot be simulated correctly.

    Raises
    ------
    InputError
        The error names the file, the illegal value and the legal values.
    EnvironmentFault
        If netconvert fails for reasons outside the network.
    """
    with about(f"{subject()}: {NETWORK_KEY}"):
        network = open_network(name)
    if not is_shipped(name):
        _check_files(network)


def network_remarks(name: str, acting: Collection[str] = ()) -> list[str]:
    """Remarks on attributes of a user's traffic and on options that have no effect, and SUMO's
    warnings; none on shipped networks.

    `acting` are the attributes of SUMO's own driver that have an effect, because this driver drives
    under a controller written for TraCI.
    """
    if is_shipped(name):
        return []

    network = open_network(name)
    file = network.path(TRAFFIC_FILE)
    unused_attributes = dict[str, None]()
    for element in parse_xml(file).findall(f"*[@id='{VUT}']"):
        for attribute, value in element.items():
            is_replaced = (
                attribute in SETTING_ATTRIBUTES
                or DRIVER_ATTRIBUTES.fullmatch(attribute)
            )
            if (
                is_replaced
                and attribute not in acting
                and value != NO_EFFECT.get(attribute)
            ):
                unused_attributes[f"{attribute} = {value}"] = None
    remarks = []
    if unused_attributes:
        unused = f"{file}: no effect on vehicle {VUT!r}: {', '.join(unused_attributes)}"
        remarks.append(f"{unused}; the study's vehicle and ADS determine how it drives")

    # With a controller, SUMO's driver follows leaders by a car-following model.
    vtype = parse_xml(file).find(f"vType[@id='{VUT}']")
    model = "" if vtype is None else vtype.get("carFollowModel", "")
    if acting and model not in ("", *EXACT_MODELS):
        remarks.append(
            f"{file}: carFollowModel = {model}: SUMO's driver uses its speed behind a leader alone"
        )

    options_file = network.path(OPTIONS_FILE)
    options = DEFAULT_OPTIONS | options_in(options_file)
    if "step-length" not in options:
        remarks.append(
            f"{options_file} has no step-length: {STEP_LENGTH:g} s unless the study has"
            " `step_length` (SUMO: 1 s)"
        )
    overruled = [
        f"{option} = {options[option]} ({value or 'none'} counts)"
        for option, value in own_options(options).items()
        if option in options and not _is_same(options[option], value)
    ]
    if overruled:
        reason = (
            "how vehicles move, what a collision is, and that nobody is teleported and nothing"
            " written"
        )
        remarks.append(
            f"{options_file}: no effect: {', '.join(overruled)}: {reason}, is the same in every"
            " study"
        )

    if warnings := _warnings_file(network).read_text(encoding="utf-8"):
        remarks.append(f"{network.folder}: {warnings}")
    return remarks


def _is_same(stated: str, value: str) -> bool:
    """Whether two values of an option of SUMO mean the same."""
    number = parse_seconds(stated)
    if value in ("true", "false"):
        return (stated.lower() in TRUE_VALUES) == (value == "true")
    if number is None:
        return stated == value
    if value == SWITCHED_OFF:
        return number <= 0
    return number == parse_seconds(value)


@lru_cache(maxsize=100)
def _check_files(network: NetworkFiles) -> None:
    """Check the options, the vehicle under test, its roads and the traffic, and let SUMO load the
    network.
    """
    # With the option remote-port SUMO would wait for a client for ever.
    options = {
        "step-length": str(STEP_LENGTH),
        "route-files": TRAFFIC_FILE,
        **options_in(network.path(OPTIONS_FILE)),
    }
    is_legal_step = (
        SHORTEST_STEP
        <= (parse_seconds(options["step-length"]) or 0.0)
        <= LONGEST_REACTION_STEP
    )
    if (
        "remote-port" in options
        or not is_legal_step
        or options["route-files"] != TRAFFIC_FILE
    ):
        option_texts = ", ".join(
            f"{name} = {options[name]!r}"
            for name in ("remote-port", "step-length", "route-files")
            if name in options
        )
        raise InputError(network.path(OPTIONS_FILE), option_texts, LEGAL_OPTIONS)

    # A setting changes the type of the vehicle under test: no other vehicle may have this type.
    file = network.path(TRAFFIC_FILE)
    traffic = parse_xml(file)
    vut = next(
        (
            actor
            for actor in traffic
            if actor.tag in ("vehicle", "trip") and actor.get("id") == VUT
        ),
        None,
    )
    if vut is None:
        raise InputError(
            file,
            f"has no vehicle {VUT!r}",
            f'<vehicle id="{VUT}" type="{VUT}" depart="0" ...>',
        )
    routes = (
        vut,
        *vut.findall("route"),
        *traffic.findall(f"route[@id='{vut.get('route')}']"),
    )
    type_name = vut.get("type")
    depart = vut.get("depart", "")
    n_others = sum(actor is not vut and actor.get("type") == VUT for actor in traffic)
    has_stop = any(route.find("stop") is not None for route in routes)
    if type_name != VUT or n_others or parse_seconds(depart) != 0 or has_stop:
        problem = (
            f"vehicle {VUT!r}: type = {type_name!r} (of {n_others} others), depart ="
            f" {depart!r}"
        )
        raise InputError(
            file, f"{problem}, has {'a stop' if has_stop else 'no stop'}", LEGAL_VUT
        )
    _check_lanes(file, routes, parse_xml(built_network(network)))
    _refuse_params(file, traffic)
    _refuse_random_types(file, traffic)
    _warnings_file(network)


def _check_lanes(
    file: Path, routes: Iterable[ElementTree.Element], roads: ElementTree.Element
) -> None:
    """Refuse a road on the routes of the vehicle under test that is not level, or has another
    friction than 1.
    """
    names = set()
    for route, name in product(routes, ("edges", "from", "via", "to")):
        names |= {*route.get(name, "").split()}
    lanes = list[ElementTree.Element]()
    for edge in roads.iter("edge"):
        if edge.get("id") in names:
            lanes += edge.iter("lane")
    for lane in lanes:
        heights = []
        for point in lane.get("shape", "").split():
            # A point is x,y or x,y,z.
            _, _, z, *_ = f"{point},0".split(",")
            heights.append(float(z))
        climb = max(heights, default=0.0) - min(heights, default=0.0)
        friction = float(lane.get("friction", 1))
        problem = (
            f"drives on lane {lane.get('id')!r}, which rises {climb:.2f} m and has friction"
            f" {friction:g}"
        )
        if climb > MAX_SLOPE * float(lane.get("length", 0)) or friction != 1:
            raise InputError(file, f"vehicle {VUT!r} {problem}", LEGAL_ROAD)


def _refuse_params(file: Path, traffic: ElementTree.Element) -> None:
    """Refuse a `param` that means an attribute of a type. SUMO ignores most of these params and
    prefers others to the attribute, and the checks read attributes alone.
    """
    for owner in traffic.iter():
        for param in owner.findall("param"):
            key = param.get("key", "")
            if TYPE_KEYS.fullmatch(key):
                name = key.rpartition(".")[2]
                raise InputError(
                    file,
                    f"{owner.tag} {owner.get('id')!r}: param {key} = {param.get('value')!r}",
                    f"the attribute {name} of a vType, in place of this param",
                )


def _refuse_random_types(file: Path, traffic: ElementTree.Element) -> None:
    """Refuse types whose drivers are random. Comparing two copies of the traffic does not suffice:
    drivers who react to the vehicle under test may show their randomness only in later encounters.
    """
    actors = [actor for actor in traffic if actor.tag in ("vehicle", "trip", "flow")]
    names = {actor.get("type") for actor in actors} - {VUT}
    for vtype in traffic.findall("vType"):
        if vtype.get("id") not in names:
            continue
        model = vtype.get("carFollowModel", "Krauss")
        speed_dev = vtype.get("speedDev", "0.1")
        sigma = vtype.get("sigma", "0.5") if model in SIGMA_MODELS else "0"
        problem = (
            f"vType {vtype.get('id')!r} drives at random: speedDev = {speed_dev}, sigma = {sigma},"
            f" {model}"
        )
        if (
            float(speed_dev)
            or float(sigma)
            or model not in (*SIGMA_MODELS, *DETERMINISTIC_MODELS)
        ):
            raise InputError(
                file,
                problem,
                f'speedDev="0"; sigma="0" or carFollowModel {", ".join(DETERMINISTIC_MODELS)}',
            )


def _warnings_file(network: NetworkFiles) -> Path:
    """The file in the cache with SUMO's warnings about a network. SUMO loads the network if there
    is no such file yet. Raises the errors of `check_network`.
    """
    folder = cache_folder_name(network, 0, [digest for _, digest in network.digests])
    return ensure_cached(
        f"tried-{folder}", WARNINGS_FILE, partial(_try_network, network)
    )


def _try_network(network: NetworkFiles, into: Path) -> None:
    """Load a network in a separate process, because some networks crash SUMO. Then compare the
    traffic of two copies, and write SUMO's warnings into the folder `into`.
    """
    legal = "options and traffic that SUMO loads without an error"
    options = {
        "configuration-file": OPTIONS_FILE,
        "net-file": str(built_network(network).absolute()),
        "route-files": TRAFFIC_FILE,
        "begin": "0",
        "no-step-log": "true",
        **own_options(options_in(network.path(OPTIONS_FILE))),
    }
    command = (sys.executable, "-P", "-c", LOAD, *as_arguments(options))
    exit_code, messages = run_program(network.folder, *command)
    if exit_code != 0:
        raise InputError(
            network.folder,
            f"SUMO refuses the network, {OPTIONS_FILE} or {TRAFFIC_FILE}:"
            f" {messages or f'exit code {exit_code}'}",
            legal,
        )

    # Random traffic moves in another way in each copy.
    try:
        actor, time = _first_difference(network)
    except (SimulationError, EnvironmentFault) as error:
        raise InputError(
            network.folder, f"SUMO refuses copies of the network: {error}", legal
        ) from None
    if actor:
        raise InputError(
            network.path(TRAFFIC_FILE),
            f"{actor!r} moves at random: two copies of it differ at {time:g} s",
            'traffic without random numbers: vTypes with speedDev="0" and sigma="0", no'
            " probabilities and distributions, and pedestrian.striping.dawdling 0 in"
            f" {OPTIONS_FILE}",
        )
    (into / WARNINGS_FILE).write_text(messages, encoding="utf-8")


def _first_difference(network: NetworkFiles) -> tuple[str, float]:
    """The first actor whose motion differs between two copies of the traffic, and the time [s]; ""
    and 0 if there is no such actor in `N_STEPS` steps.

    In both copies the vehicle under test stays at its start.
    """
    with open_world(copied_network(network, 2), 2) as world:
        world.enter(None)
        for step in range(1, N_STEPS + 1):
            world.step(np.zeros(2), np.ones(2, bool))
            poses = world.actor_poses()
            for name in sorted({id_.partition(".")[2] for id_ in poses}):
                if poses.get(f"0.{name}") != poses.get(f"1.{name}"):
                    return name, step * world.step_length
    return "", 0.0
