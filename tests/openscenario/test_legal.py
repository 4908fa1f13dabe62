# ruff: noqa: E501 (lines of XML)
"""Words that an enumeration does not have and numbers that cannot be, whether the scene comes to
them or not.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import pytest
import scenariogeneration

from safevar_sumo.errors import InputError
from safevar_sumo.openscenario import play
from safevar_sumo.openscenario.document import CHILDREN, LEGAL, SIZE
from tests.openscenario.writing import body, group, write

EVENT = """<Event name="Never" priority="skip" maximumExecutionCount="1">
<Action name="a"><PrivateAction><LongitudinalAction><SpeedAction><SpeedActionDynamics dynamicsShape="linear" dynamicsDimension="time" value="3"/><SpeedActionTarget>
    <RelativeTargetSpeed entityRef="Ego" value="1" speedTargetValueType="factor" continuous="0"/></SpeedActionTarget></SpeedAction></LongitudinalAction></PrivateAction></Action>
<Action name="rate"><PrivateAction><LongitudinalAction><SpeedAction><SpeedActionDynamics dynamicsShape="linear" dynamicsDimension="rate" value="-3"/><SpeedActionTarget>
    <AbsoluteTargetSpeed value="9"/></SpeedActionTarget></SpeedAction></LongitudinalAction></PrivateAction></Action>
<Action name="b"><PrivateAction><LateralAction><LaneChangeAction><LaneChangeActionDynamics dynamicsShape="cubic" dynamicsDimension="distance" value="30"/>
    <LaneChangeTarget><AbsoluteTargetLane value="-1"/></LaneChangeTarget></LaneChangeAction></LateralAction></PrivateAction></Action>
<Action name="c"><PrivateAction><LateralAction><LaneOffsetAction continuous="false"><LaneOffsetActionDynamics dynamicsShape="sinusoidal" maxLateralAcc="1"/>
    <LaneOffsetTarget><AbsoluteTargetLaneOffset value="1"/></LaneOffsetTarget></LaneOffsetAction></LateralAction></PrivateAction></Action>
<Action name="d"><PrivateAction><LongitudinalAction><LongitudinalDistanceAction entityRef="Ego" freespace="true" distance="9" displacement="any" continuous="false"/></LongitudinalAction></PrivateAction></Action>
<Action name="e"><PrivateAction><LongitudinalAction><LongitudinalDistanceAction timeGap="2" entityRef="Ego" freespace="true" continuous="false"/></LongitudinalAction></PrivateAction></Action>
<Action name="f"><PrivateAction><SynchronizeAction masterEntityRef="Ego"><TargetPositionMaster><LanePosition roadId="1" laneId="-1" s="9"/></TargetPositionMaster>
    <TargetPosition><LanePosition roadId="1" laneId="-1" s="9"><Orientation type="relative" h="0"/></LanePosition></TargetPosition>
    <FinalSpeed><AbsoluteSpeed value="15"><TargetDistanceSteadyState distance="3"/></AbsoluteSpeed></FinalSpeed></SynchronizeAction></PrivateAction></Action>
<Action name="g"><PrivateAction><SynchronizeAction masterEntityRef="Ego"><TargetPositionMaster><RelativeLanePosition entityRef="Car" dLane="0" ds="3"/></TargetPositionMaster>
    <TargetPosition><TrajectoryPosition s="1"/></TargetPosition>
    <FinalSpeed><RelativeSpeedToMaster value="1" speedTargetValueType="delta"><TargetTimeSteadyState time="2"/></RelativeSpeedToMaster></FinalSpeed></SynchronizeAction></PrivateAction></Action>
<Action name="h"><PrivateAction><RoutingAction><FollowTrajectoryAction initialDistanceOffset="1"><TrajectoryRef><Trajectory name="" closed="false"><Shape><Clothoid curvature="0" length="9">
    <Position><WorldPosition x="0" y="0"/></Position></Clothoid></Shape></Trajectory></TrajectoryRef>
    <TimeReference><Timing domainAbsoluteRelative="relative" scale="1" offset="0"/></TimeReference></FollowTrajectoryAction></RoutingAction></PrivateAction></Action>
<StartTrigger><ConditionGroup><Condition name="a" delay="1" conditionEdge="rising"><ByValueCondition>
    <StoryboardElementStateCondition storyboardElementType="event" storyboardElementRef="Never" state="completeState"/></ByValueCondition></Condition>
<Condition name="b" delay="0" conditionEdge="none"><ByEntityCondition><TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="Car"/></TriggeringEntities>
    <EntityCondition><RelativeDistanceCondition entityRef="Ego" relativeDistanceType="lateral" coordinateSystem="road" freespace="false" rule="lessThan" value="1"/></EntityCondition></ByEntityCondition></Condition>
<Condition name="c" delay="0" conditionEdge="none"><ByEntityCondition><TriggeringEntities triggeringEntitiesRule="all"><EntityRef entityRef="Car"/></TriggeringEntities>
    <EntityCondition><TimeHeadwayCondition entityRef="Ego" freespace="false" rule="lessThan" value="1"/></EntityCondition></ByEntityCondition></Condition>
<Condition name="d" delay="0" conditionEdge="none"><ByEntityCondition><TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="Car"/></TriggeringEntities>
    <EntityCondition><TimeToCollisionCondition freespace="true" rule="lessThan" value="1"><TimeToCollisionConditionTarget><EntityRef entityRef="Ego"/></TimeToCollisionConditionTarget></TimeToCollisionCondition></EntityCondition></ByEntityCondition></Condition>
<Condition name="e" delay="0" conditionEdge="none"><ByEntityCondition><TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="Car"/></TriggeringEntities>
    <EntityCondition><TraveledDistanceCondition value="9000"/></EntityCondition></ByEntityCondition></Condition>
<Condition name="f" delay="0" conditionEdge="none"><ByEntityCondition><TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="Car"/></TriggeringEntities>
    <EntityCondition><ReachPositionCondition tolerance="1"><Position><WorldPosition x="0" y="0"/></Position></ReachPositionCondition></EntityCondition></ByEntityCondition></Condition>
<Condition name="g" delay="0" conditionEdge="none"><ByEntityCondition><TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="Car"/></TriggeringEntities>
    <EntityCondition><DistanceCondition freespace="false" rule="lessThan" value="1"><Position><WorldPosition x="0" y="0"/></Position></DistanceCondition></EntityCondition></ByEntityCondition></Condition>
<Condition name="h" delay="0" conditionEdge="none"><ByEntityCondition><TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="Car"/></TriggeringEntities>
    <EntityCondition><StandStillCondition duration="1"/></EntityCondition></ByEntityCondition></Condition>
<Condition name="i" delay="0" conditionEdge="none"><ByEntityCondition><TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="Car"/></TriggeringEntities>
    <EntityCondition><SpeedCondition direction="longitudinal" rule="lessThan" value="-1"/></EntityCondition></ByEntityCondition></Condition>
</ConditionGroup></StartTrigger></Event>"""
"""Actions that never begin, and conditions that never hold."""
CAR = body("Car").replace("</Vehicle>", '<Trailer><TrailerRef entityRef=""/></Trailer></Vehicle>')
"""A trailer that names nobody is none."""
SCHEMAS = sorted(
    Path(scenariogeneration.__file__).parents[1].glob("schemas/OpenSCENARIO_1*.xsd"), reverse=True
)
XSD = "{http://www.w3.org/2001/XMLSchema}"
SIZES = """Condition.delay Event.maximumExecutionCount SpeedActionDynamics.value LaneChangeActionDynamics.value
LaneOffsetActionDynamics.maxLateralAcc LongitudinalDistanceAction.distance LongitudinalDistanceAction.timeGap
TargetDistanceSteadyState.distance TargetTimeSteadyState.time FollowTrajectoryAction.initialDistanceOffset
TrajectoryPosition.s Clothoid.length RelativeDistanceCondition.value TimeHeadwayCondition.value
TimeToCollisionCondition.value TraveledDistanceCondition.value ReachPositionCondition.tolerance DistanceCondition.value
StandStillCondition.duration"""
WORDS = """Actors.selectTriggeringEntities Condition.conditionEdge Event.priority LaneChangeActionDynamics.dynamicsDimension
LaneOffsetActionDynamics.dynamicsShape LongitudinalDistanceAction.displacement LongitudinalDistanceAction.continuous
Orientation.type RelativeDistanceCondition.coordinateSystem RelativeDistanceCondition.relativeDistanceType
RelativeSpeedToMaster.speedTargetValueType RelativeTargetSpeed.speedTargetValueType RelativeTargetSpeed.continuous
SimulationTimeCondition.rule SpeedCondition.direction SpeedActionDynamics.dynamicsShape
StoryboardElementStateCondition.state StoryboardElementStateCondition.storyboardElementType
TimeHeadwayCondition.freespace Timing.domainAbsoluteRelative TriggeringEntities.triggeringEntitiesRule"""


def write_all_actions(folder: Path) -> str:
    """The path of a file with these actions and conditions."""
    return write(folder, groups=group(EVENT), entities=body("Ego") + CAR)


@pytest.mark.parametrize(
    ("names", "bad", "legal"),
    [
        (SIZES, "-1", SIZE),
        (SIZES, "INF", "finite"),
        (SIZES, "nan", "finite"),
        (WORDS, "longitudnal", "one of "),
    ],
)
def test_what_is_illegal_is_refused_with_all_that_names_it(
    tmp_path: Path, names: str, bad: str, legal: str
) -> None:
    file = Path(write_all_actions(tmp_path))
    text = file.read_text()
    assert play(str(file), {}).duration == pytest.approx(14)
    for one in names.split():
        element, name = one.split(".")
        file.write_text(
            re.sub(rf"(<{element} [^>]*?\b{name}=['\"])[^'\"]*", rf"\g<1>{bad}", text, count=1)
        )
        with pytest.raises(InputError, match=f"{element}: {name} = '{bad}'") as caught:
            play(str(file), {})
        assert legal in caught.value.legal


def children_of(kind: Element | None, types: dict[str | None, Element]) -> list[Element]:
    """The elements that a type of a schema has, also by its groups."""
    inner = [] if kind is None else [*kind.iter()]
    groups = [types[one.get("ref")] for one in inner if one.tag == f"{XSD}group" and one.get("ref")]
    own = [one for one in inner if one.tag == f"{XSD}element"]
    return own + [each for one in groups for each in children_of(one, types)]


def test_the_elements_are_those_of_the_schemas_of_all_versions() -> None:
    """An element has the children that some version has, several only if some version says so."""
    found: dict[str, set[str]] = {}
    for path in SCHEMAS:
        types = {one.get("name"): one for one in ElementTree.parse(path).getroot()}
        for kind in types.values():
            for one in children_of(kind, types):
                for child in children_of(types.get(one.get("type")), types):
                    star = "*" * (child.get("maxOccurs") == "unbounded")
                    found.setdefault(str(one.get("name")), set()).add(f"{child.get('name')}{star}")
    for name, legal in CHILDREN.items():
        assert {one.rstrip("*") for one in legal} == {one.rstrip("*") for one in found[name]}, name
        assert {*legal} <= found[name] | {"GlobalAction*", "UserDefinedAction*", "Private*"}, name


def test_the_words_are_those_of_the_schemas_of_all_versions() -> None:
    text = "".join(path.read_text() for path in SCHEMAS)
    for key, legal in LEGAL.items():
        within = key.replace(".", '".*?name="') if "." in key else f'.*?name="{key}'
        (kind, *_) = re.findall(rf'complexType name="{within}" type="(\w+)"', text, re.DOTALL)
        types = re.findall(rf'simpleType name="{kind}".*?</xsd:simpleType', text, re.DOTALL)
        words = {"none", *re.findall('enumeration value="(.*?)"', "".join(types))}
        assert words == {"none", *legal} or legal == {"Boolean": ["true", "false", "1", "0"]}.get(
            kind, SIZE
        ), key
