"""The state of a scene that is being played: what its actions and conditions ask and note; Ego's
own speeds, which a robot drives until the driving system is switched on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from safevar_sumo.errors import one_of
from safevar_sumo.openscenario.actors import STEP, Actor, Array, actors_of
from safevar_sumo.openscenario.document import Element, attribute, unsupported
from safevar_sumo.openscenario.places import Place, located, place_of, turn_of
from safevar_sumo.openscenario.reading import Document
from safevar_sumo.openscenario.road import read_network, straight_network
from safevar_sumo.openscenario.ways import STRAY

Key = tuple[str, str]
"""An element in conditions on states: its kind, and its name after those of all around it, joined
by `::`.
"""


@dataclass
class OwnSpeeds:
    """The speeds of Ego by its SpeedActions: when the last of them ends, and when an
    ActivateControllerAction switches the driving system on [s].
    """

    until: float = 0.0
    switched_on: float = math.inf

    def begin(self, now: float, duration: float, name: str) -> None:
        """Begin a SpeedAction; one of Init that takes no time is no profile."""
        if now >= self.switched_on:
            raise unsupported(
                f"SpeedAction of {name} after the start: its driving system drives from"
                f" {self.switched_on:.1f} s on",
                "a SpeedAction before an ActivateControllerAction",
            )
        if math.isfinite(duration) and (now or duration):
            self.until = now + duration

    def end(self, now: float) -> None:
        """Switch the driving system on."""
        if not now and self.until:
            raise unsupported(
                "SpeedAction of Ego that takes time, beside an ActivateControllerAction in Init",
                "an ActivateControllerAction in an event after it",
            )
        self.switched_on = min(now, self.switched_on)

    @property
    def end_time(self) -> float:
        """When the robot ends [s]; 0 without a profile."""
        end = self.until if math.isinf(self.switched_on) else self.switched_on
        return end if self.until else 0.0

    def speeds(self, ego: Actor, last: int) -> Array:
        """Speeds at all samples up to the end of the profile, one of them without a profile.

        After them Ego keeps its speed.
        """
        end = min(math.ceil(self.end_time / STEP - 1e-6), last)
        speeds = ego.speed[: end + 1]
        if speeds[-1] <= 0:
            when = f"when its driving system is switched on, at {end * STEP:.1f} s"
            raise unsupported(
                f"{ego.name} stands {when if end else 'at the start'}", "a SpeedAction in Init"
            )
        if np.ptp(ego.speed[end : last + 1]) > 1e-6:
            raise unsupported(
                f"{ego.name} does not keep its speed at the start: its driving system drives",
                "a SpeedAction",
            )
        return speeds


class Player:
    """A scene that is being played, at the sample `sample` of `times` [s].

    `begun` and `ended` are times of elements of the storyboard [s]; `dependences` says until when
    the scene depends on Ego, and why; `profile` are Ego's own speeds; `masters` says until when
    actors are masters of a SynchronizeAction [s], and of whose; `ignored` are elements without
    effect; `has_begun` says whether Init is over; `seen` are the values of conditions, from the
    sample on at which they were asked for the first time.
    """

    def __init__(self, document: Document, ego: str, times: Array) -> None:
        self.document = document
        self.network = (
            read_network(document.road) if document.road else straight_network(document.root)
        )
        self.times = times
        self.actors = {actor.name: actor for actor in actors_of(document.root, len(times))}
        if ego not in self.actors:
            raise unsupported(
                f"no ScenarioObject is named {ego!r}; there are: {', '.join(self.actors)}",
                f"ego = {one_of(self.actors)}",
            )
        self.ego = self.actors[ego]
        self.sample = 0
        self.variables = {
            attribute(each, "name").lstrip("$"): attribute(each, "value")
            for each in document.root.findall("VariableDeclarations/VariableDeclaration")
        }
        self.begun: dict[Key, float] = {}
        self.ended: dict[Key, float] = {}
        self.dependences: dict[str, float] = {}
        self.profile = OwnSpeeds()
        self.masters: dict[str, tuple[float, str]] = {}
        self.remarks: dict[str, None] = {}
        self.ignored: set[str] = set()
        self.has_begun = False
        self.seen: dict[int, tuple[int, Array]] = {}

    @property
    def now(self) -> float:
        """The time [s]."""
        return float(self.times[self.sample])

    def actor(self, name: str) -> Actor:
        """The entity of this name."""
        if name not in self.actors:
            raise unsupported(
                f"no ScenarioObject is named {name!r}; there are: {', '.join(self.actors)}",
                one_of(self.actors),
            )
        return self.actors[name]

    def other(self, element: Element) -> Actor:
        """The entity that an element refers to."""
        return self.actor(attribute(element, "entityRef"))

    def place_of(self, name: str) -> Place:
        """The place of an entity now: on a road also if it follows a trajectory there."""
        return located(self.actor(name).here, self.network)

    def place(self, position: Element) -> Place:
        """The place that the child of a Position names."""
        return place_of(position, self.network, self.place_of)

    def depends(self, other: Actor, until: float, what: str) -> None:
        """Note what depends on Ego, and until when [s]."""
        if other is self.ego and (self.sample or until > self.now):
            self.dependences[what] = max(until, self.dependences.get(what, 0.0))

    def refuse_turn(self, places: Array) -> None:
        """Refuse a way of Ego that leaves the straight line along its direction at the start."""
        facing = self.ego.pose(0).facing
        ahead = (places - places[0]) / facing
        is_aside = np.abs(ahead.imag) >= STRAY
        if is_aside.any():
            moves = np.diff(places)
            turn = max(turn_of(complex(one), facing) for one in moves[moves != 0])
            raise unsupported(
                f"{self.ego.name} does not drive straight on: it turns by {turn:.1f} degrees, and"
                f" leaves its line by {np.abs(ahead.imag).max():.2f} m",
                f"a way that leaves a straight line by less than {STRAY:g} m during the scene",
            )

    def remark(self, text: str) -> None:
        """Note a remark, once."""
        self.remarks[text] = None
