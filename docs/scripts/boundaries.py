"""Two pictures of where the study rain becomes unsafe.

    python docs/scripts/boundaries.py sawtooth docs/pictures/sawtooth.png
    python docs/scripts/boundaries.py boundary docs/pictures/boundary.png

`sawtooth` has the safety degree over one characteristic, `boundary` the collisions over two.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping

import numpy as np

from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.figures import BLUE, VERMILION, new_figure
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble

SIZE = (6.4, 3.4)
"""Size of a picture [inches]."""
SWEPT = "tireFric"
OVER = "dampRateZeroT_CE"
"""Friction of the tyres, and engine drag with closed throttle and engaged clutch [kg m^2/s]."""
WEAK_BRAKES = 1200.0
"""Brake torque of the cars of `boundary` [N m]; the original has 1500."""
VALUES, ROWS, COLUMNS = 401, 81, 81


def _evaluate(columns: Mapping[str, FloatArray]) -> Evaluations:
    """Cars of the study rain with these values, each of shape (N,)."""
    system = assemble(load_study("rain"))
    characteristics = system.characteristics
    count = len(next(iter(columns.values())))
    settings = np.tile(characteristics.original, (count, 1))
    for name, values in columns.items():
        settings[:, characteristics.names.index(name)] = values
    return drive_and_score(system, settings)


def draw_sawtooth(path: str) -> None:
    frictions = np.linspace(1.0, 3.5, VALUES)
    degrees = _evaluate({SWEPT: frictions}).f_safe
    figure, ((axis,),) = new_figure(
        "rain: less grip is not always less safe", 1, 1, SIZE
    )
    axis.plot(frictions, degrees, color=BLUE, linewidth=1.2)
    axis.plot(3.5, degrees[-1], "o", color="black", markersize=5)
    axis.annotate(
        "original car",
        (3.5, degrees[-1]),
        (-8, 10),
        textcoords="offset points",
        ha="right",
    )
    degree = "safety degree [m]\n(below 0: minus the collision's speed [m/s])"
    axis.set(xlabel="tyre friction tireFric [-]", ylabel=degree)
    figure.savefig(path, dpi=130)


def draw_boundary(path: str) -> None:
    frictions, drags = np.linspace(1.0, 2.0, COLUMNS), np.linspace(1.0, 2.0, ROWS)
    mesh = np.meshgrid(frictions, drags)
    cars = {SWEPT: mesh[0].ravel(), OVER: mesh[1].ravel()}
    weak = np.full(mesh[0].size, WEAK_BRAKES)
    degrees = _evaluate({**cars, "maxBrakeTorque": weak}).f_safe.reshape(ROWS, COLUMNS)
    title = f"rain, maxBrakeTorque {WEAK_BRAKES:g} N m: collisions and clearance"
    figure, ((axis,),) = new_figure(title, 1, 1, SIZE)
    shown = axis.contourf(
        frictions,
        drags,
        degrees,
        levels=np.arange(0.0, 2.6, 0.25),
        cmap="Blues",
        extend="max",
    )
    axis.contourf(frictions, drags, degrees < 0, levels=[0.5, 1.5], colors=[VERMILION])
    axis.annotate("collision", (1.03, 1.03), color="black", fontweight="bold")
    axis.set(
        xlabel="tyre friction tireFric [-]", ylabel=f"engine drag {OVER} [kg m^2/s]"
    )
    figure.colorbar(shown, ax=axis, label="safety degree [m]")
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    {"sawtooth": draw_sawtooth, "boundary": draw_boundary}[sys.argv[1]](sys.argv[2])
