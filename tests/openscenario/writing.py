# ruff: noqa: E501 (lines of XML, and formulas)
"""Files of OpenSCENARIO for tests, from the parts that differ: a straight road of four lanes, Ego
and a Car.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from safevar_sumo.openscenario import Played, play

ROAD = """<OpenDRIVE><header revMajor="1" revMinor="6"/>
<road name="" length="{length}" id="1" junction="-1"><planView>{geometry}</planView><lanes><laneSection s="0">
<left><lane id="2" type="driving"><width sOffset="0" a="4" b="0" c="0" d="0"/></lane>
<lane id="1" type="driving"><width sOffset="0" a="4" b="0" c="0" d="0"/></lane></left><center><lane id="0" type="none"/></center>
<right><lane id="-1" type="driving"><width sOffset="0" a="4" b="0" c="0" d="0"/></lane>
<lane id="-2" type="driving"><width sOffset="0" a="4" b="0" c="0" d="0"/></lane></right></laneSection></lanes></road></OpenDRIVE>"""
STRAIGHT = '<geometry s="0" x="10" y="20" hdg="0" length="2000"><line/></geometry>'
BOX = '<BoundingBox><Center x="{ahead}" y="0" z="0.7"/><Dimensions width="{width}" length="{length}" height="1.5"/></BoundingBox>'
FILE = """<?xml version="1.0"?>{prolog}
<OpenSCENARIO><FileHeader revMajor="{version}" revMinor="{minor}"/><ParameterDeclarations>{parameters}</ParameterDeclarations>
<CatalogLocations>{catalogs}</CatalogLocations><RoadNetwork><LogicFile filepath="{road}"/></RoadNetwork>
<Entities>{entities}</Entities><Storyboard><Init><Actions>{init}</Actions></Init>
<Story name="Story"><Act name="Act">{events}{act_trigger}</Act></Story><StopTrigger>{stop}</StopTrigger></Storyboard></OpenSCENARIO>"""
AT_ONCE = "<SimulationTimeCondition rule='greaterOrEqual' value='{}'/>"


def body(name: str, length: float = 4.0, width: float = 2.0) -> str:
    box = BOX.format(length=length, width=width, ahead=1.5)
    return f'<ScenarioObject name="{name}"><Vehicle name="" vehicleCategory="car">{box}</Vehicle></ScenarioObject>'


def person(name: str, length: float, width: float) -> str:
    box = BOX.format(length=length, width=width, ahead=0)
    return f'<ScenarioObject name="{name}"><Pedestrian name="">{box}</Pedestrian></ScenarioObject>'


def at(lane: int, s: float, offset: float = 0.0, inner: str = "") -> str:
    return (
        f'<LanePosition roadId="1" laneId="{lane}" s="{s}" offset="{offset}">{inner}</LanePosition>'
    )


def world(x: float, y: float, h: float = 0.0) -> str:
    return f'<WorldPosition x="{x}" y="{y}" h="{h}"/>'


def teleport(position: str) -> str:
    return f"<TeleportAction><Position>{position}</Position></TeleportAction>"


def dynamics(shape: str, dimension: str, value: float, name: str) -> str:
    return f'<{name} dynamicsShape="{shape}" dynamicsDimension="{dimension}" value="{value}"/>'


def speed(value: object, shape: str = "step", dimension: str = "time", amount: float = 0.0) -> str:
    how = dynamics(shape, dimension, amount, "SpeedActionDynamics")
    target = f'<SpeedActionTarget><AbsoluteTargetSpeed value="{value}"/></SpeedActionTarget>'
    return f"<LongitudinalAction><SpeedAction>{how}{target}</SpeedAction></LongitudinalAction>"


def lane_change(
    lane: int, shape: str, dimension: str, amount: float, kind: str = "AbsoluteTargetLane"
) -> str:
    how = dynamics(shape, dimension, amount, "LaneChangeActionDynamics")
    target = f'<LaneChangeTarget><{kind} value="{lane}"/></LaneChangeTarget>'
    return f"<LateralAction><LaneChangeAction>{how}{target}</LaneChangeAction></LateralAction>"


def private(name: str, *actions: str) -> str:
    inner = "".join(f"<PrivateAction>{action}</PrivateAction>" for action in actions)
    return f'<Private entityRef="{name}">{inner}</Private>'


def trigger(
    condition: str, name: str = "StartTrigger", edge: str = "none", delay: float = 0.0
) -> str:
    kind = "ByEntityCondition" if "TriggeringEntities" in condition else "ByValueCondition"
    inner = f'<Condition name="" delay="{delay}" conditionEdge="{edge}"><{kind}>{condition}</{kind}></Condition>'
    group = f"<ConditionGroup>{inner}</ConditionGroup>"
    return f"<{name}>{group}</{name}>" if name else group


def watching(name: str, condition: str) -> str:
    entities = f'<TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="{name}"/></TriggeringEntities>'
    return f"{entities}<EntityCondition>{condition}</EntityCondition>"


def event(
    action: str, when: str = AT_ONCE.format(0), name: str = "Event", priority: str = "override"
) -> str:
    start = when if when.startswith("<StartTrigger") else trigger(when)
    content = f'<Action name="{name} action"><PrivateAction>{action}</PrivateAction></Action>'
    return f'<Event name="{name}" priority="{priority}">{content}{start}</Event>'


def group(*events: str, actor: str = "Car") -> str:
    actors = f'<Actors selectTriggeringEntities="false"><EntityRef entityRef="{actor}"/></Actors>'
    maneuver = f'<Maneuver name="Maneuver of {actor}">{"".join(events)}</Maneuver>'
    return f'<ManeuverGroup name="Group of {actor}" maximumExecutionCount="1">{actors}{maneuver}</ManeuverGroup>'


PARAMETER = '<ParameterDeclaration name="v" parameterType="double" value="3"/>'
LOGICAL = """<OpenSCENARIO><FileHeader revMajor="1" revMinor="2"/><ParameterValueDistribution><ScenarioFile filepath="scenario.xosc"/>
<Deterministic><DeterministicSingleParameterDistribution parameterName="v"><DistributionSet>{}</DistributionSet></DeterministicSingleParameterDistribution></Deterministic></ParameterValueDistribution></OpenSCENARIO>"""


def logical(folder: Path, *values: float) -> str:
    """The path of a file with values of the parameter v of the scenario that has been written
    there.
    """
    path = folder / "values.xosc"
    path.write_text(LOGICAL.format("".join(f'<Element value="{value}"/>' for value in values)))
    return str(path)


EGO = private("Ego", teleport(at(-1, 50)), speed(20))


def write(
    folder: Path,
    *events: str,
    car: tuple[str, ...] = (teleport(at(-2, 100)), speed(10)),
    ego: str = EGO,
    geometry: str = STRAIGHT,
    length: float = 2000.0,
    groups: str = "",
    **parts: str,
) -> str:
    """The path of a file in which a Car has these events."""
    (folder / "road.xodr").write_text(ROAD.format(length=length, geometry=geometry))
    found = {
        "prolog": "",
        "version": "1",
        "minor": "2",
        "parameters": "",
        "catalogs": "",
        "road": "road.xodr",
        "entities": body("Ego") + body("Car", 5.0),
        "init": ego + private("Car", *car),
        "events": groups or group(*events) if events or groups else "",
        "act_trigger": trigger(AT_ONCE.format(0)),
        "stop": trigger(AT_ONCE.format(10), ""),
        **parts,
    }
    path = folder / "scenario.xosc"
    path.write_text(FILE.format(**found))
    return str(path)


def staged(folder: Path, *events: str, **parts: Any) -> Played:
    """The scene of a file in which a Car has these events."""
    return play(write(folder, *events, **parts), {})
