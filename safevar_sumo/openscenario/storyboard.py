"""A storyboard being played, with an Ego that holds its speed: motions are closed forms from one
event to the next.
"""

from __future__ import annotations

import math
from itertools import chain

import numpy as np

from safevar_sumo.openscenario.actions import INIT_ORDER, PLACING, act, leaf_of
from safevar_sumo.openscenario.actors import STEP, Unplaced
from safevar_sumo.openscenario.conditions import LEFT_TO_RUNS, REACTIONS, holds, watched
from safevar_sumo.openscenario.document import Element, attribute, number, part, truth, unsupported
from safevar_sumo.openscenario.events import Act, Event, note_moving
from safevar_sumo.openscenario.player import Key, Player
from safevar_sumo.openscenario.reading import Document
from safevar_sumo.openscenario.ways import STRAY, Way

LONGEST = 600.0
"""Time up to which the StopTrigger of a file must hold [s]."""
UNSTOPPED = 60.0
"""How long a file without a StopTrigger is played, or if only a run can tell when it holds [s]."""
AFTER = 4.0
"""Time after the StopTrigger that is played [s]: with a vehicle that brakes, all happens later."""
TIMES = np.round(np.arange(round((LONGEST + AFTER) / STEP) + 1) * STEP, 9)
"""Times of the samples of the longest scene [s]."""
CRITERIA = "criteria_"
"""What names of conditions begin with that are criteria of CARLA's scenario runner."""
BLOCK = 1000
"""Samples that are played at once at most."""


def _below(outer: Key, element: Element) -> Key:
    """The key of an element within another one."""
    return element.tag.lower(), f"{outer[1]}::{attribute(element, 'name')}"


def _stop_trigger(element: Element) -> Element | None:
    """The StopTrigger of a storyboard or an act; None also for an empty one, which never holds."""
    stop = element.find("StopTrigger")
    return stop if stop is not None and len(stop) else None


class Storyboard(Player):
    """A storyboard being played; see `play`."""

    def __init__(self, document: Document, ego: str) -> None:
        super().__init__(document, ego, TIMES)
        self.reactions: list[tuple[Key, str]] = []
        """Elements that move somebody and wait for what Ego does, and how they do."""
        self._changes = 0
        """How many events have begun or ended."""
        self.stop = math.inf
        self.is_cut = False
        """Whether the scene ends where Ego's way bends, before its StopTrigger holds."""
        self._board = part(document.root, "Storyboard")
        self._leave_out_criteria()
        self._refuse_states_of_nothing()
        self.acts = [
            self._act(each, ("story", attribute(story, "name")))
            for story in self._board.findall("Story")
            for each in story.findall("Act")
        ]
        self.all_events = [event for one in self.acts for event in one.events]
        note_moving(self.acts)
        self.moving = [event for event in self.all_events if event.moves]
        for one in self.acts:
            self._note_reactions(one)

    def _act(self, element: Element, story: Key) -> Act:
        act_key = _below(story, element)
        events = []
        for group in element.findall("ManeuverGroup"):
            actors = part(group, "Actors")
            group_key = _below(act_key, group)
            if truth(actors, "selectTriggeringEntities"):
                raise unsupported(
                    "Actors with selectTriggeringEntities = true is not supported",
                    "selectTriggeringEntities = false, and EntityRef for each actor",
                )
            own = [self.other(each) for each in actors.findall("EntityRef")]
            for maneuver in group.findall("Maneuver"):
                key = _below(group_key, maneuver)
                outer = [key, group_key, act_key, story]
                events += [
                    Event(event, group, _below(key, event), outer, own)
                    for event in maneuver.findall("Event")
                ]
        return Act(element, act_key, events)

    def _leave_out_criteria(self) -> None:
        """Leave out conditions of the StopTrigger by which CARLA's scenario runner judges a run."""
        for outer in self._board.findall("StopTrigger"):
            for group in outer.findall("ConditionGroup"):
                for one in group.findall("Condition"):
                    name = one.get("name", "")
                    if name.startswith(CRITERIA) and one.find(".//ParameterCondition") is not None:
                        self.ignored.add(name)
                        group.remove(one)
                if not len(group):
                    outer.remove(group)

    def _refuse_states_of_nothing(self) -> None:
        """Refuse conditions on the state of an element that the storyboard does not have."""
        for one in self._board.iter("StoryboardElementStateCondition"):
            kind, name = (attribute(one, f"storyboardElement{each}") for each in ("Type", "Ref"))
            found = [self._board]
            for each in name.split("::"):
                found = [
                    inner for outer in found for inner in outer.iter() if inner.get("name") == each
                ]
            if kind.lower() not in [element.tag.lower() for element in found]:
                raise unsupported(
                    f"{one.tag}: storyboardElementRef = {name!r}",
                    f"the name of a storyboard's {kind}",
                )

    def _refuse_repeats(self) -> None:
        """Refuse events that could begin again, by a count of theirs or of their group."""
        for event in self.all_events:
            may_begin = event.moves or (event.running and not event.is_ignored)
            for element in (event.element, event.group) if may_begin else ():
                times = number(element, "maximumExecutionCount", 1)
                key = event.key if element is event.element else event.outer[1]
                if times <= 1:
                    continue
                kind = "event" if element is event.element else "group"
                name = f"the {kind} {attribute(element, 'name')}"
                ended = self.ended.get(key, math.inf)
                again = round(min(ended / STEP, self.sample)) + 1
                rest = slice(again, self.sample + 1)
                holds(self, event.element.find("StartTrigger"), slice(1, again))
                if holds(self, event.element.find("StartTrigger"), rest).any():
                    raise unsupported(
                        f"{name} could begin again after {ended:.1f} s, up to {times:g} times",
                        "maximumExecutionCount = 1",
                    )
                self.remark(f"{name} is played once, of up to {times:g} times")

    def _note_reactions(self, one: Act) -> None:
        moving = [(event.key, event.element) for event in one.events if event.moves]
        for key, element in [(one.key, one.element), *moving] if moving else ():
            for kind in watched(self, element.find("StartTrigger")):
                if kind in REACTIONS:
                    waiting = f"the {element.tag.lower()} {attribute(element, 'name')}"
                    self.reactions.append((key, f"{waiting} waits for a {kind}"))

    def _refuse_reactions(self) -> None:
        """Refuse an act and an event that move somebody, if only a run can begin them: Ego's speed
        is known while a robot drives it.
        """
        end = self.profile.end_time
        # What holds at the last sample of the profile may begin one sample later.
        known = end + 2 * STEP
        for key, waits in self.reactions:
            if not end or min(self.begun.get(key, math.inf), self.now) >= known:
                raise unsupported(
                    f"{waits} of {self.ego.name}, which only a run can tell",
                    "a condition on time, places or others",
                )

    def initialise(self) -> None:
        """Class Init: places first, then speeds, then all others, as the order of the list is none
        in time.
        """
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
            except Unplaced:
                if leaf_of(action).tag not in PLACING or waiting == 1:
                    raise
                places_left = sum(leaf_of(other).tag in PLACING for _, other in privates)
                privates.insert(places_left, (actor, action))
                waiting -= 1
            else:
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
            for one in self.acts:
                if not one.has_begun and holds(self, one.element.find("StartTrigger"), now)[0]:
                    one.has_begun = True
                    self.begun.setdefault(one.key, self.now)
                    self._note_ego(one.element)
                if one.has_begun and one.key not in self.ended:
                    self._settle_act(one, now)
            is_settled = before == (len(self.begun), len(self.ended), self._changes)
        for actor in self.actors.values():
            actor.note(self.sample)

    def _settle_act(self, one: Act, now: slice) -> None:
        stop = _stop_trigger(one.element)
        is_stopped = stop is not None and bool(holds(self, stop, now)[0])
        for event in one.events:
            if is_stopped and not event.has_ended:
                self._cut(event)
            elif not event.has_begun and holds(self, event.element.find("StartTrigger"), now)[0]:
                self._begin(event, one)
            if event.has_begun and not event.has_ended:
                self._finish(event)
        for key in dict.fromkeys(chain(*(event.outer for event in one.events))):
            self.begun.setdefault(key, self.now)
            if all(event.has_ended for event in self.all_events if key in event.outer):
                self.ended.setdefault(key, self.now)
        if not one.events:
            self.ended.setdefault(one.key, self.now)

    def _begin(self, event: Event, one: Act) -> None:
        """Begin an event: `override` ends the others of its maneuver, `skip` waits for none."""
        priority = event.element.get("priority", "parallel")
        under_way = [other for other in one.events if other.has_begun and not other.has_ended]
        others = [other for other in under_way if other is not event and other.outer == event.outer]
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
            key = _below(event.key, action)
            self.begun.setdefault(key, self.now)
            event.running[key] = [
                running for each in action for running in act(self, each, event.actors)
            ]

    def _finish(self, event: Event) -> None:
        done = [
            key
            for key, running in event.running.items()
            if all(one.is_done(self.now) for one in running)
        ]
        for key in done:
            self.ended.setdefault(key, self.now)
        if len(done) == len(event.running):
            self._end(event)

    def _end(self, event: Event) -> None:
        event.has_begun = True
        event.has_ended = True
        self._changes += 1
        self.begun.setdefault(event.key, self.now)
        self.ended.setdefault(event.key, self.now)

    def _cut(self, event: Event) -> None:
        """End an event before its time."""
        for key, running in event.running.items():
            for one in running:
                for actor in event.actors:
                    actor.end(one)
            self.ended.setdefault(key, self.now)
        self._end(event)

    def _note_ego(self, element: Element) -> None:
        for kind in watched(self, element.find("StartTrigger")):
            self.depends(
                self.ego,
                self.now,
                f"{element.tag} {attribute(element, 'name')}: {kind} of {self.ego.name}",
            )

    def _next(self, last: int) -> int:
        """The first sample up to the last of a block at which something may begin or end."""
        running = chain(*(chain(*event.running.values()) for event in self.all_events))
        ends = [
            math.ceil((one.end - 1e-9) / STEP) for one in running if self.now < one.end < math.inf
        ]
        last = min([last, *(sample for sample in ends if sample > self.sample)])
        window = slice(self.sample + 1, last + 1)
        triggers = [_stop_trigger(self._board)] if math.isinf(self.stop) else []
        for one in self.acts:
            if not one.has_begun:
                triggers.append(one.element.find("StartTrigger"))
            elif not one.has_ended:
                triggers += [
                    event.element.find("StartTrigger")
                    for event in one.events
                    if not event.has_begun
                ]
                triggers.append(_stop_trigger(one.element))
        for trigger in triggers:
            if trigger is not None:
                is_true = holds(self, trigger, window)
                if is_true.any():
                    last = min(last, window.start + int(np.argmax(is_true)))
        return last

    def play(self) -> None:
        """Play up to the end."""
        self.initialise()
        stop = _stop_trigger(self._board)
        longest = UNSTOPPED if stop is None or LEFT_TO_RUNS & {*watched(self, stop)} else LONGEST
        final = round(longest / STEP)
        while True:
            self.settle()
            is_asked = stop is not None and math.isinf(self.stop)
            if is_asked and holds(self, stop, slice(self.sample, self.sample + 1))[0]:
                self.stop = self.now
                final = self.sample + round(AFTER / STEP)
            if self.sample >= final:
                break
            last = min(final, self.sample + BLOCK)
            for actor in sorted(self.actors.values(), key=lambda one: one.follows is not None):
                actor.move(self.sample, last, self.times)
            last = self._next(last)
            end = self._road_end(last)
            if end < last:
                last = end
                final = end
            for actor in self.actors.values():
                actor.arrive(last)
            self.sample = last
        self._refuse_reactions()
        self._refuse_repeats()
        if math.isinf(self.stop) and self.now >= longest:
            if longest == LONGEST:
                legal = f"one that does, if {self.ego.name} keeps its speed"
                raise unsupported(f"the StopTrigger does not hold within {LONGEST:g} s", legal)
            self.remark(
                f"the scene ends at {UNSTOPPED:g} s: it has no StopTrigger, or one that waits for"
                f" {self.ego.name}"
            )

    def _road_end(self, last: int) -> int:
        """The last sample at which all actors are on their roads."""
        end = last
        for name, actor in self.actors.items():
            path = actor.here.path
            if isinstance(path, Way):
                is_beyond = actor.distance[self.sample + 1 : last + 1] > path.length + 1e-6
                before = self.sample + int(np.argmax(is_beyond))
                if is_beyond.any() and before < end:
                    end = before
                    self.remark(
                        f"the scene ends at {self.times[end]:.1f} s, when {name} is at the end of"
                        " its road"
                    )
        return self._straight_end(end)

    def events(self) -> list[tuple[str, str, float, float]]:
        """Events that move somebody, in their order: names, actors, and times of both ends [s]."""
        found = [
            (
                event.name,
                ", ".join(actor.name for actor in event.actors),
                self.begun.get(event.key, math.nan) if event.running else math.nan,
                self.ended.get(event.key, math.nan) if event.running else math.nan,
            )
            for event in self.moving
        ]
        return sorted(found, key=lambda one: math.inf if math.isnan(one[2]) else one[2])

    def refuse_bend(self) -> None:
        """Refuse an Ego whose way bends in the next seconds of driving."""
        if self.has_begun:
            last = self.sample + round(UNSTOPPED / STEP)
            self.ego.move(self.sample, min(last, len(self.times) - 1), self.times)
            self.refuse_turn(self.ego.place[: last + 1])

    def _straight_end(self, last: int) -> int:
        """The last sample at which Ego is on its line, once all that the file says has happened."""
        is_over = bool(self.moving) and all(one.has_ended for one in self.moving)
        if math.isinf(self.stop) and not is_over:
            return last
        places = self.ego.place[: last + 1]
        is_aside = np.abs(((places - places[0]) / self.ego.facing[0]).imag) >= STRAY
        if not is_aside[self.sample :].any() or is_aside[: self.sample + 1].any():
            return last
        end = int(np.argmax(is_aside)) - 1
        self.is_cut = math.isinf(self.stop)
        self.remark(f"the scene ends at {self.times[end]:.1f} s, when {self.ego.name}'s way bends")
        return end
