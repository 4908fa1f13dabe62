"""The options of `simulate` that show a vehicle beside the original."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from safevar_sumo.cli.options import PICTURES, Within, check_output, refuse_inputs
from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import at_worst
from safevar_sumo.sumo.system import System

Command = Callable[..., Any]
FILE = click.Path(path_type=Path)


class Shown(NamedTuple):
    """What is to be shown, and where."""

    plot: Path | None
    animate: Path | None
    gui: bool = False
    slower: float = 1.0

    @property
    def asked(self) -> bool:
        return self.plot is not None or self.animate is not None or self.gui

    @property
    def files(self) -> list[Path]:
        """What is written, as whole paths."""
        return [path.resolve() for path in (self.plot, self.animate) if path is not None]

    def check(self, study: str) -> None:
        """Refuse what cannot be written or is read from `study`, before anything is simulated; raises InputError."""
        from safevar_sumo.replay.animation import ANIMATIONS, check_animation

        if self.slower != 1 and not self.gui:
            raise InputError("--slower", f"{self.slower:g} without --gui", "together with --gui")
        if self.plot is not None:
            refuse_inputs(self.plot, "--plot", study)
            check_output(self.plot, "--plot", PICTURES)
        if self.animate is not None:
            refuse_inputs(self.animate, "--animate", study)
            check_output(self.animate, "--animate", tuple(ANIMATIONS))
            check_animation(self.animate)

    def show(self, study: Study, system: System, setting: FloatArray) -> None:
        """Simulate a filtered setting, shape (n,), beside the original vehicle, and show both."""
        from safevar_sumo.replay.animation import animate
        from safevar_sumo.replay.comparison import compare
        from safevar_sumo.replay.figure import draw_comparison, write_figure
        from safevar_sumo.replay.gui import show_in_gui

        comparison = compare(study, system, setting)
        if self.plot is not None:
            write_figure(draw_comparison(comparison), self.plot)
        if self.animate is not None:
            animate(comparison, self.animate)
        if self.gui:
            show_in_gui(comparison, at_worst(system, setting[np.newaxis]).scenario.network, slower=self.slower)


def showing_options(command: Command) -> Command:
    """The options that `Shown` is made of."""
    for option in (
            click.option("--slower", type=Within(0.01, 1000), default=1.0, show_default=True, metavar="TIMES",
                         help="How many times slower than real time --gui plays."),
            click.option("--gui", is_flag=True, help="Show both in sumo-gui, each on its road."),
            click.option("--animate", type=FILE, metavar="FILE", help="Show both from above, moving: gif, mp4 or html."),
            click.option("--plot", type=FILE, metavar="FILE", help="Draw it beside the original vehicle: png, pdf or svg.")):
        command = option(command)
    return command
