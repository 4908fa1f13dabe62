"""A storyboard being played, with an Ego that holds its speed: motions are closed forms from one event to the next."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError, one_of
from safevar_sumo.openscenario.actions import INIT_ORDER, act, is_ignored, leaf_of
from safevar_sumo.openscenario.actors import STEP, Actor, Array, Running, Shape, actors_of
from safevar_sumo.openscenario.conditions import BY_ENTITY, BY_VALUE, REACTIONS
from safevar_sumo.openscenario.document import (
    Document,
    Element,
    attribute,
    is_number,
    number,
    part,
    read,
    unsupported,
    violated,
)
from safevar_sumo.openscenario.places import Place, Way, place_of, turn_of
from safevar_sumo.openscenario.road import Pose, read_network

LONGEST = 60.0
"""Longest scene [s]: how long a file without a StopTrigger that holds is played."""
AFTER = 4.0
"""Time after the StopTrigger that is played [s]: with a vehicle that brakes, all happens later."""
BLOCK = 500
"""Samples that are played at once at most."""
MAX_TURN = 0.01
"""Largest turn of an Ego that drives straight on [degrees]."""


class Moved(NamedTuple):
    """How an entity moves: its shape, the places of its middle, directions and speeds at all samples, and the time at
    which it is deleted [s].
    """

    name: str
    shape: Shape
    place: Array
    facing: Array
    speed: Array
    deleted: float


class Played(NamedTuple):
    """A scene: Ego's shape, the pose of the middle of its front at the start, and its speed [m/s]; the others; the
    length [s]; the time until which a motion depends on Ego, and what depends on it; remarks; the files that were read;
    and the file's parameters that are numbers.
    """

    ego: Shape
    start: Pose
    speed: float
    others: list[Moved]
    duration: float
    depends_until: float
    dependence: str
    remarks: list[str]
    files: list[str]
    numbers: list[str]


@dataclass
class Event:
    """An Event (class Event) of a maneuver, a group and an act, and its actions that go on, by name."""

    element: Element
    names: tuple[tuple[str, str], ...]
    actors: list[Actor]
    running: dict[str, list[Running]] = field(default_factory=dict)
    has_begun: bool = False
    has_ended: bool = False

    @property
    def key(self) -> tuple[str, str]:
        """The event in conditions on states."""
        return "event", attribute(self.element, "name")

    @property
    def moves(self) -> bool:
        """Whether an action of it moves somebody."""
        return not all(is_ignored(each) for each in self.element.findall("Action/*"))


@dataclass
class Act:
    """An Act (class Act) and its events."""

    element: Element
    events: list[Event]
    has_begun: bool = False

    @property
    def key(self) -> tuple[str, str]:
        """The act in conditions on states."""
        return "act", attribute(self.element, "name")

    @property
    def has_ended(self) -> bool:
        """Whether all of it is over."""
        return self.has_begun and all(event.has_ended for event in self.events)


class Player:
    """A storyboard being played; see `play`."""

    def __init__(self, document: Document, ego: str, longest: float) -> None:
        self.document = document
        self.network = read_network(document.road)
        self.times = np.round(np.arange(round(longest / STEP) + 1) * STEP, 9)
        actors = {actor.name: actor for actor in actors_of(document.root, len(self.times))}
        if ego not in actors:
            raise unsupported(
                f"no ScenarioObject is named {ego!r}; there are: {', '.join(actors)}", f"ego = {one_of(actors)}"
            )
        self.actors, self.ego, self.sample = actors, actors[ego], 0
        self.variables = {
            attribute(each, "name"): attribute(each, "value")
            for each in document.root.findall("VariableDeclarations/VariableDeclaration")
        }
        self.begun: dict[tuple[str, str], float] = {}
        self.ended: dict[tuple[str, str], float] = {}
        self.dependences: dict[str, float] = {}
        self.remarks: dict[str, None] = {}
        self.ignored: set[str] = set()
        self.has_begun, self._changes = False, 0
        """Whether Init is over; how many events have begun or ended."""
        self.stop = math.inf
        self._seen: dict[int, tuple[int, Array]] = {}
        self._board = part(document.root, "Storyboard")
        self._acts = [self._act(each) for each in self._board.findall("Story/Act")]

    # What actions and conditions ask

    @property
    def now(self) -> float:
        """The time [s]."""
        return float(self.times[self.sample])

    def actor(self, name: str) -> Actor:
        """The entity of this name."""
        if name not in self.actors:
            raise unsupported(f"no ScenarioObject is named {name!r}; there are: {', '.join(self.actors)}")
        return self.actors[name]

    def other(self, element: Element) -> Actor:
        """The entity that an element refers to."""
        return self.actor(attribute(element, "entityRef"))

    def place_of(self, name: str) -> Place:
        """The place of an entity now."""
        return self.actor(name).here

    def place(self, position: Element) -> Place:
        """The place that the child of a Position names."""
        return place_of(position, self.network, self.place_of)

    def depends(self, other: Actor, until: float, what: str) -> None:
        """Note what depends on Ego, and until when [s]."""
        if other is self.ego and (self.sample or until > self.now):
            self.dependences[what] = max(until, self.dependences.get(what, 0.0))

    def ego_turns(self, facings: Array) -> None:
        """Refuse directions of Ego that differ from the one at the start."""
        turn = max(turn_of(complex(facing), self.ego.here.pose.facing) for facing in np.unique(facings))
        if turn > MAX_TURN:
            raise unsupported(f"{self.ego.name} does not drive straight on: it turns by {turn:.1f} degrees")

    def remark(self, text: str) -> None:
        """Note a remark, once."""
        self.remarks[text] = None

    # Triggers

    def _holds(self, trigger: Element | None, window: slice) -> Array:
        """At which samples of a window a trigger (class Trigger) holds; without one at all."""
        holds = np.full(window.stop - window.start, trigger is None)
        for group in () if trigger is None else trigger.findall("ConditionGroup"):
            conditions = [self._condition(each, window) for each in group.findall("Condition")]
            holds = holds | np.logical_and.reduce(conditions)
        return holds

    def _condition(self, condition: Element, window: slice) -> Array:
        """Class Condition: with its edge, after its delay; it is unknown before it is asked for the first time."""
        first, seen = self._seen.setdefault(id(condition), (window.start, np.zeros(len(self.times) + 1, bool)))
        seen[window] = self._value(condition, window)
        samples = np.arange(window.start, window.stop) - round(number(condition, "delay", 0.0) / STEP)
        now = (samples >= first) & seen[samples]
        edge = condition.get("conditionEdge", "none")
        if edge == "none":
            return now
        has_before, before = samples > first, seen[samples - 1]
        match edge:
            case "rising":
                return now & has_before & ~before
            case "falling":
                return (samples >= first) & ~seen[samples] & has_before & before
            case "risingOrFalling":
                return has_before & (seen[samples] != before)
        raise unsupported(f"conditionEdge {edge} is not supported")

    def _value(self, condition: Element, window: slice) -> Array:
        kind = part(condition, "*")
        inner = part(kind, "EntityCondition/*" if kind.tag == "ByEntityCondition" else "*")
        if kind.tag == "ByValueCondition" and inner.tag in BY_VALUE:
            return BY_VALUE[inner.tag](self, inner, window)
        if kind.tag != "ByEntityCondition" or inner.tag not in BY_ENTITY:
            raise unsupported(f"{inner.tag} is not supported")
        triggering = part(kind, "TriggeringEntities")
        actors = [self.other(each) for each in triggering.findall("EntityRef")]
        values = [BY_ENTITY[inner.tag](self, inner, actor, window) & (actor.deleted > self.now) for actor in actors]
        join = np.logical_or if triggering.get("triggeringEntitiesRule") == "any" else np.logical_and
        return join.reduce(values)

    def _watched(self, trigger: Element | None) -> list[str]:
        """Conditions of a trigger that watch Ego."""
        found, name = [], self.ego.name
        for kind in () if trigger is None else trigger.iter("ByEntityCondition"):
            inner = part(kind, "EntityCondition/*")
            if any(each.get("entityRef") == name for each in kind.iter()):
                found.append(inner.tag)
        return found

    # The storyboard

    def _act(self, element: Element) -> Act:
        events, act_name = [], ("act", attribute(element, "name"))
        for group in element.findall("ManeuverGroup"):
            actors = part(group, "Actors")
            if actors.get("selectTriggeringEntities") == "true":
                raise unsupported("Actors with selectTriggeringEntities = true is not supported")
            own = [self.other(each) for each in actors.findall("EntityRef")]
            for maneuver in group.findall("Maneuver"):
                names = ("maneuver", attribute(maneuver, "name")), ("maneuvergroup", attribute(group, "name")), act_name
                events += [Event(event, names, own) for event in maneuver.findall("Event")]
        return Act(element, events)

    def initialise(self) -> None:
        """Class Init: places first, then speeds, then all others, as the order of the list is none in time."""
        init = self._board.findall("Init/Actions/*")
        privates = [(self.other(one), each) for one in init if one.tag == "Private" for each in one]
        ranks = {name: rank for rank, names in enumerate(INIT_ORDER) for name in names}
        privates.sort(key=lambda one: ranks.get(leaf_of(one[1]).tag, len(ranks)))
        # A position may refer to an entity that comes later in the list.
        waiting = len(privates)
        while privates and waiting:
            actor, action = privates.pop(0)
            try:
                act(self, action, [actor])
            except InputError:
                if leaf_of(action).tag != "TeleportAction" or waiting == 1:
                    raise
                privates.insert(sum(leaf_of(one[1]).tag == "TeleportAction" for one in privates), (actor, action))
                waiting -= 1
                continue
            waiting = len(privates)
        for one in init:
            if one.tag != "Private":
                act(self, one, [])
        self.has_begun = True
        for actor in self.actors.values():
            actor.note(0)

    def settle(self) -> None:
        """Begin and end all that begins and ends now."""
        now = slice(self.sample, self.sample + 1)
        is_settled = False
        while not is_settled:
            before = len(self.begun), len(self.ended), self._changes
            for one in self._acts:
                if not one.has_begun and self._holds(one.element.find("StartTrigger"), now)[0]:
                    one.has_begun = True
                    self.begun.setdefault(one.key, self.now)
                    self._note_ego(one.element)
                    self._check(one)
                if one.has_begun and one.key not in self.ended:
                    self._settle_act(one, now)
            is_settled = before == (len(self.begun), len(self.ended), self._changes)
        for actor in self.actors.values():
            actor.note(self.sample)

    def _settle_act(self, one: Act, now: slice) -> None:
        stop = one.element.find("StopTrigger")
        is_stopped = stop is not None and len(stop) > 0 and bool(self._holds(stop, now)[0])
        for event in one.events:
            if is_stopped and not event.has_ended:
                self._cut(event)
            elif not event.has_begun and self._holds(event.element.find("StartTrigger"), now)[0]:
                self._begin(event, one)
            if event.has_begun and not event.has_ended:
                self._finish(event)
        for place in range(3):  # maneuvers, groups and the act
            for name in dict.fromkeys(event.names[place] for event in one.events):
                self.begun.setdefault(name, self.now)
                if all(event.has_ended for event in one.events if event.names[place] == name):
                    self.ended.setdefault(name, self.now)
        if not one.events:
            self.ended.setdefault(one.key, self.now)

    def _check(self, one: Act) -> None:
        """Refuse events that only a run can begin."""
        for event in one.events:
            for kind in self._watched(event.element.find("StartTrigger")) if event.moves else ():
                if kind in REACTIONS:
                    waits = f"the event {event.key[1]} waits for a {kind} of {self.ego.name}"
                    raise unsupported(f"{waits}, which only a run can tell")

    def _begin(self, event: Event, one: Act) -> None:
        """Begin an event: `override` ends the others of its maneuver, `skip` waits for none."""
        priority = event.element.get("priority", "parallel")
        others = [
            other
            for other in one.events
            if other is not event and other.names == event.names and other.has_begun and not other.has_ended
        ]
        event.has_begun = True
        self._changes += 1
        self.begun.setdefault(event.key, self.now)
        if priority == "skip" and others:
            self._cut(event)
            return
        if priority in ("override", "overwrite"):
            for other in others:
                self._cut(other)
        if event.moves:
            self._note_ego(event.element)
        for action in event.element.findall("Action"):
            name = attribute(action, "name")
            self.begun.setdefault(("action", name), self.now)
            event.running[name] = [running for each in action for running in act(self, each, event.actors)]

    def _finish(self, event: Event) -> None:
        done = [name for name, running in event.running.items() if all(one.is_done(self.now) for one in running)]
        for name in done:
            self.ended.setdefault(("action", name), self.now)
        if len(done) == len(event.running):
            self._end(event)

    def _end(self, event: Event) -> None:
        event.has_begun = event.has_ended = True
        self._changes += 1
        self.begun.setdefault(event.key, self.now)
        self.ended.setdefault(event.key, self.now)

    def _cut(self, event: Event) -> None:
        """End an event before its time."""
        for name, running in event.running.items():
            for one in running:
                for actor in event.actors:
                    actor.end(one)
            self.ended.setdefault(("action", name), self.now)
        self._end(event)

    def _note_ego(self, element: Element) -> None:
        for kind in self._watched(element.find("StartTrigger")):
            self.depends(self.ego, self.now, f"{element.tag} {attribute(element, 'name')}: {kind} of {self.ego.name}")

    def _next(self, last: int) -> int:
        """The first sample up to the last of a block at which something may begin or end."""
        ends = [
            one.end for each in self._acts for event in each.events for all_ in event.running.values() for one in all_
        ]
        samples = [math.ceil((end - 1e-9) / STEP) for end in ends if self.now < end < math.inf]
        last = min([last, *(sample for sample in samples if sample > self.sample)])
        window = slice(self.sample + 1, last + 1)
        stop = self._board.find("StopTrigger")
        triggers = [stop] if stop is not None and len(stop) and math.isinf(self.stop) else []
        for one in self._acts:
            if not one.has_begun:
                start = one.element.find("StartTrigger")
                triggers += [] if start is None else [start]
            elif not one.has_ended:
                waiting = [event.element.find("StartTrigger") for event in one.events if not event.has_begun]
                triggers += [trigger for trigger in waiting if trigger is not None]
                end = one.element.find("StopTrigger")
                triggers += [end] if end is not None and len(end) else []
        for trigger in triggers:
            holds = self._holds(trigger, window)
            if holds.any():
                last = min(last, window.start + int(np.argmax(holds)))
        return last

    def play(self) -> None:
        """Play up to the end."""
        self.initialise()
        stop, final = self._board.find("StopTrigger"), len(self.times) - 1
        while True:
            self.settle()
            is_asked = math.isinf(self.stop) and stop is not None and len(stop) > 0
            if is_asked and self._holds(stop, slice(self.sample, self.sample + 1))[0]:
                self.stop = self.now
                final = min(final, self.sample + round(AFTER / STEP))
            if self.sample >= final:
                return
            last = min(final, self.sample + BLOCK)
            for actor in sorted(self.actors.values(), key=lambda one: one.follows is not None):
                actor.move(self.sample, last, self.times)
            last = self._next(last)
            if (end := self._road_end(last)) < last:
                final = last = end
            for actor in self.actors.values():
                actor.arrive(last)
            self.sample = last

    def _road_end(self, last: int) -> int:
        """The last sample at which all actors are on their roads."""
        found = last
        for name, actor in self.actors.items():
            path = actor.here.path
            if isinstance(path, Way):
                beyond = actor.distance[self.sample + 1 : last + 1] > path.length + 1e-6
                if beyond.any() and self.sample + int(np.argmax(beyond)) < found:
                    found = self.sample + int(np.argmax(beyond))
                    self.remark(f"the scene ends at {self.times[found]:.1f} s, when {name} is at the end of its road")
        return found


def play(file: str, values: Mapping[str, str], ego: str = "Ego", longest: float = LONGEST) -> Played:
    """Play a concrete file with some of its parameters set.

    Raises
    ------
    InputError
        With the element that is not supported.
    """
    document = read(file, values)
    if problems := violated(document.parameters, document.values):
        raise unsupported(f"the file's constraints exclude {', '.join(problems)}", "values that they allow")
    player = Player(document, ego, longest)
    player.play()
    own = player.ego
    samples = slice(0, player.sample + 1)
    player.ego_turns(own.facing[samples])
    if own.speed[0] <= 0:
        raise unsupported(f"{ego} stands at the start", "a SpeedAction in Init")
    if np.ptp(own.speed[samples]) > 1e-6:
        raise unsupported(f"{ego} does not keep its speed at the start: its driving system drives")
    others = [_moved(actor, samples) for actor in player.actors.values() if actor is not own]
    if not others:
        raise unsupported(f"nobody but {ego} is in the file", "another ScenarioObject")
    _remark(player)
    what = max(player.dependences, key=player.dependences.__getitem__, default="")
    start = own.pose(0).moved(own.shape.front, own.shape.left)
    until = min(player.dependences.get(what, 0.0), player.now)
    files = list(dict.fromkeys([file, *document.catalogs, document.road]))
    numbers = [name for name, value in document.values.items() if is_number(value)]
    return Played(
        own.shape, start, float(own.speed[0]), others, player.now, until, what, [*player.remarks], files, numbers
    )


def _moved(actor: Actor, samples: slice) -> Moved:
    place = actor.place[samples] + actor.facing[samples] * complex(actor.shape.ahead, actor.shape.left)
    return Moved(actor.name, actor.shape, place, actor.facing[samples], actor.speed[samples], actor.deleted)


def _remark(player: Player) -> None:
    """What the user should know of what was not played."""
    if player.ignored:
        player.remark(f"without effect here: {', '.join(sorted(player.ignored))}")
    for actor in player.actors.values():
        if actor.deleted < math.inf:
            player.remark(f"{actor.name} is deleted at {actor.deleted:.1f} s")
    for one in player._acts:
        for event in one.events:
            if event.moves and not event.has_begun:
                player.remark(f"the event {event.key[1]} never fires")
            if (times := number(event.element, "maximumExecutionCount", 1)) > 1:
                player.remark(f"the event {event.key[1]} is played once, of up to {times:g} times")
