"""The picture of collisions over speed and tread in the ranges of the study wear.

    python docs/scripts/encounters.py docs/pictures/encounters.png [count]

With `count` it prints the numbers of the page, too.

The car has the wear `WORN` besides its tread, with which it is safe in the tests of the study,
whose speeds are dotted.
"""

from __future__ import annotations

import sys

import numpy as np

from safevar_sumo.questions.figures import BLUE, VERMILION, new_figure
from safevar_sumo.questions.part import UpperEnd, study_up_to
from safevar_sumo.questions.sampling import sobol_settings
from safevar_sumo.scenarios.declared import read_study, with_ranges
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import System, assemble

FASTEST = 60.0
"""The fastest speed of the study [km/h]."""
WORN = {
    "brakeTorque": 0.97,
    "brakeResponse": 0.25,
    "payload": 180.0,
    "sensorRange": 65.0,
    "sensorLatency": 0.12,
}
IMPACT_LOCATION = 25.0
GRID_SPEEDS = (10, 20, 30, 40)
"""Speeds of the tests that cross the road [km/h]."""
SPEEDS, TREADS = 51, 33
VEHICLES, ENCOUNTERS = 150, 24
LINES, PARTS, ENCOUNTERS_ON_LINES = 30, 25, 16


def _up_to(fastest: float) -> System:
    """The study wear in its ranges, up to a speed [km/h]."""
    end = UpperEnd("speed", fastest)
    return assemble(study_up_to(with_ranges(read_study("wear")), end))


def main(path: str) -> None:
    """Simulate the worn car with every tread at every speed."""
    system = _up_to(FASTEST)
    members = system.characteristics
    speed, tread = members.names.index("speed"), members.names.index("treadDepth")
    speeds = np.linspace(members.lower[speed], FASTEST, SPEEDS)
    treads = np.linspace(members.lower[tread], members.upper[tread], TREADS)
    worn = members.setting({**WORN, "impact_location": IMPACT_LOCATION})
    settings = np.tile(worn, (SPEEDS * TREADS, 1))
    settings[:, speed], settings[:, tread] = (
        np.tile(speeds, TREADS),
        np.repeat(treads, SPEEDS),
    )
    evaluations = drive_and_score(system, settings)
    collided = evaluations.collided.reshape(TREADS, SPEEDS)
    unsafe_original = (
        system.measuring.scoring.violation(evaluations).reshape(TREADS, SPEEDS)[0] > 0
    )
    figure, ((axis,),) = new_figure(
        "wear --ranges: collisions over speed and tread", 1, 1, (6.4, 3.4)
    )
    axis.contourf(
        speeds, treads, collided, levels=[0.5, 1.5], colors=[VERMILION], alpha=0.45
    )
    border = speeds[np.argmax(unsafe_original)] if unsafe_original.any() else FASTEST
    axis.axvspan(border, FASTEST + 1, color="0.75")
    axis.set_xlim(speeds[0], FASTEST + 1)
    for grid_speed in GRID_SPEEDS:
        axis.axvline(grid_speed, color=BLUE, linewidth=1.2, linestyle=":")
    axis.set_xlabel("speed in all tests [km/h]")
    axis.set_ylabel("tread depth [mm]")
    wear = ", ".join(
        f"{item.name} {WORN[item.name]:g}{item.suffix}"
        for item in members
        if item.name in WORN
    )
    axis.set_title(f"{wear},\nimpact location {IMPACT_LOCATION:g} %", fontsize=8)
    colours = "orange: collision; grey: the original is not safe; blue, dotted: speeds of the tests"
    figure.supxlabel(colours, fontsize=8)
    figure.savefig(path, dpi=110)


def count_between(fastest: float) -> None:
    """Print how many vehicles are safe in all tests of wear, and how many of these collide in
    encounters up to a speed [km/h].
    """
    grid, joint = assemble(read_study("wear")), _up_to(fastest)
    members, of_vehicle, rng = (
        grid.characteristics,
        joint.characteristics.of_vehicle,
        np.random.default_rng(5),
    )
    drawn = rng.uniform(members.lower, members.upper, (VEHICLES, len(members)))
    vehicles = members.original + (drawn - members.original) * rng.uniform(
        0.2, 0.8, (VEHICLES, 1)
    )
    safe = vehicles[~drive_and_score(grid, vehicles).collided]
    encounters = sobol_settings(joint.characteristics, ENCOUNTERS)
    settings = np.tile(encounters, (len(safe), 1))
    settings[:, of_vehicle] = np.repeat(safe, ENCOUNTERS, axis=0)
    evaluations = drive_and_score(joint, settings)
    fails = evaluations.collided & (joint.measuring.scoring.violation(evaluations) == 0)
    found = int(fails.reshape(len(safe), -1).any(axis=1).sum())
    print(
        f"{len(safe)} of {VEHICLES} vehicles are safe in the tests of wear, {found} of these"
        " collide in its ranges"
    )


def compare_lines(fastest: float) -> None:
    """Print on how many lines from the original to worn cars the first collision is earlier in
    the ranges of wear than in its tests, and on how many later.
    """
    grid, joint = assemble(read_study("wear")), _up_to(fastest)
    members, of_vehicle, rng = (
        grid.characteristics,
        joint.characteristics.of_vehicle,
        np.random.default_rng(7),
    )
    ends, shares = (
        rng.uniform(members.lower, members.upper, (LINES, len(members))),
        np.arange(1, PARTS + 1) / PARTS,
    )
    vehicles = (
        members.original
        + (ends - members.original)[:, np.newaxis] * shares[:, np.newaxis]
    )
    vehicles = vehicles.reshape(-1, len(members))
    encounters = sobol_settings(joint.characteristics, ENCOUNTERS_ON_LINES)
    settings = np.tile(encounters, (len(vehicles), 1))
    settings[:, of_vehicle] = np.repeat(vehicles, ENCOUNTERS_ON_LINES, axis=0)
    evaluations = drive_and_score(joint, settings)
    fails = evaluations.collided & (joint.measuring.scoring.violation(evaluations) == 0)
    firsts = []
    for collided in (
        drive_and_score(grid, vehicles).collided,
        fails.reshape(len(vehicles), -1).any(axis=1),
    ):
        rows = collided.reshape(LINES, PARTS)
        firsts.append(
            np.where(rows.any(axis=1), shares[np.argmax(rows, axis=1)], np.inf)
        )
    on_grid, between = firsts
    print(
        f"of {LINES} lines earlier in the ranges: {(between < on_grid).sum()}, later:"
        f" {(between > on_grid).sum()}"
    )


if __name__ == "__main__":
    main(sys.argv[1])
    for speed in (max(GRID_SPEEDS), FASTEST) if "count" in sys.argv[2:] else ():
        count_between(speed)
        compare_lines(speed)
