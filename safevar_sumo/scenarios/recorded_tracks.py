"""A scenario in which other road users move as a table beside the study says."""

from __future__ import annotations

import os
import re
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from safevar_sumo.errors import InputError, one_of, warn
from safevar_sumo.output import read_file
from safevar_sumo.records import FloatArray, Quantity
from safevar_sumo.scenarios.ahead import VEHICLE_SPEED
from safevar_sumo.scenarios.base import Grade
from safevar_sumo.scenarios.tracks import Speed, Track, TrackScenario
from safevar_sumo.study import Table

if TYPE_CHECKING:
    import pandas as pd

TRACK_COLUMNS = ["time", "name", "x", "y", "heading", "speed", "length", "width"]
"""Columns that a table of tracks must have."""
ABOVE_ZERO = ["name", "length", "width"]
"""Columns whose values must not be empty or 0."""
LONGEST_PAUSE = 2.0
"""Longest time between two rows of a body, as a multiple of the table's median step [-]."""
WIDEST_PERSON = 1.2
"""Largest width of a body that may be a person, and therefore wider than long [m]."""
LEAST_WAY_DIFFERENCE = 1.0
"""Distance between two ways that are told from each other [m]."""
SAME_TIME = 1e-6
"""Difference up to which two times count as equal [s]."""
PLACE_DECIMALS = 9
"""Decimals of places [m] and of directions. The last bits of a sine differ between machines."""


class RecordedTracks(TrackScenario, Table, dict=True, frozen=True, kw_only=True):
    """Others move as a table says, whatever the vehicle does. It begins at the first row of `ego`,
    with that body's size, and drives straight on. For `speed` and `grade` see `LaneTest`.

    Parameters
    ----------
    file
        Path of a CSV file, relative to the study's, with the columns time [s], name, x and y of a
        body's middle [m], heading counter-clockwise [rad], speed [m/s], length and width [m].
    ego
        The name of the vehicle under test in the file.
    """

    file: str
    ego: str = "ego"
    speed: Annotated[Speed, VEHICLE_SPEED] = 40.0
    grade: Grade = 0.0
    # After the last row of the table, no obstacle exists.
    goes_on = False

    @cached_property
    def _bodies(self) -> dict[str, pd.DataFrame]:
        return read_tracks(self.file)

    @cached_property
    def _start(self) -> pd.Series:
        """The first row of `ego` in the table."""
        if self.ego in self._bodies:
            return self._bodies[self.ego].iloc[0]
        raise InputError(
            "",
            f"scenario.parameters.ego = {self.ego!r}: the file has no row of it",
            one_of(self._bodies),
        )

    def check(self) -> None:
        """Refuse a file in which nobody else moves after the start of `ego`. Warn of bodies that
        are wider than long.
        """
        if self.duration <= 0:
            raise InputError(
                "",
                f"{key_of(self.file)}: nobody else is there once {self.ego} is",
                "rows of another name, and of a later time",
            )
        for remark in self.remarks():
            warn(remark)

    @property
    def duration(self) -> float:
        """The time from the first row of `ego` to the last row of any other body [s]."""
        ends = [
            rows["time"].iloc[-1]
            for name, rows in self._bodies.items()
            if name != self.ego
        ]
        return float(max(ends, default=-np.inf) - self._start["time"])

    @property
    def test_speed(self) -> Quantity:
        """Speed that the vehicle holds until its driving system acts [m/s]."""
        return self.start_speed

    @property
    def vut_length(self) -> float:
        """Length of `ego` [m]."""
        return float(self._start["length"])

    @property
    def vut_width(self) -> float:
        """Width of `ego` [m]."""
        return float(self._start["width"])

    def remarks(self) -> list[str]:
        """A remark on bodies that are wider than long, except those that may be persons."""
        remarks = []
        for name, rows in self._bodies.items():
            length, width = rows[["length", "width"]].max()
            if width > max(length, WIDEST_PERSON):
                remarks.append(
                    f"{key_of(self.file)}: {name} is {length:g} m long and {width:g} m wide; length"
                    " is along its heading"
                )
        return remarks

    def tracks(self, times: FloatArray) -> list[Track]:
        """The tracks of all bodies except `ego`. A body has no size before its first row and after
        its last row: then it does not exist.
        """
        start = self._start
        direction = np.exp(1j * start["heading"])
        front = start["x"] + 1j * start["y"] + start["length"] / 2 * direction
        sample_times = times + start["time"]
        tracks = []
        for name, rows in self._bodies.items():
            if name != self.ego:
                row_times = rows["time"].to_numpy()
                x, y, heading, speed, length, width = (
                    np.interp(sample_times, row_times, rows[column])
                    for column in TRACK_COLUMNS[2:]
                )
                place = np.round((x + 1j * y - front) / direction, PLACE_DECIMALS)
                facing = np.round(np.exp(1j * heading) / direction, PLACE_DECIMALS)
                is_there = (sample_times > row_times[0] - SAME_TIME) & (
                    sample_times < row_times[-1] + SAME_TIME
                )
                track = Track(
                    name=name,
                    kind="recorded",
                    length=np.where(is_there, length, 0.0),
                    width=np.where(is_there, width, 0.0),
                    x=place.real,
                    y=place.imag,
                    along=facing.real,
                    left=facing.imag,
                    speed=speed,
                )
                tracks.append(track)
        return tracks


def key_of(file: str) -> str:
    """The key and the name of the file, as errors name them."""
    return f"scenario.parameters.file = {os.path.basename(file)!r}"


def read_tracks(file: str) -> dict[str, pd.DataFrame]:
    """Read the rows of each body, by its name, in the order of time. Headings do not jump by a full
    turn.

    Raises
    ------
    InputError
        If the file cannot be read, lacks a column or a value, or has a body twice at one time or
        with a gap in time.
    """
    import pandas as pd

    key = key_of(file)
    # All values are read as texts, so that errors can quote the file.
    try:
        content = read_file(Path(file))
        table = pd.read_csv(
            BytesIO(content),
            dtype=str,
            keep_default_na=False,
            skipinitialspace=True,
        )
    except (OSError, ValueError) as error:
        raise InputError("", f"{key}: cannot be read: {error}", "a CSV file") from None
    # pandas gives the second column of a name another name.
    first_line = content.lstrip().partition(b"\n")[0]
    _check_header(key, first_line.decode("utf-8-sig", "replace"))

    # The length of a name replaces the name: an empty name then is an illegal number, like others.
    values = table[TRACK_COLUMNS].assign(name=table["name"].str.len())
    values = values.apply(pd.to_numeric, errors="coerce").astype(float)
    legal = np.isfinite(values)
    legal[ABOVE_ZERO] &= values[ABOVE_ZERO] > 0
    for row, column in np.argwhere(~legal.to_numpy())[:1]:
        name = TRACK_COLUMNS[column]
        expected = "a number that is finite"
        if name in ABOVE_ZERO:
            expected = "a number above 0"
        if name == "name":
            expected = "a name"
        raise InputError(
            "",
            f"{key}: row {row + 1}: {name} = {table[name].iloc[row]!r}",
            expected,
        )

    groups = values.groupby(table["name"], sort=False)
    bodies = {str(name): rows.sort_values("time") for name, rows in groups}
    times = values.sort_values("time").groupby(table["name"])["time"]
    longest_step = LONGEST_PAUSE * times.diff().median()
    for name, rows in bodies.items():
        body = f"{key}: {name}"
        _check_steps(body, rows["time"].to_numpy(), longest_step)
        _check_headings(body, rows)
        rows["heading"] = np.unwrap(rows["heading"])
    return bodies


def _check_header(key: str, line: str) -> None:
    """Refuse the first line of a table if it lacks a column, has a column twice, or has another
    separator than commas. `key` is the file, for errors.
    """
    header = [name.strip().strip('"') for name in line.split(",")]
    separator = re.search("[;\\t|]", line)
    if len(header) == 1 and separator:
        raise InputError(
            "",
            f"{key}: its columns are separated by {separator[0]!r}",
            "commas between columns, and points in numbers",
        )
    for name in TRACK_COLUMNS:
        if header.count(name) > 1:
            raise InputError(
                "", f"{key}: the column {name!r} is there twice", "each once"
            )
        if name not in header:
            raise InputError(
                "",
                f"{key}: there is no column {name}",
                f"the columns {', '.join(TRACK_COLUMNS)}",
            )


def _check_headings(body: str, rows: pd.DataFrame) -> None:
    """Refuse headings in degrees: a body then moves where they point, and not where they would
    point in rad.
    """
    heading = rows["heading"].to_numpy()[:-1]
    speed = rows["speed"].to_numpy()
    step = np.diff(rows["time"]) * (speed[1:] + speed[:-1]) / 2
    way = np.diff(rows["x"]) + 1j * np.diff(rows["y"])

    def apart(headings: FloatArray) -> float:
        """The distance between the ways by places and by headings, over all steps [m]."""
        return float(np.abs(way - step * np.exp(1j * headings)).sum())

    least_difference = max(LEAST_WAY_DIFFERENCE, float(np.abs(way).sum()) / 3)
    for meaning, degrees in (
        ("degrees", heading),
        ("degrees clockwise from y", 90.0 - heading),
    ):
        if apart(heading) > max(least_difference, 3 * apart(np.radians(degrees))):
            raise InputError(
                "",
                f"{body} moves where its headings point in {meaning}",
                "heading [rad], counter-clockwise from x",
            )


def _check_steps(body: str, times: FloatArray, longest: float) -> None:
    """Refuse two rows at the same time, and a step that is longer than `longest` [s]."""
    steps = np.diff(times)
    for row in np.flatnonzero(steps <= 0)[:1]:
        raise InputError(
            "", f"{body} has two rows at {times[row]:g} s", "one row at a time"
        )
    for row in np.flatnonzero(steps > longest + SAME_TIME)[:1]:
        raise InputError(
            "",
            f"{body} has no row from {times[row]:g} to {times[row + 1]:g} s",
            f"a row every {longest:g} s, or another name after the gap",
        )
