"""Fits the friction of tyres on a wet road to published stops and to a handbook's table.

    python calibration/wet_friction.py

It prints the constants of `safevar_sumo/vehicles/wet_friction.toml`, the parameters and the table
[spread] of `studies/wear.toml`, and, as comments, the residual of every row.

The friction coefficient is `lifted_friction` of `safevar_sumo/vehicles/wet_road.py`: a grip on the
dry road, which falls with speed, water and lost tread. Its two constants hold for all sources. The
sources contradict each other in level, so each has a grip of its own; where a source does not state
the water, one depth is fitted to its rows; the handbook's smooth surface has one factor on its
water. Stops count by the logarithm of the distance, in units of 5 %, the handbook's rows by the
coefficient, in units of 0.08, and half: it gives order and trend.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.stats import spearmanr

from safevar_sumo.records import GRAVITY, KMH_PER_MS
from safevar_sumo.vehicles.wet_road import lift_of, lifted_friction

Floats = npt.NDArray[np.float64]
Row = Mapping[str, str]
Values = Mapping[str, float]
FOLDER = Path(__file__).parent
GRIPS = {
    "AutoBild 2019": "AutoBild",
    "MIRA for RoadSafe 2005": "MIRA",
    "Tire Rack 2007": "Tire Rack",
}
"""Sources of distances in metres, each with a grip of its own."""
WATERS = {
    "AutoBild 2019": "AutoBild",
    "MIRA for BRMA": "BRMA",
    "AAA 2018": "AAA and etyres",
    "etyres": "AAA and etyres",
}
"""Sources that do not state the depth of the water; two with one row each share one."""
NEW_TREADS = {"MIRA for BRMA": 6.7, "AAA 2018": 8.0, "etyres": 8.0}
"""Tread to which a source's ratio refers [mm]; AAA does not state it."""
NEW_TREAD = 8.0
"""Tread of the handbook's new tyre [mm], which does not state it."""
BOUNDS = {
    "lift": (1e-4, 0.1),
    "texture": (0.1, 8.0),
    "film": (0.3, 10.0),
    "grip": (0.4, 2.0),
    "water": (0.3, 3.0),
}
"""Bounds of the constants, by the first word of their names."""
STOP_UNIT, FRICTION_UNIT, HANDBOOK_WEIGHT = 0.05, 0.08, 0.5
DRAWS, SETS, ALIKE = 400, 12, 0.1
"""Bootstrap samples; sets of constants that are printed; a set fits about as well if its loss over
all rows, with the best grips and waters for it, exceeds the lowest one by at most this share.
"""
FREE: Values = {}
NAMES = (
    "lift",
    "texture",
    "film",
    *(f"grip {name}" for name in (*GRIPS.values(), "handbook")),
    *(f"water {name}" for name in dict.fromkeys(WATERS.values())),
)


def read(name: str) -> list[Row]:
    with (FOLDER / name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


STOPS, HANDBOOK = read("wet_braking.csv"), read("wet_friction.csv")


def source_of(row: Row) -> str:
    return row["source"].partition(" (")[0]


def water_of(row: Row, values: Values) -> float:
    """Water on the road of a stop [mm]: stated, or fitted."""
    return float(row["water_mm"] or values[f"water {WATERS.get(source_of(row))}"])


def stopping_distance(
    lift: Floats | float, speed: Floats | float, grip: Floats | float = 1.0
) -> Floats:
    """Distance [m] of a stop from a speed [m/s]: the integral of v / (mu g) dv, mu = grip / sqrt(1
    + (lift v^2)^2).
    """
    energy = np.square(speed)
    return np.asarray(
        (energy * np.sqrt(1 + (lift * energy) ** 2) + np.arcsinh(lift * energy) / lift)
        / (4 * grip * GRAVITY)
    )


def model_stop(row: Row, values: Values) -> float:
    """The distance [m] of a stop, or its ratio to new tyres, whichever is published."""
    source, water, speed = (
        source_of(row),
        water_of(row, values),
        float(row["speed_kmh"]) / KMH_PER_MS,
    )
    treads = [float(row["tread_mm"]), NEW_TREADS.get(source, NEW_TREAD)]
    worn, new = stopping_distance(
        lift_of(water, np.array(treads), values["lift"], values["texture"]), speed
    ).tolist()
    return worn / values[f"grip {GRIPS[source]}"] if row["distance_m"] else worn / new


def published_stop(row: Row) -> float:
    return float(row["distance_m"] or row["ratio_to_new"])


def model_friction(row: Row, values: Values) -> float:
    """The friction coefficient of a row of the handbook."""
    tread, water = (
        float(row["tread_mm"] or NEW_TREAD),
        values["film"] * float(row["water_mm"]),
    )
    lift = lift_of(water, np.array(tread), values["lift"], values["texture"])
    return float(
        lifted_friction(
            values["grip handbook"],
            lift,
            np.array(float(row["speed_kmh"]) / KMH_PER_MS),
        )
    )


def residuals(values: Values) -> tuple[Floats, Floats]:
    """Of stops and of the handbook's rows, in their units."""
    stops = [
        np.log(model_stop(row, values) / published_stop(row)) / STOP_UNIT
        for row in STOPS
    ]
    handbook = [
        (model_friction(row, values) - float(row["friction"])) / FRICTION_UNIT
        for row in HANDBOOK
    ]
    return np.array(stops), np.array(handbook) * np.sqrt(HANDBOOK_WEIGHT)


def loss_of(values: Values) -> float:
    return float(sum((part**2).sum() for part in residuals(values)))


def fit(
    start: Values,
    stop_counts: Floats | float = 1.0,
    handbook_counts: Floats | float = 1.0,
    fixed: Values = FREE,
) -> dict[str, float]:
    """The constants with the least sum of squares; rows count as often as `..._counts` say, `fixed`
    constants stay.
    """
    names = [name for name in NAMES if name not in fixed]
    lower, upper = np.array([BOUNDS[name.split()[0]] for name in names]).T

    def weighted(place: Floats) -> Floats:
        stops, handbook = residuals(
            {**fixed, **dict(zip(names, place.tolist(), strict=True))}
        )
        return np.concatenate(
            [stops * np.sqrt(stop_counts), handbook * np.sqrt(handbook_counts)]
        )

    begin = np.clip([start[name] for name in names], lower * 1.001, upper * 0.999)
    found = least_squares(weighted, begin, bounds=(lower, upper), x_scale=upper - lower)
    return {**fixed, **dict(zip(names, found.x.tolist(), strict=True))}


def best_fit() -> dict[str, float]:
    """The best of fits from several places."""
    rng = np.random.default_rng(1)
    places = [
        {name: rng.uniform(*BOUNDS[name.split()[0]]) for name in NAMES}
        for _ in range(8)
    ]
    return min((fit(place) for place in places), key=loss_of)


def alike_fits(best: Values) -> list[dict[str, float]]:
    """Fits to bootstrap samples of the rows, drawn within each source, that fit all rows about as
    well as the best one.

    The best is the first; the others are as far from it and from each other as possible.
    """
    rng, sources, lowest = (
        np.random.default_rng(1),
        [source_of(row) for row in STOPS],
        loss_of(best),
    )
    groups = [
        np.flatnonzero([source == each for each in sources])
        for source in dict.fromkeys(sources)
    ]
    alike = [dict(best)]
    for _ in range(DRAWS):
        drawn = np.concatenate([rng.choice(group, len(group)) for group in groups])
        rows = rng.integers(len(HANDBOOK), size=len(HANDBOOK))
        counts = (
            np.bincount(numbers, minlength=size)
            for numbers, size in ((drawn, len(STOPS)), (rows, len(HANDBOOK)))
        )
        shape = fit(best, *counts)
        refitted = fit(best, fixed={name: shape[name] for name in ("lift", "texture")})
        if loss_of(refitted) <= lowest * (1 + ALIKE):
            alike.append(refitted)
    places = np.log([[values["lift"], values["texture"]] for values in alike])
    places /= places.std(axis=0)
    chosen, distances = [0], np.linalg.norm(places - places[0], axis=1)
    while len(chosen) < SETS:
        chosen.append(int(np.argmax(distances)))
        distances = np.minimum(
            distances, np.linalg.norm(places - places[chosen[-1]], axis=1)
        )
    print(
        f"# {len(alike)} of {DRAWS + 1} fits agree about as well; lowest loss {lowest:.2f}"
    )
    return [alike[number] for number in chosen]


def digits(value: float) -> float:
    return float(f"{value:.4g}")


def mean_grip(values: Values) -> float:
    """The geometric mean of the grips of the published stops."""
    return float(
        np.exp(np.mean([np.log(values[f"grip {name}"]) for name in GRIPS.values()]))
    )


def print_residuals(values: Values) -> None:
    errors = np.array(
        [model_stop(row, values) / published_stop(row) - 1 for row in STOPS]
    )
    for row, error in zip(STOPS, errors, strict=True):
        unit = "m" if row["distance_m"] else "times new"
        print(
            f"# {source_of(row)}, {row['speed_kmh']} km/h, {row['tread_mm']} mm: published"
            f" {published_stop(row):g} {unit}, here {model_stop(row, values):.3g}, {error:+.1%}"
        )
    print(
        f"# stops: median error {np.median(np.abs(errors)):.1%}, largest {np.abs(errors).max():.1%}"
    )
    wet = [row for row in HANDBOOK if float(row["water_mm"])]
    for row in HANDBOOK:
        print(
            f"# handbook, {row['tyre']}, {row['speed_kmh']} km/h, {row['water_mm']} mm of water:"
            f" {row['friction']}, here {model_friction(row, values):.2f}"
        )
    published, here = np.array(
        [(float(row["friction"]), model_friction(row, values)) for row in wet]
    ).T
    rank = spearmanr(published, here).statistic
    print(
        f"# handbook, wet rows: mean error {np.abs(here - published).mean():.3f}, rank correlation"
        f" {rank:.3f}"
    )


def print_spread(fits: Sequence[Values]) -> None:
    """The sets of a study; the first has the mean grip, each other the grip of one published test's
    road, in turn.
    """
    names = [*GRIPS.values()]
    grips = [
        mean_grip(fits[0]),
        *(values[f"grip {names[k % len(names)]}"] for k, values in enumerate(fits[1:])),
    ]
    columns = {
        "tyre_friction": grips,
        "water_lift": [values["lift"] for values in fits],
        "road_texture": [values["texture"] for values in fits],
    }
    print("\n[vehicle.parameters]")
    for name, column in columns.items():
        print(f"{name} = {digits(column[0])}")
    print("\n[spread]")
    for name, column in columns.items():
        print(f'"vehicle.parameters.{name}" = {[*map(digits, column)]}')


def main() -> None:
    best = best_fit()
    print_residuals(best)
    fits = alike_fits(best)
    print("\n[worn]")
    print(f"tyre_friction = {digits(mean_grip(best))}")
    print(
        f"water_lift = {digits(best['lift'])}\nroad_texture = {digits(best['texture'])}"
    )
    for table in ("grip", "water"):
        print(f"\n[{table}]")
        for name in NAMES:
            if name.startswith(f"{table} "):
                print(f'"{name.partition(" ")[2]}" = {digits(best[name])}')
    print(f"\n[handbook]\nwater_factor = {digits(best['film'])}")
    print_spread(fits)


if __name__ == "__main__":
    main()
