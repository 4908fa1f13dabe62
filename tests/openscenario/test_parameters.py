# ruff: noqa: E501 (lines of XML)
"""Parameters, names and catalogs of OpenSCENARIO files, and files without a road."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.openscenario import play, read
from safevar_sumo.scenarios import OpenScenario
from tests.openscenario.writing import (
    AT_ONCE,
    body,
    event,
    group,
    lane_change,
    speed,
    staged,
    trigger,
    watching,
    write,
)
from tests.scenarios.holding import driven

V = '<ParameterDeclaration name="{}" parameterType="{}" value="{}">{}</ParameterDeclaration>'
LIMIT = '<ConstraintGroup><ValueConstraint rule="lessThan" value="{}"/></ConstraintGroup>'
ENDED = (
    "<StoryboardElementStateCondition storyboardElementType='event' storyboardElementRef='{}'"
    " state='completeState'/>"
)


@pytest.mark.parametrize("name", ["owner", "$owner"])
@pytest.mark.parametrize("reference", ["v", "$v"])
def test_names_and_references_of_parameters_may_begin_with_a_dollar(
    tmp_path: Path, name: str, reference: str
) -> None:
    parameters = V.format(name, "string", "Car", "") + V.format("v", "double", "3", "")
    condition = f"<ParameterCondition parameterRef='{reference}' rule='equalTo' value='3'/>"
    file = write(
        tmp_path,
        groups=group(event(speed(5), condition), actor="$owner"),
        entities=body("Ego") + body("$owner", 5.0),
        parameters=parameters,
    )
    (car,) = play(file, {}).others
    assert (car.name, car.speed[-1]) == ("Car", 5)
    assert play(file, {"v": "4"}).others[0].speed[-1] == 10


@pytest.mark.parametrize("name", ["$Brake", "${1 +", "costs $5", "$v"])
def test_names_of_elements_and_conditions_are_texts(tmp_path: Path, name: str) -> None:
    file = write(
        tmp_path,
        event(speed(20, "linear", "time", 2), AT_ONCE.format(1), name),
        parameters=V.format("v", "double", "3", ""),
        stop=trigger(ENDED.format(name), "").replace('name=""', f'name="{name}"'),
    )
    assert play(file, {}).duration == pytest.approx(3 + 4, abs=0.02)


def test_the_constraints_of_inner_parameters_hold(tmp_path: Path) -> None:
    """Those of a Story, whose value may depend on one of the file, and of a catalog's entry."""
    inner = V.format("w", "double", "${$v * 2}", LIMIT.format(8))
    file = Path(write(tmp_path, event(speed("$w")), parameters=V.format("v", "double", "3", "")))
    declarations = f"<ParameterDeclarations>{inner}</ParameterDeclarations>"
    text = file.read_text().replace('<Story name="Story">', f'<Story name="Story">{declarations}')
    file.write_text(text)
    assert play(str(file), {}).others[0].speed[-1] == 6
    with pytest.raises(InputError, match=r"the file's constraints exclude w = 8"):
        play(str(file), {"v": "4"})


NO_ROAD = '<RoadNetwork><LogicFile filepath="road.xodr"/></RoadNetwork>'


@pytest.mark.parametrize(
    "network", ["", "<RoadNetwork/>", "<RoadNetwork><SceneGraphFile/></RoadNetwork>"]
)
def test_a_file_without_a_road_gets_a_straight_one(tmp_path: Path, network: str) -> None:
    """With the lanes that it names, of 3.5 m each."""
    file = Path(write(tmp_path, event(lane_change(-3, "linear", "time", 2), AT_ONCE.format(1))))
    file.write_text(file.read_text().replace(NO_ROAD, network))
    played = play(str(file), {})
    (car,) = played.others
    assert "the file names no road: a straight one is taken" in played.remarks
    left = (car.place - 1.5 * car.facing).imag
    assert (left[0], left[-1]) == (pytest.approx(-3.5 * 1.5), pytest.approx(-3.5 * 2.5))
    assert played.start.place == pytest.approx(50 + 3.5 - 1.75j)
    assert driven(OpenScenario(str(file))).outcome[0] == "passed"


VEHICLES = """<OpenSCENARIO><FileHeader revMajor="1" revMinor="0"/><Catalog name="{}">{}</Catalog></OpenSCENARIO>"""
PLACES = "<{0}Catalog><Directory path='.'/></{0}Catalog>"
LOOP = '<CatalogReference catalogName="Cars" entryName="car"/>'
ENTRY = '<Vehicle name="car" vehicleCategory="car"><BoundingBox><Center x="1" y="0"/><Dimensions width="2" length="6"/></BoundingBox>{}</Vehicle>'


def with_catalog(folder: Path, its_name: str, entry: str = ENTRY.format("")) -> str:
    """A file whose Car is the entry `car` of the catalog Cars, in a file of that name."""
    (folder / "Cars.xosc").write_text(VEHICLES.format(its_name, entry))
    car = f'<ScenarioObject name="Car">{LOOP}</ScenarioObject>'
    return write(folder, entities=body("Ego") + car, catalogs=PLACES.format("Vehicle"))


@pytest.mark.parametrize("its_name", ["Cars", "VehicleCatalog"])
def test_a_catalog_is_found_by_its_name_or_its_file(tmp_path: Path, its_name: str) -> None:
    file = with_catalog(tmp_path, its_name)
    assert play(file, {}).others[0].shape.length == 6
    assert read(file, {}).catalogs == [str(tmp_path / "Cars.xosc")]


@pytest.mark.parametrize(
    "inner", ["{}</ScenarioObject>", "<ObjectController>{}</ObjectController></ScenarioObject>"]
)
def test_a_missing_catalog_that_the_file_does_not_need_is_no_fault(
    tmp_path: Path, inner: str
) -> None:
    reference = '<CatalogReference catalogName="None" entryName="x"/>'
    car = body("Car").replace("</ScenarioObject>", inner.format(reference))
    assert staged(tmp_path, entities=body("Ego") + car).others[0].shape.length == 4


CHANGES = {
    "set": "<SetAction value='5'/>",
    "add": "<ModifyAction><Rule><AddValue value='2'/></Rule></ModifyAction>",
    "multiply": "<ModifyAction><Rule><MultiplyByValue value='${5 / 3}'/></Rule></ModifyAction>",
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("kind", ["Parameter", "Variable"])
def test_an_action_changes_what_conditions_compare(tmp_path: Path, kind: str, change: str) -> None:
    """v is 3 in the file, and 5 after 4 s."""
    reference = f"{kind.lower()}Ref='v'"
    action = f"<{kind}Action {reference}>{CHANGES[change]}</{kind}Action>"
    sets = event("", AT_ONCE.format(4), "Sets", "parallel").replace(
        "<PrivateAction></PrivateAction>", f"<GlobalAction>{action}</GlobalAction>"
    )
    is_five = f"<{kind}Condition {reference} rule='greaterThan' value='4.9'/>"
    slows = event(speed(0, "linear", "rate", 2), is_five, "Slows")
    file = Path(write(tmp_path, sets, slows, parameters=V.format("v", "double", "3", "")))
    variable = "<VariableDeclarations><VariableDeclaration name='v' variableType='double' value='3'/></VariableDeclarations>"
    file.write_text(file.read_text().replace("<CatalogLocations>", f"{variable}<CatalogLocations>"))
    (car,) = play(str(file), {}).others
    assert car.speed[[400, 500]].tolist() == [10, pytest.approx(8, abs=0.03)]


COLLISION = watching("Ego", "<CollisionCondition><EntityRef entityRef='Car'/></CollisionCondition>")
SLOWS = event(speed(0, "linear", "rate", 2), AT_ONCE.format(4), "Slows", "parallel")


def setting(name: str, when: str, *values: str, repeats: int = 1) -> str:
    """An event that sets parameters to 5, or variables, which have capital letters."""
    actions = [
        f"<GlobalAction><{kind}Action {kind.lower()}Ref='{value}'>{CHANGES['set']}</{kind}Action></GlobalAction>"
        for value in values
        for kind in ["Variable" if value.isupper() else "Parameter"]
    ]
    written = event("", when, name, "parallel").replace(
        "<PrivateAction></PrivateAction>", f"</Action><Action name='{name} too'>".join(actions)
    )
    return written.replace("<Event ", f"<Event maximumExecutionCount='{repeats}' ")


def is_set(value: str, rule: str = "equalTo", than: str = "5") -> str:
    kind = "Variable" if value.isupper() else "Parameter"
    return f"<{kind}Condition {kind.lower()}Ref='{value}' rule='{rule}' value='{than}'/>"


def write_values(
    folder: Path,
    *events: str,
    stops: tuple[str, ...] = (),
    act: str = AT_ONCE.format(0),
    **parts: str,
) -> str:
    """A file of parameters p, q and variables V, W; several conditions can stop it, as 10 s do."""
    file = write(
        folder,
        *events,
        parameters="".join(V.format(name, "double", "3", "") for name in "pq"),
        stop="".join(trigger(condition, "") for condition in (AT_ONCE.format(10), *stops)),
        act_trigger=act if act.startswith("<StartTrigger") else trigger(act),
        **parts,
    )
    names = "".join(
        f"<VariableDeclaration name='{name}' variableType='double' value='3'/>" for name in "VW"
    )
    variables = f"<VariableDeclarations>{names}</VariableDeclarations>"
    text = Path(file).read_text().replace("<CatalogLocations>", f"{variables}<CatalogLocations>")
    Path(file).write_text(text)
    return file


logs = partial(setting, "Logs", COLLISION)


@pytest.mark.parametrize(
    ("events", "stops"),
    [
        ([logs("p")], []),
        ([logs("p")], [is_set("p")]),
        ([logs("V")], [is_set("V")]),
        ([logs("V")], [is_set("V", "notEqualTo", "3")]),
        ([logs("V", "W", "p")], [is_set("V"), is_set("W"), is_set("p")]),
        ([logs("V"), setting("Next", is_set("V"), "W")], [is_set("W")]),
        ([logs("V"), setting("Next", is_set("V"), "q")], [is_set("q")]),
        ([logs("V"), setting("Next", ENDED.format("Logs"), "W")], [is_set("W")]),
        ([logs("V")], [ENDED.format("Logs")]),
    ],
)
def test_what_moves_nobody_may_wait_for_a_collision(
    tmp_path: Path, events: list[str], stops: list[str]
) -> None:
    """All is as without these events: nothing but the end of the scene depends on them."""
    played = play(write_values(tmp_path, *events, SLOWS, stops=tuple(stops)), {})
    without = play(write_values(tmp_path, SLOWS), {})
    assert [*map(str, played)] == [*map(str, without)]
    (car,), (alone,) = played.others, without.others
    assert (car.place.tobytes(), car.speed.tobytes()) == (
        alone.place.tobytes(),
        alone.speed.tobytes(),
    )


def test_what_an_event_sets_ends_the_scene(tmp_path: Path) -> None:
    """At 5 s, and 4 s are played after that."""
    sets = setting("Sets", AT_ONCE.format(5), "V"), setting("Next", is_set("V"), "W")
    assert play(write_values(tmp_path, *sets, SLOWS, stops=(is_set("W"),)), {}).duration == 9
