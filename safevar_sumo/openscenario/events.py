"""Events and acts of a storyboard, and how far they are."""

from __future__ import annotations

from dataclasses import dataclass, field

from safevar_sumo.openscenario.actions import is_ignored
from safevar_sumo.openscenario.actors import Actor, Running
from safevar_sumo.openscenario.document import Element, attribute
from safevar_sumo.openscenario.player import Key


@dataclass
class Event:
    """An Event (class Event): its kind and path, those of its maneuver, group, act and story, and
    its actions that go on, by name.
    """

    element: Element
    group: Element
    key: Key
    outer: list[Key]
    actors: list[Actor]
    running: dict[Key, list[Running]] = field(default_factory=dict)
    has_begun: bool = False
    has_ended: bool = False

    @property
    def name(self) -> str:
        """The event in remarks."""
        return attribute(self.element, "name")

    @property
    def moves(self) -> bool:
        """Whether an action of it moves somebody."""
        return not all(is_ignored(each) for each in self.element.findall("Action/*"))


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
