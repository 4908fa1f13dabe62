"""The contract of a scenario, its actors and the geometry of the encounter."""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from safevar_sumo.plugins import TRUTH, Contract, Legal, Returned, UserCode, quoted
from safevar_sumo.records import (
    ALL_TRUE,
    ZERO,
    BoolArray,
    Encounter,
    FloatArray,
    Quantity,
    Trace,
)
from safevar_sumo.scenarios.roads import Roads, World

VUT = "vut"
"""Id of the vehicle under test in every network's traffic."""
MAX_GRADE = 30.0
"""Steepest road [%]."""
Grade = Annotated[float, Meta(ge=-MAX_GRADE, le=MAX_GRADE)]
XmlChanges = Mapping[str, Mapping[str, str] | None]
"""Changes to a network's traffic or lanes: attributes by the XPath of an element below the file's
root; None removes the element.
"""


PEDESTRIAN, CROSSING_LANE = "pedestrian", ":crossing_c0_0"
"""Id of a person who walks across the road, and of the lane that he walks on, in every network with
one.
"""


class Scene(NamedTuple):
    """The obstacle relative to N vehicles; arrays of shape (N,); see `Observation` for the
    quantities.

    `over` is true where the encounter has ended for good, `visible` where the obstacle is not
    occluded. A scenario whose `centre_to_centre` is true states the `obstacle_length`.
    """

    gap: FloatArray
    lateral: FloatArray
    lateral_speed: FloatArray
    over: BoolArray
    obstacle_speed: FloatArray = ZERO
    visible: BoolArray = ALL_TRUE
    obstacle_length: FloatArray = ZERO
    obstacle_width: FloatArray = ZERO
    obstacle: FloatArray = ZERO


MAX_DURATION = 3600.0
"""Longest run [s]."""
MAX_TEST_SPEED = 100.0
"""Highest speed of a test [m/s]."""
LEGAL_SCENE = {
    **dict.fromkeys(Scene._fields, Legal(scalar=True)),
    "gap": Legal(infinite=True),
    "over": TRUTH,
    "visible": TRUTH._replace(scalar=True),
}
LEGAL_ENCOUNTER = {
    **dict.fromkeys(Encounter._fields, Legal(infinite=True, undefined=True)),
    "in_conflict": TRUTH,
}


def check_encounter(
    code: UserCode, method: str, encounter: Encounter, trace: Trace
) -> Encounter:
    """Refuse an encounter that is undefined while it counts, or that never has a separation: its
    metrics would be undefined or infinite.
    """
    is_counted = encounter.in_conflict & trace.active
    for name, values in zip(Encounter._fields, encounter, strict=True):
        if np.isnan(values[is_counted]).any():
            raise code.wrong(
                method, f"{name} = nan", "numbers wherever in_conflict is true"
            )
    least_separation = np.where(is_counted, encounter.separation, np.inf).min(axis=0)
    if (is_counted.any(axis=0) & (least_separation == np.inf)).any():
        raise code.wrong(
            method,
            "separation = inf",
            "a finite number at some time that in_conflict is true",
        )
    return encounter


def check_changes(
    code: UserCode, method: str, changes: Any, roads: Roads
) -> XmlChanges:
    """Refuse changes to a network or its traffic that are no mapping; values become texts."""
    if not isinstance(changes, Mapping):
        raise code.wrong(method, quoted(changes), "a mapping from XPaths to attributes")
    texts = {}
    for path, change in changes.items():
        # None, which removes an element, stays None.
        texts[path] = change and {name: str(value) for name, value in change.items()}
    return texts


def check_fields(code: UserCode, scenario: Any, **further: Legal) -> None:
    """Refuse a user's scenario without a network, or with an illegal duration, grade or speed, or
    illegal numbers of `further` fields.
    """
    if not isinstance(getattr(scenario, "network", None), str):
        raise code.wrong(
            "__init__",
            quoted(scenario),
            "an object with the attribute network, a folder's name or path",
        )
    legal = {
        "duration": Legal(0.0, MAX_DURATION, is_open=True),
        "grade": Legal(-MAX_GRADE, MAX_GRADE),
        **further,
    }
    if scenario.test_speed is not None:
        legal["test_speed"] = Legal(0.0, MAX_TEST_SPEED, is_open=True)
    Returned((legal,)).check(code, "__init__", scenario, ())


Part = Literal[
    "a driving system",
    "a picture",
    "a trace",
    "SUMO",
    "recorded scenes",
    "roads",
    "sumo-gui",
    "weather",
]
"""What a mover may lack, as refusals name it."""


class Mover(NamedTuple):
    """Who moves the vehicles of a scenario.

    Attributes
    ----------
    kind
        What a scenario of it is, in words. All tests of a matrix have one kind.
    takes_long
        Whether simulations take so long that questions count them, as it simulates one setting at
        once; others simulate as many as fit into memory.
    is_exact
        Whether it repeats itself to the bit. If not, a study may repeat each setting; without
        repeats, another process tries whether results are the same.
    has_own_step
        Whether it has a time step of its own, which no study states.
    lacks
        What it lacks; each with the reason, with which it is refused.
    """

    kind: str
    takes_long: bool = False
    is_exact: bool = True
    has_own_step: bool = False
    lacks: Mapping[Part, str] = {}

    def has(self, part: Part) -> bool:
        """Whether it does not lack a part."""
        return part not in self.lacks


SUMO = Mover("a scenario of SUMO")
"""SUMO, or a scene that it has played once, or tracks of bodies."""


ScenarioMemory = Any
"""What a scenario remembers of a run: an object of its own class with named attributes."""


Quantities = Mapping[str, Quantity]
"""Values of a scenario's parameters by name: numbers, or arrays with a value for each encounter."""


class Layout(NamedTuple):
    """Where the actors of N runs are whose scenarios differ in parameters that a study searches.

    `front` is the position of the vehicle under test on its lane at the start [m], a number or of
    shape (N,); None if no parameter moves it. `pedestrian` is the id of a person who walks across
    that lane, "" if no parameter moves one: at T samples, where his recorded way crosses the lane,
    he is to the `left` of its middle [m], with the `speed` [m/s]; shape (T, N). `backwards` is true
    where he has turned round.
    """

    front: Quantity | None
    pedestrian: str = ""
    left: Quantity = ZERO
    speed: Quantity = ZERO
    backwards: BoolArray | bool = False


def as_text(value: Quantity) -> str:
    """A number as SUMO's files have it."""
    return repr(float(value))


class Scenario:
    """What all scenarios have. A class's fields are the parameters of `scenario.parameters`.

    Attributes
    ----------
    mover
        Who moves the vehicles.
    LIBRARIES
        Distributions on whose versions results depend, such as `metadrive-simulator`.
    version
        A version of the class itself on which they depend, such as its simulator's.
    network
        A folder of `sumo_nets/`, or the path of a folder with the same files; "" without roads.
    duration
        Length of a run [s].
    reactive_actors
        False declares that no actor reacts to the vehicle under test: SUMO can play the scene once
        for all vehicles.
    grade
        Rise of the road [%]. SUMO's plane then stands for the inclined road; the vehicle models add
        the force of gravity.
    centre_to_centre
        Whether the safety degree is the distance between the centres of two vehicles.
    border
        The parameter of which smaller values are more dangerous, which says how far a change moves
        what is avoidable; "" if it has none.
    pre_crash
        The scenario's type in NHTSA's typology; "" if it has none.
    test_speed
        Speed that a robot holds until the ADS brakes [m/s]; None without a robot. A run that leaves
        the speed tolerance before the ADS brakes is an invalid test.
    is_hit_in_front
        Whether only contacts at the vehicle's front are collisions.
    goes_on
        Whether a run goes on beyond `duration` while the vehicle still closes on somebody.
    has_phase
        Whether all of an encounter can begin later by a part of a step, while the driving system
        decides at the same times as ever.
    brakes_fully
        Whether the scenario itself brakes, fully and from the start on, and asks no ADS.
    is_user_code
        Whether the class is a user's.
    """

    __slots__ = ()
    mover: ClassVar[Mover] = SUMO
    LIBRARIES: ClassVar[tuple[str, ...]] = ()
    version: ClassVar[str] = ""
    is_user_code: ClassVar[bool] = False
    network: str
    reactive_actors: bool = True
    grade: float = 0.0
    centre_to_centre: bool = False
    brakes_fully: bool = False
    border: ClassVar[str] = ""
    goes_on: ClassVar[bool] = False
    # A scenario may have fields or properties of these names: type checkers see properties.
    # `duration` and `start_speed` have no default.
    if TYPE_CHECKING:

        @property
        def duration(self) -> float: ...
        @property
        def start_speed(self) -> Quantity: ...
        @property
        def pre_crash(self) -> str: ...
        @property
        def test_speed(self) -> float | None: ...
        @property
        def has_phase(self) -> bool: ...
    else:
        has_phase = False
        pre_crash = ""
        test_speed = None

    @property
    def is_hit_in_front(self) -> bool:
        """By default in a test at its speed."""
        return self.test_speed is not None

    def at(self, values: Quantities) -> Scenario:
        """This scenario at other values of parameters, created anew."""
        create: Any = dataclasses.replace
        if isinstance(self, msgspec.Struct):
            create = msgspec.structs.replace
        return create(self, **values)  # type: ignore[no-any-return]

    def lanes(self, roads: Roads) -> XmlChanges:
        """Changes to the lanes of the built network."""
        return {}

    def actors(self, roads: Roads) -> XmlChanges:
        """Changes to the network's traffic."""
        return {}

    def check(self) -> None:
        """Refuse parameters of a study's test, by an `InputError`; those of searched encounters are
        not checked.
        """

    def remarks(self) -> list[str]:
        """Remarks for the user on the scenario's parameters."""
        return []

    def benign(self) -> NamedScenarios:
        """Scenes like this one in which nobody needs to brake, each with a description; none by
        default.
        """
        return ()

    def obstacle(self) -> str:
        """What the vehicle hits in a collision, in words."""
        return OBSTACLES.get(self.pre_crash, "the obstacle")


NamedScenarios = Iterable[tuple[str, Scenario]]
"""Scenarios, each with what it is in words."""


class WorldScenario(Scenario):
    """A scenario that observes the actors of its network itself, in the world that moves them.

    Attributes
    ----------
    RETURNS
        What the methods of a user's class must return.
    """

    __slots__ = ()
    RETURNS: ClassVar[Contract] = {
        "lanes": Returned(then=check_changes),
        "actors": Returned(then=check_changes),
        "begin": Returned(like=0),
        "observe": Returned((LEGAL_SCENE, {}), like=0),
        "encounter": Returned((LEGAL_ENCOUNTER,), like=0, then=check_encounter),
    }

    @abstractmethod
    def begin(self, world: World) -> ScenarioMemory:
        """Prepare a run, before the first step; returns the memory for `observe`."""

    @abstractmethod
    def observe(
        self, world: World, step: float, memory: ScenarioMemory
    ) -> tuple[Scene, ScenarioMemory]:
        """The obstacle now, `step` seconds after the last call, and the new memory; may also
        command the actors.
        """

    @abstractmethod
    def encounter(self, trace: Trace) -> Encounter:
        """The geometry that the metrics are computed from."""

    def layout(self, roads: Roads, step: float, samples: int) -> Layout:
        """Where the actors are at samples `step` seconds apart, if parameters of this scenario are
        arrays of N values: the same as `actors` and `observe` make SUMO do.
        """
        raise NotImplementedError


class PreCrash(StrEnum):
    """Pre-crash types by NHTSA's names (Najm, Smith, Yanagisawa: Pre-Crash Scenario Typology for
    Crash Avoidance Research, 2007).
    """

    PEDESTRIAN_AFTER_MANOEUVRE = "pedestrian crash with prior vehicle manoeuvre"
    PEDESTRIAN = "pedestrian crash without prior vehicle manoeuvre"
    CYCLIST = "pedalcyclist crash without prior vehicle manoeuvre"
    STRAIGHT_PATHS = "straight crossing paths at non-signalised junctions"
    CUT_IN = "vehicle changing lanes, same direction"
    LEAD_STOPPED = "lead vehicle stopped"
    LEAD_SLOWER = "lead vehicle moving at lower constant speed"
    LEAD_DECELERATING = "lead vehicle decelerating"


OBSTACLES: Mapping[str, str] = {
    PreCrash.PEDESTRIAN_AFTER_MANOEUVRE: "a crossing pedestrian",
    PreCrash.PEDESTRIAN: "a pedestrian",
    PreCrash.CYCLIST: "a cyclist",
    PreCrash.STRAIGHT_PATHS: "a crossing vehicle",
    PreCrash.CUT_IN: "a car that cuts in",
    PreCrash.LEAD_STOPPED: "a standing vehicle",
    PreCrash.LEAD_SLOWER: "a slower vehicle ahead",
    PreCrash.LEAD_DECELERATING: "a braking vehicle ahead",
}
"""What is in the way, by the pre-crash type."""
