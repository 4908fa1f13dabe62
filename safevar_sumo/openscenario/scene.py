"""A scene: a file that was played, as the motion of everybody but Ego."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.openscenario.actors import STEP, Actor, Array, Shape
from safevar_sumo.openscenario.document import is_number, read, unsupported, violated
from safevar_sumo.openscenario.road import Pose
from safevar_sumo.openscenario.storyboard import Player


class Moved(NamedTuple):
    """How an entity moves: its shape, the places of its middle, directions and speeds at samples (with `every` above 1
    up to the last change, after which it goes on evenly), and the time at which it is deleted [s].
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


def play(file: str, values: Mapping[str, str], ego: str = "Ego", every: int = 1) -> Played:
    """Play a concrete file with some of its parameters set, or take the scene that was played from the same files.

    What moves has `every` such sample, the first one included.

    Raises
    ------
    InputError
        With the element that is not supported.
    """
    key = file, ego, every, tuple(sorted(values.items()))
    played, stamps = _SCENES.pop(key, (None, []))
    if played is None or stamps != _stamps(played.files):
        played = _play(file, values, ego, every)
        stamps = _stamps(played.files)
    _SCENES[key] = played, stamps  # the last one is the newest
    if len(_SCENES) > KEPT_SCENES:
        del _SCENES[next(iter(_SCENES))]
    return played


EVERY = 5
"""Samples of a scene that are kept if those of a study are among them: every fifth."""
_SCENES: dict[tuple[object, ...], tuple[Played, list[tuple[int, int]]]] = {}
KEPT_SCENES = 8000
"""Number of played scenes that a process keeps: 10 s of a body that changes its motion take 8 kB with every fifth
sample. All fits of a model meet the same 7,004 encounters.
"""
EVEN = 1e-11
"""Difference of a step from that at an even speed up to which it is one [m]: what rounding leaves."""


def _stamps(files: Sequence[str]) -> list[tuple[int, int]]:
    """When files were changed, and their sizes."""
    stats = [os.stat(file) for file in files]
    return [(stat.st_mtime_ns, stat.st_size) for stat in stats]


def _play(file: str, values: Mapping[str, str], ego: str, every: int) -> Played:
    document = read(file, values)
    if problems := violated(document.parameters, document.values):
        raise unsupported(f"the file's constraints exclude {', '.join(problems)}", "values that they allow")
    player = Player(document, ego)
    player.play()
    own = player.ego
    samples = slice(0, player.sample + 1)
    player.ego_turns(own.facing[samples])
    if own.speed[0] <= 0:
        raise unsupported(f"{ego} stands at the start", "a SpeedAction in Init")
    if np.ptp(own.speed[samples]) > 1e-6:
        raise unsupported(f"{ego} does not keep its speed at the start: its driving system drives")
    kept = slice(0, player.sample + 1, every)
    others = [_moved(actor, kept) for actor in player.actors.values() if actor is not own]
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
    facing = actor.facing[samples]
    speed = actor.speed[samples]
    kept = slice(None)
    if samples.step > 1:  # who goes on evenly needs no samples
        even = np.abs(np.diff(place) - samples.step * STEP * speed[1:] * facing[1:]) < EVEN
        changes = np.flatnonzero((np.diff(speed) != 0) | (np.diff(facing) != 0) | ~even)
        kept = slice(0, int(changes[-1]) + 2 if len(changes) else 1)
    # not views that keep all samples
    return Moved(actor.name, actor.shape, place[kept].copy(), facing[kept].copy(), speed[kept].copy(), actor.deleted)


def _remark(player: Player) -> None:
    """What the user should know of what was not played."""
    if player.document.root.find("Entities/ScenarioObject/ObjectController") is not None:
        player.ignored.add("ObjectController")
    if player.ignored:
        player.remark(f"without effect here: {', '.join(sorted(player.ignored))}")
    for actor in player.actors.values():
        if actor.deleted < math.inf:
            player.remark(f"{actor.name} is deleted at {actor.deleted:.1f} s")
    for one in player.acts:
        for event in one.events:
            if event.moves and not event.has_begun:
                player.remark(f"the event {event.name} never fires")
