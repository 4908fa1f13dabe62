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
    VehicleStates,
    distance_between,
    find_overlaps,
)
from safevar_sumo.sumo.moving import TIE, Moving, Sampled, at_sample, tracks_of
from safevar_sumo.sumo.perception import of_vehicles

APPROACH_SPEED = 0.5
"""Closing speed above which a vehicle approaches a body ahead [m/s]. A vehicle has avoided a body
that it approached as soon as it is never faster than this body again.
"""
LEAST_DISTANCE_DIVISOR = 1e-9
"""Lower bound of a distance that is a divisor [m]."""
LEAST_CLOSING_DIVISOR = 0.1
"""Lower bound of a closing speed that is a divisor [m/s]."""
OVERTIME = 30.0
"""Time by which a run is extended if its vehicle would touch somebody within this time [s]."""
STEADY = 0.05
"""Closing speed up to which a vehicle only follows a body, and does not close in on it [m/s]."""
LANE = Frame((0.0, 0.0), (1.0, 0.0))
"""Coordinates of the vehicle's lane: tracks state positions in these coordinates."""
DISTANCES_AT_ONCE = 16_384
"""Number of distances that are computed at once: as many as fit into a processor's cache."""
NO_BODY = -1
"""Number that stands for "the vehicle has struck no body"."""
# Penalties on the gap of a body that is beside the vehicle's way, hidden, passed, or scenery [m].
# The vehicle sees the body with the least gap and penalty.
OFF_THE_WAY = 1e4
FAR_AWAY = 1e5
PASSED = 1e6
NOT_MET = 1e7


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
        # None if all vehicles share a column, or each has its own: then no index is needed.
        self.group = group if 1 < n_groups < self.n else None
        speeds = [point.scenario.start_speed for point in points]
        self.start_speeds = of_vehicles(speeds, n_encounters)[group]
        """Speeds of the vehicles at the start, shape (N,) [m/s]."""
        self._points = points
        self._n_encounters = n_encounters
        self._sample = 0
        self._struck = np.full(self.n, NO_BODY)
        self._place(n_samples)
        self._ended = np.zeros((len(self._bodies), n_samples, self.n), dtype=bool)
        # A body outside the path at the start counts as approached when it comes into the path.
        self._approached = [~self._at_sample(body.is_in_path) for body in self._bodies]

    def _place(self, n_samples: int) -> None:
        """Compute the bodies' positions at this number of samples."""
        times = np.arange(n_samples, dtype=float)[:, np.newaxis] * self.step
        vehicle = self._vehicle_body(np.zeros(1), np.zeros(1))
        self.tracks = tracks_of(
            self._points, times, self._n_encounters, self.step, vehicle
        )
        bodies = [Moving.of(track, self.step, self.width) for track in self.tracks]
        levels = np.broadcast_arrays(*(body.level for body in bodies))
        highest_level = np.maximum.reduce(levels)
        self._is_counted: list[BoolArray] = [
            np.atleast_2d(level == highest_level) for level in levels
        ]
        self._is_avoidable = [body.is_avoidable.any() for body in bodies]
        screens = [body for body in bodies if body.track.kind == SCREEN]
        self._encountered: list[int] = []
        self._hiders: list[int] = []
        for number, body in enumerate(bodies):
            # The ADS observes scenery only where no other body is.
            if body.level.max() >= min(highest_level.max(), 1):
                self._encountered.append(number)
            if not any(screen.covers(body) for screen in screens):
                self._hiders.append(number)
        self._bodies = bodies

    def are_closing(self, motion: VehicleStates) -> BoolArray:
        """Whether each vehicle would touch a body within `OVERTIME` if its closing speed stayed as
        at the current sample (the sample of the last `hits`); shape (N,).
        """
        front = motion.fronts[np.newaxis, :, 0]
        speed = motion.speeds[np.newaxis]
        samples = slice(self._sample, self._sample + 1)
        are_closing = np.zeros(self.n, bool)
        for number in self._encountered:
            distance, rate, is_counted = self._approach(number, samples, front, speed)
            will_touch = (rate > STEADY) & (distance < OVERTIME * rate)
            are_closing |= (is_counted & will_touch)[0]
        return are_closing

    def place_until(self, n_samples: int) -> None:
        """Compute the bodies' positions up to this number of samples, if there are fewer."""
        shortage = n_samples - self._ended.shape[1]
        if shortage > 0:
            self._place(n_samples)
            self._ended = np.pad(self._ended, ((0, 0), (0, shortage), (0, 0)))

    def _at_sample(self, column: Sampled) -> Sampled:
        """A column at this sample."""
        return at_sample(column, self._sample, self.group)

    def observe(self, motion: VehicleStates) -> Scene:
        """The scene at the sample of the last `hits`. Call this method at every sample, after
        `hits`: it notes when encounters end. A vehicle that touches a body sees this body.
        """
        front = motion.fronts[:, 0]
        speed = motion.speeds
        over = ALL_TRUE
        views = []
        for number in self._encountered:
            body = self._bodies[number]
            gap = self._at_sample(body.edge) - front
            closing = speed - self._at_sample(body.vx)
            is_behind = self._at_sample(body.far_end) < front - self.length
            is_passed = is_behind & (speed >= self._at_sample(body.most_vx))
            ended = is_passed | self._at_sample(body.is_cleared)
            if self._is_avoidable[number]:
                self._approached[number] = self._approached[number] | (
                    closing > APPROACH_SPEED
                )
                is_never_faster = (gap > 0) & (speed <= self._at_sample(body.least_vx))
                is_avoidable = self._approached[number] & self._at_sample(
                    body.is_avoidable
                )
                ended = ended | (is_avoidable & is_never_faster)
            self._ended[number, self._sample] = ended
            over = over & (ended | ~self._at_sample(self._is_counted[number]))
            views.append(
                _View(number, gap, closing, is_passed, self._is_visible(number, front))
            )

        if len(views) == 1:
            return self._scene_of(views[0], over)
        return self._nearest(views, over)

    def _is_visible(self, number: int, front: FloatArray) -> BoolArray:
        """Whether a body exists at this sample and no other body is on the line from a vehicle's
        sensors to its middle; shape (N,) or ().
        """
        body = self._bodies[number]
        x = self._at_sample(body.track.x)
        y = self._at_sample(body.track.y)
        visible = self._at_sample(body.is_there)
        for hider_number in self._hiders:
            if hider_number != number:
                hider = self._bodies[hider_number]
                visible = visible & ~self._blocks(hider, front - self.setback, x, y)
        return visible

    def _blocks(
        self, body: Moving, sensors: Quantity, x: Quantity, y: Quantity
    ) -> BoolArray:
        """Whether a body is on the line from a vehicle's sensors, in the middle of the lane, to the
        point x, y: the slab test in the body's own axes.
        """
        track = body.track
        dx = x - sensors
        dy = y
        start_x = sensors - self._at_sample(track.x)
        start_y = 0.0 - self._at_sample(track.y)
        if not body.faces_along:
            cosine = self._at_sample(track.along)
            sine = self._at_sample(track.left)
            dx, dy = dx * cosine + dy * sine, dy * cosine - dx * sine
            start_x, start_y = (
                start_x * cosine + start_y * sine,
                start_y * cosine - start_x * sine,
            )

        # Where the line enters and leaves the body, in shares: 0 at the sensors, 1 at the point.
        enter: Quantity = -np.inf
        leave: Quantity = np.inf
        axes = ((start_x, dx, track.length), (start_y, dy, track.width))
        for start, change, size in axes:
            half = self._at_sample(size) / 2 + TIE
            # A line along the body divides by 0: infinite shares give the right answer.
            rear_share = (-half - start) / change
            front_share = (half - start) / change
            enter = np.maximum(enter, np.minimum(rear_share, front_share))
            leave = np.minimum(leave, np.maximum(rear_share, front_share))
        blocks = (enter < leave) & (leave > 0) & (enter < 1)
        return np.asarray(blocks & self._at_sample(body.is_there))

    def _scene_of(self, view: _View, over: BoolArray) -> Scene:
        """The scene with the body of a view as the obstacle of all vehicles."""
        body = self._bodies[view.body]
        zeros = np.zeros(self.n)
        return Scene(
            gap=np.where(self._at_sample(body.is_there), view.gap, np.inf),
            lateral=zeros + self._at_sample(body.lateral),
            lateral_speed=zeros + self._at_sample(body.lateral_speed),
            over=np.broadcast_to(over, self.n),
            obstacle_speed=zeros + self._at_sample(body.vx),
            visible=view.visible,
            obstacle_length=zeros + 2 * self._at_sample(body.half_length),
            obstacle_width=zeros + 2 * self._at_sample(body.half_width),
            obstacle=zeros + view.body,
        )

    def _nearest(self, views: Sequence[_View], over: BoolArray) -> Scene:
        """The scene of the nearest visible body that is in the way or comes into the way. Without
        such a body, the scene of the nearest other body (see `OFF_THE_WAY`).
        """
        ranks = []
        for view in views:
            is_counted = self._at_sample(self._is_counted[view.body])
            rank = (
                view.gap
                + np.where(self._is_in_way(view), 0.0, OFF_THE_WAY)
                + np.where(view.visible, 0.0, FAR_AWAY)
                + np.where(view.is_passed, PASSED, 0.0)
                + np.where(is_counted, 0.0, NOT_MET)
            )
            ranks.append(np.where(self._struck == view.body, -np.inf, rank))

        # Most bodies are nearest to no vehicle: their scenes are not computed.
        nearest = np.argmin(np.stack(ranks), axis=0)
        numbers = np.unique(nearest)
        scene = self._scene_of(views[numbers[0]], over)
        for number in numbers[1:]:
            columns = zip(self._scene_of(views[number], over), scene, strict=True)
            is_nearest = nearest == number
            scene = Scene(*(np.where(is_nearest, new, old) for new, old in columns))
        return scene

    def _is_in_way(self, view: _View) -> BoolArray:
        """Whether a body is in the path of each vehicle and stays there, or will be there when the
        vehicle arrives; shape (N,) or (1,).
        """
        body = self._bodies[view.body]
        lateral = self._at_sample(body.track.y)
        drift = self._at_sample(body.vy)
        closing = np.maximum(view.closing, LEAST_CLOSING_DIVISOR)
        time_to_arrival = np.maximum(view.gap, 0.0) / closing
        lateral_at_arrival = lateral + drift * time_to_arrival
        reach = self.width / 2 + self._at_sample(body.half_width)
        will_be_in_path = (view.closing > 0) & (np.abs(lateral_at_arrival) < reach)
        # A leader at the vehicle's speed who makes way is nobody to brake for.
        makes_way = np.sign(lateral) * drift > 0
        leaves = makes_way & (view.closing <= APPROACH_SPEED)
        stays = self._at_sample(body.is_in_path) & ~leaves
        return np.asarray(stays | will_be_in_path)

    def hits(
        self, sample: int, front: FloatArray, speed: FloatArray, is_open: BoolArray
    ) -> dict[int, float]:
        """Make `sample` the current sample, and return the speeds [m/s] of vehicles that touch a
        body, by vehicle number. Vehicles whose runs have ended (not `is_open`) are left out.
        """
        self._sample = sample
        self._struck = np.full(self.n, NO_BODY)
        foremost = front.max()
        rear = front - self.length
        for number in self._encountered:
            body = self._bodies[number]
            edge = self._at_sample(body.edge)
            if foremost <= edge.min():
                continue
            is_level = (front > edge) & (rear < self._at_sample(body.far_end))
            may_touch = is_level & self._at_sample(body.is_in_path)
            vehicles = np.flatnonzero(may_touch & is_open & (self._struck == NO_BODY))
            if vehicles.size:
                vehicle = self._vehicle_body(front[vehicles], speed[vehicles])
                overlaps = find_overlaps(vehicle, self._body(number, vehicles))
                self._struck[vehicles[overlaps > TOUCH]] = number

        touched = np.flatnonzero(self._struck != NO_BODY)
        return dict(zip(touched.tolist(), speed[touched].tolist(), strict=True))

    def bodies(
        self, vehicles: Sequence[int], front: FloatArray, speed: FloatArray
    ) -> BodyPairs:
        """Pairs of each given vehicle and the body that it touches, in lane coordinates."""
        numbers = np.asarray(vehicles)
        bodies = [self._body(number, numbers) for number in range(len(self._bodies))]
        cells = self._struck[numbers], np.arange(len(numbers))
        columns = zip(*bodies, strict=True)
        struck = Body(*(np.stack(column)[cells] for column in columns))
        touching = self._vehicle_body(front[numbers], speed[numbers])
        return BodyPairs(numbers, touching, struck)

    def _vehicle_body(self, front: FloatArray, speed: FloatArray) -> Body:
        return Body.behind(
            np.stack([front, np.zeros_like(front)], axis=1),
            np.tile([1.0, 0.0], (len(front), 1)),
            self.length,
            self.width,
            speed,
        )

    def _body(self, number: int, vehicles: IntArray) -> Body:
        """A body at the current sample, in the encounters of the given vehicles."""
        body = self._bodies[number]
        # If a column has one value for all vehicles, "clip" takes it for each of them.
        length, width, x, y, cosine, sine, speed, drift = (
            self._at_sample(column).take(vehicles, mode="clip")
            for column in (*body.track.quantities.values(), body.vy)
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
        n_rows = max(DISTANCES_AT_ONCE // trace.speed.shape[1], 1)
        distance = np.full(shape, np.inf)
        closing = nans(shape)
        in_conflict = np.zeros(shape, bool)
        for start in range(0, shape[0], n_rows):
            samples = slice(start, min(start + n_rows, shape[0]))
            front = trace.position[samples]
            speed = trace.speed[samples]
            for number in self._encountered:
                separation, rate, is_counted = self._approach(
                    number, samples, front, speed
                )
                is_nearer = is_counted & (separation < distance[samples])
                np.copyto(distance[samples], separation, where=is_nearer)
                np.copyto(closing[samples], rate, where=is_nearer)
                in_conflict[samples] |= is_counted
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
        gap_ahead = self._at_samples(body.edge, samples) - front
        gap_behind = front - self.length - self._at_samples(body.far_end, samples)
        dx = np.maximum(np.maximum(gap_ahead, gap_behind), 0.0)
        closing = speed - self._at_samples(body.vx, samples)
        closing_along = closing * np.where(gap_ahead > gap_behind, dx, -dx)
        y = self._at_samples(body.track.y, samples)
        half_width = self._at_samples(body.half_width, samples)
        dy = np.maximum(np.abs(y) - self.width / 2 - half_width, 0.0)
        parting_across = np.sign(y) * self._at_samples(body.vy, samples) * dy
        separation = dx
        if dy.any():
            separation = np.sqrt(dx * dx + dy * dy)
        divisor = np.maximum(separation, LEAST_DISTANCE_DIVISOR)
        rate = (closing_along - parting_across) / divisor
        if body.is_rotated:
            columns = (
                self._at_samples(column, samples)
                for column in body.track.quantities.values()
            )
            track = Track(*body.track[:2], *columns)
            middle = front - self.length / 2
            separation = distance_between(track, middle, self.length, self.width)
        is_met = body.is_there & self._is_counted[number]
        is_counted = self._at_samples(is_met, samples) & ~self._ended[number, samples]
        return separation, rate, is_counted

    def _at_samples(self, column: Sampled, samples: slice) -> Sampled:
        """A column at some samples, for each vehicle or for all of them."""
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
