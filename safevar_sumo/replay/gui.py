"""A comparison in sumo-gui, which draws actors at their recorded positions: the original's road above the changed
one's.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from safevar_sumo.replay.animation import ACTOR_COLOUR, PATH_COLOUR, PERSON_COLOUR, ROAD_COLOUR
from safevar_sumo.replay.comparison import COLOURS, Comparison
from safevar_sumo.replay.scene import LANE_KINDS, FlatBody, FlatScene, lane_outlines, lay_out_scene
from safevar_sumo.sumo.engine import open_window
from safevar_sumo.sumo.network import Network, copied_network
from safevar_sumo.sumo.world import Api

PAUSE = 2.0
"""Pause at the nearest moment and at the end [s]."""
ORIGIN = 20_000.0
"""Coordinates of the scene's origin in the window [m]: beside the network, which sumo-gui needs in order to start."""
ROAD_SPACING = 5.0
"""Space between the two roads [m]."""
LEGEND_HEIGHT = 1.8
"""Height of the legend above the lower edge of the view [m]."""
BRAKE_LIGHT = 8
"""Signal of a vehicle (TraCI, "change vehicle state": bit 3)."""
ANY_POSITION = 2
"""Value of keepRoute that allows positions beside every road (TraCI, "move to XY")."""
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
        <vehicles vehicleMode="0" vehicleQuality="2" showBlinker="1" vehicle_minSize="1.00"
            vehicle_exaggeration="1.00"/>
        <persons personMode="0" personQuality="2" person_minSize="1.00" person_exaggeration="1.00"/>
        <pois poiTextParam="words" poi_minSize="0.00" poi_exaggeration="0.01" poiText_show="1" poiText_size="85"
              poiText_color="29,35,41" poiText_bgColor="255,255,255,0" poiText_constantSize="1"/>
    </scheme>
</viewsettings>
"""


def show_in_gui(
    comparison: Comparison, *, slower: float = 1.0, rest: float = PAUSE, pictures: Path | None = None
) -> None:
    """Play a comparison in SUMO's own window, with pauses at the nearest moments and at the end.

    Parameters
    ----------
    slower
        Factor by which to play slower than real time.
    rest
        Duration of each pause [s].
    pictures
        Folder for pictures of the window at every pause; no pictures by default.

    Raises
    ------
    InputError
        If there is no display.
    SimulationError
        If SUMO cannot load the network, or its window was closed before the end.
    """
    scene = lay_out_scene(comparison)
    with _open_window(comparison.network, scene.step) as api:
        for body in scene.bodies:
            _add_actor(api, body)
        for row in comparison.rows:
            _paint_road(api, scene, row)
            api.poi.add(f"legend.{row}", 0, 0, (0, 0, 0, 0), layer=200)
        pauses = {moments.nearest for moments in comparison.moments} | {scene.sample_count - 1}
        start = time.monotonic()
        for sample in range(scene.sample_count):
            _show_sample(api, scene, sample)
            if sample in pauses:
                if pictures is not None:
                    api.gui.screenshot(VIEW_NAME, str(pictures / f"{sample:04d}.png"))
                    api.simulationStep()
                time.sleep(rest)
                start += rest
            time.sleep(max(0.0, start + (sample + 1) * scene.step * slower - time.monotonic()))


@contextmanager
def _open_window(network: Network, step: float) -> Iterator[Api]:
    """Open a window on one copy of a network without traffic; yields TraCI."""
    with tempfile.TemporaryDirectory() as folder:
        settings_file = Path(folder) / "view.xml"
        settings_file.write_text(VIEW_SETTINGS, encoding="utf-8")
        options = {
            "-n": copied_network(network, 1).network,
            "--step-length": repr(step),
            "--collision.action": "none",
            "--gui-settings-file": settings_file,
            "--start": "true",
            "--quit-on-end": "true",
            "--no-step-log": "true",
            "--no-warnings": "true",
            "--window-size": "1200,700",
            "--time-to-teleport": -1,
            "--xml-validation": "never",
            "--xml-validation.net": "never",
        }
        with open_window(options) as api:
            lane = next(
                lane
                for lane in api.lane.getIDList()
                if not lane.startswith(":") and "passenger" not in api.lane.getDisallowed(lane)
            )
            api.route.add("route", [api.lane.getEdgeID(lane)])
            yield api


def _road_origin(scene: FlatScene, row: int) -> tuple[float, float]:
    """Where the origin of a row's road is in the window [m]."""
    return ORIGIN, ORIGIN - row * (scene.height + ROAD_SPACING)


def _add_actor(api: Api, body: FlatBody) -> None:
    """Add an actor, which is a vehicle in sumo-gui; persons only have another shape."""
    name = f"{body.row}.{body.name}"
    length = body.length
    width = body.width
    colour = COLOURS[body.row] if body.is_vut else ACTOR_COLOUR
    if body.is_person:  # a circle
        length, width, colour = max(length, width), max(length, width), PERSON_COLOUR
    api.vehicletype.copy("DEFAULT_VEHTYPE", name)
    api.vehicletype.setShapeClass(name, "pedestrian" if body.is_person else "evehicle")
    api.vehicletype.setLength(name, length)
    api.vehicletype.setWidth(name, width)
    api.vehicletype.setColor(name, _rgba(colour))
    api.vehicletype.setMinGap(name, 0)
    api.vehicle.add(name, "route", name)
    api.vehicle.setSpeedMode(name, 0)
    api.vehicle.setLaneChangeMode(name, 0)


def _paint_road(api: Api, scene: FlatScene, row: int) -> None:
    for i, lane in enumerate(scene.road):
        colour = _rgba({"road": ROAD_COLOUR, "crossing": "#ffffff"}.get(lane.kind, PATH_COLOUR))
        for j, outline in enumerate(lane_outlines(lane, lane.width - 0.1)):
            points = [tuple(point) for point in (outline + _road_origin(scene, row)).tolist()]
            api.polygon.add(f"lane.{row}.{i}.{j}", points, colour, fill=True, layer=LANE_KINDS.index(lane.kind))


def _show_sample(api: Api, scene: FlatScene, sample: int) -> None:
    """Show the actors, the camera and the legend at one sample."""
    comparison = scene.comparison
    left_end = scene.left_ends[sample]
    for body in scene.bodies:
        x = body.x[sample]
        y = body.y[sample]
        angle = 90 - np.rad2deg(body.heading[sample])
        if not np.isnan(x):
            name = f"{body.row}.{body.name}"
            right, up = _road_origin(scene, body.row)
            api.vehicle.moveToXY(name, "", 0, x + right, y + up, angle, keepRoute=ANY_POSITION)
            api.vehicle.setSignals(name, BRAKE_LIGHT if scene.brakes(body, sample) else 0)
    for row in comparison.rows:
        right, up = _road_origin(scene, row)
        words = f"{comparison.name(row)} ({('blue', 'orange')[row]}): {scene.reading(row, sample)}"
        api.poi.setPosition(f"legend.{row}", right + left_end + scene.width / 2, up + scene.bottom + LEGEND_HEIGHT)
        api.poi.setParameter(f"legend.{row}", "words", words)
    top = ORIGIN + scene.bottom + scene.height
    _, lowest_origin = _road_origin(scene, comparison.rows[-1])
    api.gui.setBoundary(
        VIEW_NAME, ORIGIN + left_end, lowest_origin + scene.bottom, ORIGIN + left_end + scene.width, top
    )
    api.simulationStep()


def _rgba(colour: str) -> tuple[int, int, int, int]:
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue, 255
