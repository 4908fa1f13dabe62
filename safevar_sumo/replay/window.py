"""A film played in sumo-gui: SUMO draws vehicles and persons on its network, at their recorded positions."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from safevar_sumo.errors import SimulationError
from safevar_sumo.sumo.engine import Engine, engine_api, program_path, start_engine, stop_engine
from safevar_sumo.sumo.network import Network, copied_network

BRAKE_LIGHT = 8
"""Signal of a vehicle (TraCI, "change vehicle state": bit 3)."""
ANY_POSITION = 2
"""Value of keepRoute that allows positions beside every road (TraCI, "move to XY")."""
VIEW_NAME = "View #0"
WINDOW_SIZE = "1200,700"
"""Width and height of the window [pixels]."""
TEXT_SIZE = 85
VIEW_SETTINGS = """<viewsettings>
    <scheme name="safevar">
        <opengl antialiase="1" dither="0"/>
        <background backgroundColor="238,240,236" showGrid="0"/>
        <edges laneEdgeMode="0" laneShowBorders="1" showLinkDecals="1">
            <colorScheme name="uniform"><entry color="154,161,169" name="road"/><entry color="207,211,207" name="sidewalk"/></colorScheme>
        </edges>
        <junctions junctionMode="0" drawShape="1" drawCrossingsAndWalkingareas="1">
            <colorScheme name="uniform"><entry color="154,161,169"/><entry color="154,161,169" name="waterway"/></colorScheme>
        </junctions>
        <vehicles vehicleMode="0" vehicleQuality="2" showBlinker="1" vehicle_minSize="1.00" vehicle_exaggeration="1.00"/>
        <persons personMode="0" personQuality="2" person_minSize="1.00" person_exaggeration="1.00"/>
        <pois poiTextParam="words" poi_minSize="0.00" poi_exaggeration="0.01" poiText_show="1" poiText_size="{text_size}"
              poiText_color="29,35,41" poiText_bgColor="255,255,255,0" poiText_constantSize="1"/>
    </scheme>
</viewsettings>
"""
Colour = tuple[int, int, int, int]
Outline = Sequence[tuple[float, float]]


class ActorPose(NamedTuple):
    """Pose of an actor: front bumper or person [m], heading clockwise from north [degrees], and whether the actor brakes."""

    name: str
    x: float
    y: float
    angle: float
    brakes: bool


class Window:
    """Controls sumo-gui; made by `open_window`. Every actor is a vehicle in sumo-gui; persons only have another shape."""

    def __init__(self, api: Any) -> None:
        self._api = api
        lane = next(lane for lane in api.lane.getIDList() if not lane.startswith(":") and "passenger" not in api.lane.getDisallowed(lane))
        api.route.add("route", [api.lane.getEdgeID(lane)])

    def add(self, name: str, is_person: bool, length: float, width: float, colour: Colour) -> None:
        """Add an actor of this size [m]; `show` moves it."""
        self._api.vehicletype.copy("DEFAULT_VEHTYPE", name)
        self._api.vehicletype.setShapeClass(name, "pedestrian" if is_person else "evehicle")
        self._api.vehicletype.setLength(name, max(length, width) if is_person else length)
        self._api.vehicletype.setWidth(name, max(length, width) if is_person else width)
        self._api.vehicletype.setColor(name, colour)
        self._api.vehicletype.setMinGap(name, 0)
        self._api.vehicle.add(name, "route", name)
        self._api.vehicle.setSpeedMode(name, 0)
        self._api.vehicle.setLaneChangeMode(name, 0)

    def paint(self, name: str, outline: Outline, colour: Colour, layer: int) -> None:
        """Paint an area."""
        self._api.polygon.add(name, list(outline), colour, fill=True, layer=layer)

    def write(self, name: str, x: float, y: float, words: str) -> None:
        """Write words at a position; a second call with the same name changes both."""
        if name in self._api.poi.getIDList():
            self._api.poi.setPosition(name, x, y)
        else:
            self._api.poi.add(name, x, y, (0, 0, 0, 0), layer=200)
        self._api.poi.setParameter(name, "words", words)

    def set_view(self, left: float, bottom: float, right: float, top: float) -> None:
        """Show this part of the plane [m]."""
        self._api.gui.setBoundary(VIEW_NAME, left, bottom, right, top)

    def show(self, poses: Sequence[ActorPose]) -> None:
        """Move all actors to their poses."""
        for pose in poses:
            self._api.vehicle.moveToXY(pose.name, "", 0, pose.x, pose.y, pose.angle, keepRoute=ANY_POSITION)
            self._api.vehicle.setSignals(pose.name, BRAKE_LIGHT if pose.brakes else 0)
        self._api.simulationStep()

    def save_picture(self, path: Path) -> None:
        """Write a picture of the window, in the next time step."""
        self._api.gui.screenshot(VIEW_NAME, str(path))
        self._api.simulationStep()


@contextmanager
def open_window(network: Network, step: float) -> Iterator[Window]:
    """Open a window on one copy of a network without traffic.

    Raises
    ------
    InputError
        If there is no display.
    SimulationError
        If SUMO cannot load the network, or its window was closed before the end.
    """
    with tempfile.TemporaryDirectory() as folder:
        settings_file = Path(folder) / "view.xml"
        settings_file.write_text(VIEW_SETTINGS.format(text_size=TEXT_SIZE), encoding="utf-8")
        api = engine_api(Engine.GUI)
        command = ["-n", str(copied_network(network, 1).network), "--step-length", repr(step), "--collision.action", "none",
                   "--gui-settings-file", str(settings_file), "--start", "true", "--quit-on-end", "true", "--no-step-log", "true",
                   "--no-warnings", "true", "--window-size", WINDOW_SIZE, "--time-to-teleport", "-1",
                   "--xml-validation", "never", "--xml-validation.net", "never"]
        try:
            start_engine(api, Engine.GUI, [program_path(Engine.GUI), *command])
            yield Window(api)
        except (api.TraCIException, api.FatalTraCIError) as error:
            raise SimulationError(f"sumo-gui failed: {str(error).strip() or 'its window was closed'}") from None
        finally:
            stop_engine(api)
