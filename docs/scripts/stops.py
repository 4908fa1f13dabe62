"""The picture of stopping distances against tread depth, with the published points in it.

    python docs/scripts/stops.py docs/pictures/stops.png

Every line is the car of the study `stop` on one published test's road, with its grip and water, and
brakes that the tyres alone limit.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles.wet_road import WET_FRICTION

ROWS = Path(__file__).parents[2] / "calibration" / "wet_braking.csv"
TESTS = {  # label: source in the table, grip, speed [km/h]
    "120 km/h, AutoBild 2019": ("AutoBild 2019", "AutoBild", "120"),
    "112.7 km/h, Tire Rack 2007": ("Tire Rack 2007", "Tire Rack", "112.7"),
    "80.5 km/h, MIRA 2005": ("MIRA for RoadSafe 2005", "MIRA", "80.5"),
    "80 km/h, AutoBild 2019": ("AutoBild 2019", "AutoBild", "80"),
}
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
TREADS = np.linspace(1.6, 8.0, 33)


def stops(speed: float, water: float, grip: float) -> FloatArray:
    """Stopping distances at all tread depths [m] on a road with this water [mm] and grip [-]."""
    friction = grip / WET_FRICTION["worn"]["tyre_friction"]
    weather = {
        "name": "road",
        "road_friction": friction,
        "visibility": 1.0,
        "water": water,
    }
    tables = {"extends": "stop", "name": "picture", "weather": weather}
    matrix = {"tests": [{"name": "stop", "over": {"speed": [speed]}}]}
    study = read_study(
        {**tables, "matrix": matrix, "vehicle": {"parameters": {"brake_force": 4e4}}}
    )
    system = assemble(study)
    settings = np.tile(system.characteristics.original, (len(TREADS), 1))
    settings[:, 0] = TREADS
    return drive_and_score(system, settings).metrics["stopping_distance"]


def main(path: str) -> None:
    with ROWS.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["distance_m"]]
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for colour, (label, (source, grip, speed)) in zip(
        COLOURS, TESTS.items(), strict=True
    ):
        published = [
            row
            for row in rows
            if row["source"].startswith(source) and row["speed_kmh"] == speed
        ]
        water = float(published[0]["water_mm"] or WET_FRICTION["water"]["AutoBild"])
        distances = stops(float(speed), water, WET_FRICTION["grip"][grip])
        axes.plot(TREADS, distances, color=colour, label=label)
        points = [
            (float(row["tread_mm"]), float(row["distance_m"])) for row in published
        ]
        axes.plot(*np.transpose(points), "o", color=colour)
    axes.set(
        xlabel="tread depth [mm]",
        ylabel="stopping distance on a wet road [m]",
        ylim=(0, None),
    )
    axes.set_title("Stops on a wet road with worn tyres", loc="left")
    axes.legend(title="lines: here; dots: published", frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main(sys.argv[1])
