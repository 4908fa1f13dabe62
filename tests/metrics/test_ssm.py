"""TTC and DRAC beside SUMO's SSM device, which measures the same vehicles."""

from __future__ import annotations

import subprocess
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from numpy.random import default_rng

from safevar_sumo.metrics import OPTIONAL_METRICS
from safevar_sumo.records import Encounter
from safevar_sumo.sumo.network import program_of_sumo
from tests.support.in_process import SLOW
from tests.support.made_up import made_up_runs

ROADS = 50
"""Each with a car that drives up to a slower one."""
STEP = 0.05
LENGTH = 5.0
DEVICE = (
    '<param key="has.ssm.device" value="true"/>'
    '<param key="device.ssm.measures" value="TTC DRAC"/>'
    '<param key="device.ssm.thresholds" value="1e4 0"/>'
)
COMMANDS = (
    "netconvert -n nodes.xml -e edges.xml -o net.xml",
    f"sumo -n net.xml -r routes.xml --step-length {STEP} --fcd-output places.csv --precision 6"
    " --device.ssm.file conflicts.xml --device.ssm.range 400 --end 50",
)


def vehicle(name: str, road: int, place: float, speed: float, device: str = "") -> str:
    """A vehicle that keeps its speed until it brakes for who is ahead."""
    return (
        f'<vType id="{name}" length="{LENGTH}" maxSpeed="{speed}" accel="8" decel="9" tau="0.05"'
        f' minGap="0" sigma="0" speedDev="0"/><vehicle id="{name}" type="{name}" route="{road}"'
        f' depart="0" departPos="{place}" departSpeed="{speed}" insertionChecks="none">{device}'
        "</vehicle>"
    )


@SLOW
def test_behind_a_slower_car_ttc_and_drac_are_those_of_the_device(
    tmp_path: Path,
) -> None:
    """Both divide the gap by the closing speed, and half its square by the gap, at the ends of
    steps.
    """
    rng = default_rng(1)
    nodes = edges = routes = ""
    for road in range(ROADS):
        nodes += f'<node id="a{road}" x="0" y="{20 * road}"/>'
        nodes += f'<node id="b{road}" x="600" y="{20 * road}"/>'
        edges += (
            f'<edge id="{road}" from="a{road}" to="b{road}" numLanes="1" speed="50"/>'
        )
        routes += f'<route id="{road}" edges="{road}"/>'
        fast, slow, gap = rng.uniform((12, 1, 30), (30, 10, 80))
        routes += vehicle(f"fast{road}", road, 50, fast, DEVICE)
        routes += vehicle(f"slow{road}", road, 50 + LENGTH + gap, slow)
    for name, text in (("nodes", nodes), ("edges", edges), ("routes", routes)):
        (tmp_path / f"{name}.xml").write_text(f"<{name}>{text}</{name}>")
    for command in COMMANDS:
        program, *options = command.split()
        words = [program_of_sumo(program, "test"), *options]
        subprocess.run(words, cwd=tmp_path, check=True, capture_output=True)

    quantities = ["vehicle_x", "vehicle_speed"]
    drives = pd.read_csv(tmp_path / "places.csv", sep=";").pivot_table(
        index="timestep_time", columns="vehicle_id", values=quantities
    )
    places, speeds = (drives[name] for name in quantities)
    cars = [f"fast{road}" for road in range(ROADS)]
    leaders = [f"slow{road}" for road in range(ROADS)]
    gap = places[leaders].to_numpy() - places[cars].to_numpy() - LENGTH
    own = speeds[cars].to_numpy()
    closing = own - speeds[leaders].to_numpy()
    runs = made_up_runs(STEP, own, gap)
    runs = replace(runs, encounter=Encounter(gap, gap, closing, gap > 0))
    found = ET.parse(tmp_path / "conflicts.xml").getroot()
    conflicts = {row.attrib["ego"]: row for row in found}
    for name, tag in (("ttc_min", "minTTC"), ("drac", "maxDRAC")):
        of_device = [
            float(conflicts[one].find(tag).attrib["value"])  # type: ignore[union-attr]
            for one in cars
        ]
        measured = OPTIONAL_METRICS[name].function(runs, None)
        assert measured == pytest.approx(of_device, rel=2e-3)
