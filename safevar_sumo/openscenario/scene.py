"""A scene: a file that was played, as the motion of everybody but Ego."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.openscenario.actors import STEP, Actor, Array, Shape
from safevar_sumo.openscenario.conditions import bodies_apart
from safevar_sumo.openscenario.document import is_number, refuse_violated, unsupported, whole
from safevar_sumo.openscenario.guard import guarded
from safevar_sumo.openscenario.lines import Pose
from safevar_sumo.openscenario.reading import read
from safevar_sumo.openscenario.storyboard import Storyboard
from safevar_sumo.openscenario.ways import Way


class Moved(NamedTuple):
    """How an entity moves: its shape, the places of its middle, directions and speeds at samples
    (with `every` above 1 up to the last change, after which it goes on evenly), and the time at
    which it is deleted [s].
    """

    name: str
    shape: Shape
    place: Array
    facing: Array
    speed: Array
    deleted: float


class Played(NamedTuple):
    """A scene: Ego's shape, the pose of the middle of its front at the start, the speed that it
    keeps [m/s], and the `profile` of its speeds before, at samples up to the one at which the
    driving system is switched on; the others; the names of events, whose they are, and when they
    begin and end [s];  the length [s]; the time until which a motion depends
    on Ego, and what depends on it; remarks; the files that were read; the file's parameters that
    are numbers; and why nothing happens to Ego, "" if something does.
    """

    ego: Shape
    start: Pose
    speed: float
    profile: Array
    others: list[Moved]
    events: list[tuple[str, str, float, float]]
    duration: float
    depends_until: float
    dependence: str
    remarks: list[str]
    files: list[str]
    numbers: list[str]
    uneventful: str


def play(file: str, values: Mapping[str, str], ego: str = "Ego", every: int = 1) -> Played:
    """Play a concrete file with some of its parameters set, or take the scene that was played from
    the same files.

    What moves has `every` such sample, the first one included.

    Raises
    ------
    InputError
        With the element that is not supported.
    """
    key = file, ego, every, tuple(sorted(values.items()))
    played, stamps = _SCENES.pop(key, (None, []))
    if played is None or stamps != _stamps(played.files):
        played = guarded(_play)(file, values, ego, every)
        stamps = _stamps(played.files)
    _SCENES[key] = played, stamps  # the last one is the newest
    most = min(KEPT_SCENES, KEPT_SAMPLES // sum(len(one.speed) for one in played.others))
    while len(_SCENES) > most:
        del _SCENES[next(iter(_SCENES))]
    return played


EVERY = 5
"""Samples of a scene that are kept if those of a study are among them: every fifth."""
_SCENES: dict[tuple[object, ...], tuple[Played, list[tuple[int, int]]]] = {}
KEPT_SCENES = 8000
"""Number of played scenes that a process keeps: all fits of a model meet the same encounters,
7,004.
"""
KEPT_SAMPLES = 9_600_000
"""Number of samples of one body in all of these scenes; each takes 40 bytes."""
HALF_LANE = 1.75
"""Whoever is within this distance of Ego's path is in its lane: half of a lane of 3.5 m [m]."""
NEAR = 4.0
"""Ego follows a body that is ahead in its lane within this time of driving for this time; a body
that left the lane at most so long before Ego arrives is met, too [s]. At a time to collision of 4 s
Euro NCAP's tests begin.
"""
EVEN = 1e-11
"""Difference of a step from that at an even speed up to which it is one [m]: what rounding leaves.
"""


def _stamps(files: Sequence[str]) -> list[tuple[int, int]]:
    """When files were changed, and their sizes."""
    stats = [os.stat(file) for file in files]
    return [(stat.st_mtime_ns, stat.st_size) for stat in stats]


def _play(file: str, values: Mapping[str, str], ego: str, every: int) -> Played:
    document = read(file, values)
    refuse_violated(document.parameters, document.values)
    player = Storyboard(document, ego)
    try:
        player.play()
    except InputError:
        player.refuse_bend()  # an Ego that turns cannot be helped by other changes
        raise
    own = player.ego
    samples = slice(0, player.sample + 1)
    player.refuse_turn(own.place[samples])
    profile = player.profile.speeds(own, player.sample)
    kept = slice(0, player.sample + 1, every)
    others = [_moved(actor, kept) for actor in player.actors.values() if actor is not own]
    if not others:
        raise unsupported(f"nobody but {ego} is in the file", "another ScenarioObject")
    _remark(player)
    what = max(player.dependences, key=player.dependences.__getitem__, default="")
    start = own.pose(0).moved(own.shape.front, own.shape.left)
    until = min(player.dependences.get(what, 0.0), player.now)
    files = list(dict.fromkeys(filter(None, [file, *document.catalogs, document.road])))
    numbers = [name for name, value in document.values.items() if is_number(value)]
    speed = float(profile[-1])
    remarks = [*player.remarks]
    reason = _why_uneventful(player)
    if player.is_cut and reason:
        player.refuse_bend()
    return Played(
        own.shape,
        start,
        speed,
        profile.copy(),
        others,
        player.events(),
        player.now,
        until,
        what,
        remarks,
        files,
        numbers,
        reason,
    )


def _why_uneventful(player: Storyboard) -> str:
    """Why nothing happens to an Ego that holds its speed; "" if something does.

    Ego meets a body that it reaches, unless the body left Ego's lane long before, and one that it
    follows closely in its lane. A body that stands in its lane or crosses it needs no event.
    """
    own = player.ego
    long = round(NEAR / STEP)
    meets = has_company = False
    for actor in player.actors.values():
        if actor is own:
            continue
        apart, reach = bodies_apart(
            own, actor, slice(0, round(min(player.now, actor.deleted) / STEP) + 1)
        )
        is_in_lane = np.abs(apart.imag) < np.maximum(reach.imag, HALF_LANE)
        gap = np.abs(apart.real) - reach.real
        is_close = is_in_lane & (apart.real > 0) & (gap < NEAR * own.speed_now)
        # The last sample in Ego's lane, or of all if it is never there.
        last = int(np.flatnonzero(is_in_lane | ~is_in_lane.any())[-1])
        has_company |= bool(is_in_lane.any())
        meets |= bool((gap[: last + long] <= 0).any() or is_close.sum() >= long)
    if player.moving and not has_company and not any(one.running for one in player.moving):
        return (
            f"no event begins that moves somebody, and nobody is in {own.name}'s lane or crosses it"
        )
    return (
        ""
        if meets
        else f"the scene ends at {player.now:.1f} s, before {own.name} has come near anybody"
    )


def _moved(actor: Actor, samples: slice) -> Moved:
    place = actor.place[samples] + actor.facing[samples] * complex(
        actor.shape.ahead, actor.shape.left
    )
    facing = actor.facing[samples]
    speed = actor.speed[samples]
    if not np.isfinite(place).all():
        raise unsupported(f"{actor.name} has no place", "numbers that can be added")
    kept = slice(None)
    if samples.step > 1:  # who goes on evenly needs no samples
        even = np.abs(np.diff(place) - samples.step * STEP * speed[1:] * facing[1:]) < EVEN
        changes = np.flatnonzero((np.diff(speed) != 0) | (np.diff(facing) != 0) | ~even)
        kept = slice(0, int(changes[-1]) + 2 if len(changes) else 1)
    # not views that keep all samples
    return Moved(
        actor.name,
        actor.shape,
        place[kept].copy(),
        facing[kept].copy(),
        speed[kept].copy(),
        actor.deleted,
    )


def _remark(player: Storyboard) -> None:
    """What the user should know of what was not played, and how what was played was understood."""
    root = player.document.root
    if root.find("Entities/ScenarioObject/ObjectController") is not None:
        player.ignored.add("ObjectController")
    in_lanes = root.findall(".//LanePosition/Orientation[@type='relative']/..")
    beside = root.find(".//RelativeLanePosition/Orientation[@type='relative']")
    # In lanes to the right of the reference line both readings are the same.
    if beside is not None or any(whole(each, "laneId") > 0 for each in in_lanes):
        player.remark(
            "an Orientation relative to a lane counts from its driving direction (ASAM allows the"
            " road's, too)"
        )
    if player.profile.end_time:
        player.remark(
            f"a robot drives {player.ego.name} by the file's speeds, until the driving system is"
            f" switched on at {player.profile.end_time:.1f} s"
        )
    if not player.document.road:
        player.remark("the file names no road: a straight one is taken")
    if player.ignored:
        player.remark(f"without effect here: {', '.join(sorted(player.ignored))}")
    for actor in player.actors.values():
        path = actor.here.path
        if isinstance(path, Way) and not path.is_level:
            player.remark("without effect here: the road's elevation")
        if actor.deleted < math.inf:
            player.remark(f"{actor.name} is deleted at {actor.deleted:.1f} s")
    for event in player.moving:
        if not event.running:
            player.remark(f"the event {event.name} never fires")
