"""A comparison in sumo-gui: SUMO drives both vehicles again. Each vehicle is on its own copy of the
road, and both copies are in the same place of the picture.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from safevar_sumo.output import temporary_folder
from safevar_sumo.questions.arguments import checked
from safevar_sumo.replay.comparison import COLOURS, Comparison
from safevar_sumo.scenarios import VUT
from safevar_sumo.sumo.copies import copied_id
from safevar_sumo.sumo.engine import open_window
from safevar_sumo.sumo.verification import drive_again
from safevar_sumo.sumo.world import Api, SumoWorld

PAUSE = 2.0
"""Length of the pauses at the nearest moments and at the end [s]."""
AROUND = 12.0
"""Distance between the vehicles and the edges of the view [m]."""
VIEW_NAME = "View #0"
VIEW_SETTINGS = """<viewsettings>
    <scheme name="safevar_sumo">
        <opengl antialiase="1" dither="0"/>
        <background backgroundColor="238,240,236" showGrid="0"/>
        <edges laneEdgeMode="0" laneShowBorders="1" showLinkDecals="1">
            <colorScheme name="uniform"><entry color="154,161,169" name="road"/>
                <entry color="207,211,207" name="sidewalk"/></colorScheme>
        </edges>
        <junctions junctionMode="0" drawShape="1" drawCrossingsAndWalkingareas="1">
            <colorScheme name="uniform"><entry color="154,161,169"/>
                <entry color="154,161,169" name="waterway"/></colorScheme>
        </junctions>
        <vehicles vehicleMode="0" vehicleQuality="1" showBlinker="1" vehicle_minSize="1.00"
            vehicle_exaggeration="1.00"/>
        <persons personMode="0" personQuality="2" person_minSize="1.00" person_exaggeration="1.00"/>
    </scheme>
</viewsettings>
"""


@checked
def show_in_gui(comparison: Comparison, pictures: Path | None = None) -> None:
    """Play a comparison in SUMO's own window, with pauses at the nearest moments and at the end.

    Parameters
    ----------
    pictures
        Folder for pictures of the window at every pause; no pictures by default.

    Raises
    ------
    InputError
        If there is no display.
    SimulationError
        If SUMO cannot load the network, or its window was closed before the end.
    """
    runs = comparison.runs
    samples = count()
    pauses = {
        comparison.last_sample,
        *(moments.nearest for moments in comparison.moments),
    }
    start = 0.0

    def watch(world: SumoWorld) -> None:
        """Follow the vehicles at a sample, and wait, so that the window plays in real time."""
        nonlocal start
        sample = next(samples)
        # The clock starts with the first step, because opening the window takes a while.
        if sample == 0:
            start = time.monotonic()
            for row in comparison.rows:
                world.api.vehicle.setColor(
                    copied_id(row, VUT), (*bytes.fromhex(COLOURS[row][1:]), 255)
                )
        _look_at(world)
        # sumo-gui takes a picture at the end of its next step, so that it is requested before.
        if pictures is not None and sample + 1 in pauses:
            world.api.gui.screenshot(VIEW_NAME, str(pictures / f"{sample + 1:04d}.png"))

        if sample in pauses:
            time.sleep(PAUSE)
            start += PAUSE
        time.sleep(max(0.0, start + (sample + 1) * runs.trace.step - time.monotonic()))

    drive_again(
        comparison.system, comparison.evaluations.settings, runs, watch, _open_view
    )


def _look_at(world: SumoWorld) -> None:
    """Keep the vehicles in the middle of the view."""
    fronts = world.vehicle_positions(VUT)
    low = fronts.min(axis=0) - AROUND
    world.api.gui.setBoundary(VIEW_NAME, *low, *(fronts.max(axis=0) + AROUND))


@contextmanager
def _open_view(options: Sequence[str]) -> Iterator[Api]:
    """Start sumo-gui with SUMO's `options` and the settings of the view; yields TraCI."""
    with temporary_folder() as folder:
        settings_file = Path(folder) / "view.xml"
        settings_file.write_text(VIEW_SETTINGS, encoding="utf-8")
        options_of_view = [
            *options,
            "--gui-settings-file",
            str(settings_file),
            "--start",
            "--quit-on-end",
            "--window-size",
            "1200,700",
        ]
        with open_window(options_of_view) as api:
            yield api
