"""The contract of a scenario: what a scenario must say about its network, actors and encounter."""

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
"""The id of the vehicle under test in the traffic of every network."""
MAX_GRADE = 30.0
"""Largest rise of a road [%]."""
Grade = Annotated[float, Meta(ge=-MAX_GRADE, le=MAX_GRADE)]
XmlChanges = Mapping[str, Mapping[str, str] | None]
"""Changes to a network's traffic or lanes. A key is the XPath of an element below the file's root;
the value has attributes to set, or is None to remove the element.
"""


PEDESTRIAN = "pedestrian"
"""Id of a person who walks across the road, in every network with such a person."""
CROSSING_LANE = ":crossing_c0_0"
"""Id of the lane on which this person walks across the road."""


class Scene(NamedTuple):
    """The obstacle as N vehicles meet it; arrays have shape (N,). See `Observation` for the
    quantities.

    `over` is true after the encounter has ended for good. `visible` is true while nothing occludes
    the obstacle. A scenario whose `centre_to_centre` is true must state the `obstacle_length`.
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
"""Longest duration of a run [s]."""
MAX_TEST_SPEED = 100.0
"""Highest speed of the vehicle in a test [m/s]."""
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
    """Refuse an encounter that makes metrics undefined or infinite: an encounter with NaN where
    `in_conflict` is true, or without any finite separation.
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
    """Refuse changes to a network or its traffic that are no mapping, and convert values to
    texts.
    """
    if not isinstance(changes, Mapping):
        raise code.wrong(method, quoted(changes), "a mapping from XPaths to attributes")
    texts = {}
    for path, change in changes.items():
        # None removes an element, and stays None.
        texts[path] = change and {name: str(value) for name, value in change.items()}
    return texts


def check_fields(code: UserCode, scenario: Any, **further: Legal) -> None:
    """Refuse a user's scenario without a network, or with an illegal duration, grade or speed.
    `further` has the legal numbers of more fields.
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
"""Parts that a mover may lack, in the words of refusals."""


class Mover(NamedTuple):
    """A mover is the simulator that moves the vehicles of a scenario.

    Attributes
    ----------
    kind
        The kind of the mover's scenarios, in words. All tests of a matrix have one kind.
    takes_long
        Whether the mover simulates one setting at a time. Questions then count and limit the
        simulations. Other movers simulate as many settings at once as fit into memory.
    is_exact
        Whether a repeated simulation gives the same result to the bit. If not, a study may repeat
        each setting. Without repeats, another process checks whether results are the same.
    has_own_step
        Whether the mover decides the time step, so that no study may state the step.
    lacks
        The parts that the mover lacks, each with the reason that a refusal states.
    """

    kind: str
    takes_long: bool = False
    is_exact: bool = True
    has_own_step: bool = False
    lacks: Mapping[Part, str] = {}

    def has(self, part: Part) -> bool:
        """Return whether the mover has a part."""
        return part not in self.lacks


SUMO = Mover("a scenario of SUMO")
"""The mover of all shipped scenarios: SUMO itself, a scene that SUMO has played once, or tracks of
bodies.
"""


ScenarioMemory = Any
"""What a scenario remembers of a run between two steps: an object of the scenario's own class."""


class Layout(NamedTuple):
    """The places of the actors of N runs, if a study searches parameters that move actors.

    Attributes
    ----------
    front
        Position of the vehicle's front on its lane at the start [m], a number or shape (N,); None
        if no parameter moves the vehicle.
    pedestrian
        Id of a person who walks across the lane; "" if no parameter moves a person.
    left
        Position of the person to the left of the lane's middle at T samples [m], shape (T, N).
    speed
        Speed of the person [m/s].
    backwards
        Whether the person has turned round, shape (T, N).
    """

    front: Quantity | None
    pedestrian: str = ""
    left: Quantity = ZERO
    speed: Quantity = ZERO
    backwards: BoolArray | bool = False


def as_text(value: Quantity) -> str:
    """A number as a text for SUMO's files, without rounding."""
    return repr(float(value))


class Scenario:
    """Base of all scenarios. The fields of a scenario's class are the parameters that a study
    states under `scenario.parameters`.

    Attributes
    ----------
    mover
        The simulator that moves the vehicles.
    LIBRARIES
        Distributions whose versions change results, such as `metadrive-simulator`.
    version
        A further version that changes results, such as the simulator's.
    network
        A folder of `sumo_nets/`, or the path of a folder with the same files; "" without roads.
    duration
        Length of a run [s].
    reactive_actors
        False declares that no actor reacts to the vehicle under test: SUMO can play the scene once
        for all vehicles.
    grade
        Rise of the road [%]. In SUMO the road is level; the vehicle models add the force of
        gravity.
    centre_to_centre
        Whether the safety degree is the distance between the centres of two vehicles.
    border
        The parameter of which smaller values are more dangerous; "" without such a parameter. With
        one, drivers for lanes (`OF_LANES`) also answer what another driver would have avoided.
    pre_crash
        The scenario's type in NHTSA's typology; "" without a type.
    test_speed
        Speed that a robot holds until the ADS brakes [m/s]; None without a robot. A run that leaves
        the speed tolerance before the ADS brakes is an invalid test.
    is_hit_in_front
        Whether only contacts at the vehicle's front are collisions.
    goes_on
        Whether a run goes on after `duration` while the vehicle still approaches somebody.
    has_phase
        Whether the whole encounter can begin later by a part of a step. The driving system then
        still decides at the same times.
    brakes_fully
        Whether the vehicle brakes fully from the start on. Then no ADS is asked.
    is_user_code
        Whether a user wrote the class.
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
    # A user's scenario may have fields or properties of these names. Therefore type checkers see
    # properties, and only the other attributes have defaults.
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
        """By default true for a test in which a robot holds the speed."""
        return self.test_speed is not None

    def at(self, values: Mapping[str, Quantity]) -> Scenario:
        """A new scenario of the same class, with other values of these parameters."""
        create: Any = dataclasses.replace
        if isinstance(self, msgspec.Struct):
            create = msgspec.structs.replace
        return create(self, **values)  # type: ignore[no-any-return]

    def lanes(self, roads: Roads) -> XmlChanges:
        """Changes to the lanes of the built network; none by default."""
        return {}

    def actors(self, roads: Roads) -> XmlChanges:
        """Changes to the network's traffic; none by default."""
        return {}

    def check(self) -> None:
        """Refuse illegal parameters of a test by an `InputError`. Encounters that a search proposes
        are not checked.
        """

    def remarks(self) -> list[str]:
        """Remarks for the user on the scenario's parameters."""
        return []

    def benign(self) -> Iterable[tuple[str, Scenario]]:
        """Similar scenes in which nobody needs to brake, each with a description; none by
        default.
        """
        return ()

    def obstacle(self) -> str:
        """What the vehicle hits in a collision, in words."""
        return OBSTACLES.get(self.pre_crash, "the obstacle")


class WorldScenario(Scenario):
    """A scenario that observes the actors itself, in the world (the simulated traffic) of its
    network.

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
        """Prepare a run before its first step, and return the memory for `observe`."""

    @abstractmethod
    def observe(
        self, world: World, step: float, memory: ScenarioMemory
    ) -> tuple[Scene, ScenarioMemory]:
        """Observe the obstacle, `step` seconds after the last call, and return the new memory.
        `observe` may also command the actors.
        """

    @abstractmethod
    def encounter(self, trace: Trace) -> Encounter:
        """The geometry of the encounter, from which the metrics are computed."""

    def layout(self, roads: Roads, step: float, samples: int) -> Layout:
        """The places of the actors at samples that are `step` seconds apart. Parameters of this
        scenario may be arrays of N values. The places are those to which `actors` and `observe`
        would move the actors in SUMO.
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
"""What the vehicle hits, in words, by the pre-crash type."""
