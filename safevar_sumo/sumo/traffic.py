"""The bodies of scenarios that move on tracks: which body a vehicle under test sees, its distance
to all bodies, and which body it hits, from the geometry of rectangles.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.records import (
    ALL_TRUE,
    BoolArray,
    Encounter,
    FloatArray,
    IntArray,
    Quantity,
    Trace,
    nans,
)
from safevar_sumo.scenarios import Point, Scene, Track, TrackScenario
from safevar_sumo.scenarios.roads import Frame
from safevar_sumo.scenarios.tracks import SCREEN
from safevar_sumo.sumo.bodies import (
    TOUCH,
    Body,
    BodyPairs,
    Hits,
    VehicleStates,
    distance_between,
    find_overlaps,
)
from safevar_sumo.sumo.moving import TIE, Moving, Sampled, row, tracks_of

APPROACH_SPEED = 0.5
"""Closing speed above which a vehicle approaches a body ahead [m/s]. A vehicle has avoided a body
that it approached as soon as it is never faster than this body again.
"""
LEAST_DISTANCE = 1e-9
"""Lower bound of a distance that is a divisor [m]."""
LEAST_CLOSING_SPEED = 0.1
"""Lower bound of a closing speed that is a divisor [m/s]."""
OVERTIME = 30.0
"""Time by which a run is extended if its vehicle would touch somebody within this time [s]."""
STEADY = 0.05
"""Closing speed up to which a vehicle only follows a body, and does not close in on it [m/s]."""
LANE = Frame((0.0, 0.0), (1.0, 0.0))
"""Coordinates of the vehicle's lane: tracks state positions in these coordinates."""
BLOCK = 16_384
"""Number of distances that are computed at once: as many as fit into a processor's cache."""
NOBODY = -1
"""Number that stands for "the vehicle has struck no body"."""
OFF_THE_WAY, HIDDEN, PASSED, NOT_MET = 1e4, 1e5, 1e6, 1e7
"""Penalties on the gap of a body that is beside the vehicle's way, hidden, passed, or scenery [m].
The vehicle sees the body with the least gap and penalty, so that such a body is seen only if there
is no better one.
"""


class Traffic:
    """The bodies around N vehicles under test, at several points of a study.

    `group`, shape (N,), is the number of each vehicle's encounter over all points: each point has
    `n_encounters` encounters, more than 1 if parameters or phases of the point are arrays.
    """

    def __init__(
        self,
        points: Sequence[Point],
        group: IntArray,
        n_encounters: int,
        n_samples: int,
        step: float,
    ) -> None:
        scenario = points[0].scenario
        assert isinstance(scenario, TrackScenario)
        self.length = scenario.vut_length
        self.width = scenario.vut_width
        self.setback = scenario.sensor_setback
        n_groups = int(group.max()) + 1
        self.n = len(group)
        self.step = step
        # None means that columns need no index: all vehicles share a column, or have one each.
        self.group = group if 1 < n_groups < self.n else None
        self._points = points
        self._n_encounters = n_encounters
        self._sample = 0
        self._struck = np.full(self.n, NOBODY)
        self._place(n_samples)
        self._ended = np.zeros((len(self._bodies), n_samples, self.n), dtype=bool)
        # A body that comes into the path later counts as approached from the moment it does.
        self._approached = [~self._row(body.is_in_path) for body in self._bodies]

    def _place(self, n_samples: int) -> None:
        """Compute the bodies' positions at this number of samples."""
        times = (np.arange(n_samples) * self.step).astype(float)[:, None]
        vehicle = self._vehicle_body(np.zeros(1), np.zeros(1))
        self.tracks = tracks_of(
            self._points, times, self._n_encounters, self.step, vehicle
        )
        bodies = [Moving.of(track, self.step, self.width) for track in self.tracks]
        levels = np.broadcast_arrays(*(body.level for body in bodies))
        highest_level = np.maximum.reduce(levels)
        self._counts = [np.atleast_2d(body.level == highest_level) for body in bodies]
        self._is_avoidable = [bool(body.is_avoidable.any()) for body in bodies]
        screens = [body for body in bodies if body.track.kind == SCREEN]
        self._encountered = []
        self._hides = list[int]()
        for k, body in enumerate(bodies):
            # Bodies that only stand beside the path (level 0) are met only if there is no other.
            if body.level.max() >= min(highest_level.max(), 1):
                self._encountered.append(k)
            if not any(screen.covers(body) for screen in screens):
                self._hides.append(k)
        self._bodies = bodies

    def are_closing(self, motion: VehicleStates) -> BoolArray:
        """Whether each vehicle would touch a body within `OVERTIME` if its closing speed stayed as
        at the current sample (the sample of the last `hits`); shape (N,).
        """
        front = motion.fronts[None, :, 0]
        speed = motion.speeds[None]
        samples = slice(self._sample, self._sample + 1)
        closes = np.zeros(self.n, bool)
        for k in self._encountered:
            distance, rate, counts = self._approach(k, samples, front, speed)
            closes |= (counts & (rate > STEADY) & (distance < OVERTIME * rate))[0]
        return closes

    def place_until(self, n_samples: int) -> None:
        """Compute the bodies' positions up to this number of samples, if there are fewer."""
        shortage = n_samples - self._ended.shape[1]
        if shortage > 0:
            self._place(n_samples)
            self._ended = np.pad(self._ended, ((0, 0), (0, shortage), (0, 0)))

    def _row(self, column: Sampled) -> Sampled:
        """The values of a column at the current sample; see `row`."""
        return row(column, self._sample, self.group)

    def observe(self, motion: VehicleStates) -> Scene:
        """The scene at the sample of the last `hits`. Call this method at every sample, after
        `hits`: it notes when encounters end. A vehicle that touches a body sees this body.
        """
        front = motion.fronts[:, 0]
        speed = motion.speeds
        over = ALL_TRUE
        views = []
        for k in self._encountered:
            body = self._bodies[k]
            gap = self._row(body.edge) - front
            closing = speed - self._row(body.vx)
            is_behind = self._row(body.far_end) < front - self.length
            is_passed = is_behind & (speed >= self._row(body.most_vx))
            ended = np.asarray(is_passed | self._row(body.is_cleared))
            if self._is_avoidable[k]:
                self._approached[k] = self._approached[k] | (closing > APPROACH_SPEED)
                is_never_faster = (gap > 0) & (speed <= self._row(body.least_vx))
                is_avoidable = self._approached[k] & self._row(body.is_avoidable)
                ended = ended | (is_avoidable & is_never_faster)
            self._ended[k, self._sample] = ended
            counts: BoolArray = self._row(self._counts[k])
            over = over & (ended | ~counts)
            views.append(_View(k, gap, closing, is_passed, self._is_visible(k, front)))

        if len(views) == 1:
            return self._scene_of(views[0], over)
        return self._nearest(views, over)

    def _is_visible(self, number: int, front: FloatArray) -> BoolArray:
        """Whether a body exists at this sample and no other body is on the line from a vehicle's
        sensors to its middle; shape (N,) or ().
        """
        track = self._bodies[number].track
        visible = self._row(self._bodies[number].is_there)
        for k in self._hides:
            if k != number:
                x, y = self._row(track.x), self._row(track.y)
                blocks = self._blocks(self._bodies[k], front - self.setback, x, y)
                visible = visible & ~blocks
        return visible

    def _blocks(
        self, body: Moving, sensors: Quantity, x: Quantity, y: Quantity
    ) -> BoolArray:
        """Whether a body is on the line from a vehicle's sensors, in the middle of the lane, to the
        point x, y: the slab test in the body's own axes.
        """
        dx = x - sensors
        dy = y
        rx = sensors - self._row(body.track.x)
        ry = 0.0 - self._row(body.track.y)
        if not body.faces_along:
            cosine = self._row(body.track.along)
            sine = self._row(body.track.left)
            dx, dy = dx * cosine + dy * sine, dy * cosine - dx * sine
            rx, ry = rx * cosine + ry * sine, ry * cosine - rx * sine

        # Where the line enters and leaves the body, in shares: 0 at the sensors, 1 at the point.
        enter: Quantity = -np.inf
        leave: Quantity = np.inf
        for position, change, size in (
            (rx, dx, body.track.length),
            (ry, dy, body.track.width),
        ):
            half = self._row(size) / 2 + TIE
            # A line along the body divides by 0: infinite shares give the right answer.
            to_rear = (-half - position) / change
            to_front = (half - position) / change
            enter = np.maximum(enter, np.minimum(to_rear, to_front))
            leave = np.minimum(leave, np.maximum(to_rear, to_front))
        blocks = (enter < leave) & (leave > 0) & (enter < 1)
        return np.asarray(blocks & self._row(body.is_there))

    def _scene_of(self, view: _View, over: BoolArray) -> Scene:
        """The scene with the body of a view as the obstacle of all vehicles."""
        body = self._bodies[view.body]
        zeros = np.zeros(self.n)
        return Scene(
            gap=np.where(self._row(body.is_there), view.gap, np.inf),
            lateral=zeros + self._row(body.lateral),
            lateral_speed=zeros + self._row(body.lateral_speed),
            over=np.broadcast_to(over, self.n),
            obstacle_speed=zeros + self._row(body.vx),
            visible=view.visible,
            obstacle_length=zeros + 2 * self._row(body.half_length),
            obstacle_width=zeros + 2 * self._row(body.half_width),
            obstacle=zeros + view.body,
        )

    def _nearest(self, views: Sequence[_View], over: BoolArray) -> Scene:
        """The scene of the nearest visible body that is in the way or comes into the way. Without
        such a body, the scene of the nearest other body (see `OFF_THE_WAY`).
        """
        ranks = []

        for view in views:
            body = self._bodies[view.body]
            counts: BoolArray = self._row(self._counts[view.body])
            closing = np.maximum(view.closing, LEAST_CLOSING_SPEED)
            time_to_arrival = np.maximum(view.gap, 0.0) / closing
            lateral = self._row(body.track.y)
            drift = self._row(body.vy)
            is_closing = view.closing > 0
            lateral_at_arrival = lateral + drift * np.where(
                is_closing, time_to_arrival, 0.0
            )
            reach = self.width / 2 + self._row(body.half_width)
            comes = is_closing & (np.abs(lateral_at_arrival) < reach)
            # A leader who makes way, at about the vehicle's speed, is no reason to brake.
            makes_way = np.sign(lateral) * drift > 0
            leaves = makes_way & (view.closing <= APPROACH_SPEED)
            is_in_way = (self._row(body.is_in_path) & ~leaves) | comes
            rank = (
                view.gap
                + OFF_THE_WAY * ~is_in_way
                + HIDDEN * ~view.visible
                + PASSED * view.is_passed
                + NOT_MET * ~counts
            )
            ranks.append(np.where(self._struck == view.body, -np.inf, rank))

        # Scenes are computed only of bodies that are nearest to some vehicle: most are not.
        chosen = np.argmin(np.stack(ranks), axis=0)
        numbers = np.flatnonzero(np.bincount(chosen))
        scene = self._scene_of(views[numbers[0]], over)
        for number in numbers[1:]:
            is_chosen = chosen == number
            columns = zip(self._scene_of(views[number], over), scene, strict=True)
            scene = Scene(*(np.where(is_chosen, new, old) for new, old in columns))
        return scene

    def hits(
        self, sample: int, front: FloatArray, speed: FloatArray, is_open: BoolArray
    ) -> Hits:
        """Make `sample` the current sample, and return the speeds [m/s] of vehicles that touch a
        body, by vehicle number. Vehicles whose runs have ended (not `is_open`) are left out.
        """
        self._sample = sample
        self._struck = np.full(self.n, NOBODY)
        foremost = front.max()
        rear = front - self.length
        for k in self._encountered:
            body = self._bodies[k]
            if foremost <= row(body.edge, sample, None).min():
                continue
            is_beside = (
                (front > self._row(body.edge))
                & (rear < self._row(body.far_end))
                & self._row(body.is_in_path)
            )
            vehicles = np.flatnonzero(is_beside & is_open & (self._struck == NOBODY))
            if vehicles.size:
                vehicle = self._vehicle_body(front[vehicles], speed[vehicles])
                overlaps = find_overlaps(vehicle, self._body(k, vehicles))
                self._struck[vehicles[overlaps > TOUCH]] = k

        touched = np.flatnonzero(self._struck != NOBODY)
        return dict(zip(touched.tolist(), speed[touched].tolist(), strict=True))

    def bodies(
        self, vehicles: Sequence[int], front: FloatArray, speed: FloatArray
    ) -> BodyPairs:
        """Pairs of each given vehicle and the body that it touches, in lane coordinates."""
        numbers = np.asarray(vehicles)
        bodies = [self._body(k, numbers) for k in range(len(self._bodies))]
        columns = (
            np.stack(column)[self._struck[numbers], np.arange(len(numbers))]
            for column in zip(*bodies, strict=True)
        )
        return BodyPairs(
            numbers, self._vehicle_body(front[numbers], speed[numbers]), Body(*columns)
        )

    def _vehicle_body(self, front: FloatArray, speed: FloatArray) -> Body:
        return Body.behind(
            np.stack([front, np.zeros_like(front)], axis=1),
            np.tile([1.0, 0.0], (len(front), 1)),
            np.full(len(front), self.length),
            np.full(len(front), self.width),
            speed,
        )

    def _body(self, number: int, vehicles: IntArray) -> Body:
        """A body at the current sample, in the encounters of the given vehicles."""
        body = self._bodies[number]
        group = vehicles
        if self.group is not None:
            group = self.group[vehicles]
        # If a column has one value for all encounters, "clip" takes it for each of them.
        length, width, x, y, cosine, sine, speed, drift = (
            row(column, self._sample, None).take(group, mode="clip")
            for column in (*body.track[2:], body.vy)
        )
        if not body.faces_along:
            drift = np.zeros_like(drift)
        along = np.stack([cosine, sine], axis=1)
        return Body(np.stack([x, y], axis=1), along, length, width, speed, drift)

    def encounter(self, trace: Trace) -> Encounter:
        """The distance to the nearest body that still counts, and the rate at which the distance
        shrinks, at all samples of a trace. The trace's positions are the vehicles' fronts.
        """
        shape = trace.speed.shape
        n_rows = max(BLOCK // trace.speed.shape[1], 1)
        distance = np.full(shape, np.inf)
        closing = nans(shape)
        in_conflict = np.zeros(shape, bool)
        for start in range(0, shape[0], n_rows):
            samples = slice(start, min(start + n_rows, shape[0]))
            front, speed = trace.position[samples], trace.speed[samples]
            for k in self._encountered:
                separation, rate, counts = self._approach(k, samples, front, speed)
                is_nearer = counts
                if len(self._encountered) > 1:
                    is_nearer = counts & (separation < distance[samples])
                np.copyto(distance[samples], separation, where=is_nearer)
                np.copyto(closing[samples], rate, where=is_nearer)
                in_conflict[samples] |= counts
        return Encounter(
            separation=distance,
            distance=distance,
            closing_speed=closing,
            in_conflict=in_conflict,
        )

    def _approach(
        self, number: int, samples: slice, front: FloatArray, speed: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """The distances between vehicles and a body at some samples [m], the rates at which they
        shrink [m/s], and whether the body counts (the encounter with it has not ended).
        """
        body = self._bodies[number]
        edge, far_end, vx, vy, y, half_width = (
            self._table(column, samples)
            for column in (
                body.edge,
                body.far_end,
                body.vx,
                body.vy,
                body.track.y,
                body.half_width,
            )
        )
        gap_ahead = edge - front
        gap_behind = front - self.length - far_end
        dx = np.maximum(np.maximum(gap_ahead, gap_behind), 0.0)
        dy = np.maximum(np.abs(y) - self.width / 2 - half_width, 0.0)
        separation = np.sqrt(dx * dx + dy * dy) if dy.any() else dx
        approach = (speed - vx) * np.where(gap_ahead > gap_behind, dx, -dx) - np.sign(
            y
        ) * vy * dy
        rate = approach / np.maximum(separation, LEAST_DISTANCE)
        if body.is_rotated:
            columns = (self._table(column, samples) for column in body.track[2:])
            track = Track(*body.track[:2], *columns)
            separation = distance_between(
                track, front - self.length / 2, self.length, self.width
            )
        counts = self._table(body.is_there & self._counts[number], samples)
        counts = counts & ~self._ended[number, samples]
        return separation, rate, counts

    def _table(self, column: Sampled, samples: slice) -> Sampled:
        """The values of a column at some samples: a value for each vehicle, or one for all."""
        if len(column) > 1:
            column = column[samples]
        if self.group is None or column.shape[1] == 1:
            return column
        return column[:, self.group]


class _View(NamedTuple):
    """A body as N vehicles meet it at a sample: its number, the gap to it [m], the closing speed
    [m/s], and whether a vehicle has passed it and sees it; all but the number have shape (N,).
    """

    body: int
    gap: FloatArray
    closing: FloatArray
    is_passed: BoolArray
    visible: BoolArray
