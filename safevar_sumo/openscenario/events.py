"""Events and acts of a storyboard, how far they are, and which events a motion depends on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from safevar_sumo.openscenario.actions import is_ignored, moves_somebody
from safevar_sumo.openscenario.actors import Actor, Running
from safevar_sumo.openscenario.document import Element, attribute
from safevar_sumo.openscenario.player import Key

STATE = "storyboardElementRef"
REFERENCES = STATE, "parameterRef", "variableRef"
"""Attributes that name what a condition asks for, and the last two what an action sets."""


@dataclass
class Event:
    """An Event (class Event): its kind and path, those of its maneuver, group, act and story, its
    actions that go on, by name, and whether it moves somebody, or sets what a motion waits for.
    """

    element: Element
    group: Element
    key: Key
    outer: list[Key]
    actors: list[Actor]
    running: dict[Key, list[Running]] = field(default_factory=dict)
    has_begun: bool = False
    has_ended: bool = False
    moves: bool = False

    @property
    def name(self) -> str:
        """The event in remarks."""
        return attribute(self.element, "name")

    @property
    def is_ignored(self) -> bool:
        """Whether no action of it has an effect."""
        return all(is_ignored(each) for each in self.element.findall("Action/*"))

    def is_asked_for(self, references: set[Key]) -> bool:
        """Whether it moves somebody by itself, or conditions ask for it or for what it sets."""
        actions = self.element.findall("Action")
        own = {(STATE, each.get("name", "")) for each in (self.element, *actions)}
        return any(moves_somebody(one) for each in actions for one in each) or bool(
            references & (own | _references(actions))
        )


@dataclass
class Act:
    """An Act (class Act) and its events."""

    element: Element
    key: Key
    events: list[Event]
    has_begun: bool = False

    @property
    def has_ended(self) -> bool:
        """Whether all of it is over."""
        return self.has_begun and all(event.has_ended for event in self.events)


def note_moving(acts: Sequence[Act]) -> None:
    """Note which events move somebody, or set what begins or ends a motion: also through further
    events. What only the storyboard's StopTrigger asks for moves nobody.
    """
    asked = set[Key]()
    count = -1
    while count < len(asked):
        count = len(asked)
        for act in acts:
            events = [event for event in act.events if event.is_asked_for(asked)]
            for event in events:
                event.moves = not event.is_ignored
            elements = [act.element, *(event.element for event in events)] if events else []
            asked |= _references(
                each for one in elements for each in one if each.tag.endswith("Trigger")
            )


def _references(elements: Iterable[Element]) -> set[Key]:
    """What conditions ask for, or what actions set: attributes, and the names in them."""
    return {
        (name, each.attrib[name].lstrip("$").rpartition("::")[2])
        for outer in elements
        for each in outer.iter()
        for name in REFERENCES
        if name in each.attrib
    }
