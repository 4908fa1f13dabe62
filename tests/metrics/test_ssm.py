"""TTC and DRAC beside SUMO's SSM device, which measures the same vehicles."""

from __future__ import annotations

import subprocess
import xml.etree.ElementTree as ET
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.random import default_rng

from safevar_sumo.metrics import OPTIONAL_METRICS
from safevar_sumo.records import Encounter, FloatArray, SimulationRuns
from safevar_sumo.study import MetricsTable
from safevar_sumo.sumo.network import program_of_sumo
from tests.in_process import SLOW
from tests.made_up import made_up_runs

RUNS = 50
STEP = 0.05
LENGTH = 5.0
WIDTH = 3.2
"""Of vehicles and lanes: the device takes lanes for bodies."""
THRESHOLDS = MetricsTable(ttc_threshold=2.0)
DEVICE = (
    ("has.ssm.device", "true"),
    ("device.ssm.measures", "TTC DRAC"),
    ("device.ssm.thresholds", "1e4 0"),
)
Rows = dict[str, dict[float, tuple[float, float, float]]]


def vehicle(
    name: str, route: str, depart: float, place: float, speed: float, *, ego: bool
) -> str:
    """A vehicle that keeps its speed; that under test has the device, and brakes for who is
    ahead.
    """
    params = "".join(
        f'<param key="{key}" value="{value}"/>' for key, value in DEVICE if ego
    )
    return (
        f'<vType id="t{name}" length="{LENGTH}" width="{WIDTH}" maxSpeed="{speed}" accel="8"'
        ' decel="9" tau="0.05" minGap="0" sigma="0" speedDev="0" jmIgnoreFoeProb="1"'
        f' jmIgnoreFoeSpeed="99" jmIgnoreJunctionFoeProb="1"/><vehicle id="{name}" type="t{name}"'
        f' route="{route}" depart="{depart}" departPos="{place}" departSpeed="{speed}"'
        f' insertionChecks="none">{params}</vehicle>'
    )


def simulate(
    folder: Path, nodes: str, edges: str, traffic: list[str]
) -> tuple[Rows, dict[str, ET.Element]]:
    """SUMO's rows by vehicle and time: x, y, speed; and the conflict that the device of each
    vehicle reports.
    """
    (folder / "n.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "e.xml").write_text(f"<edges>{edges}</edges>")
    (folder / "r.xml").write_text(f"<routes>{''.join(traffic)}</routes>")
    net = (
        "netconvert",
        "-n",
        "n.xml",
        "-e",
        "e.xml",
        "-o",
        "net.xml",
        "--no-turnarounds",
        "--no-internal-links=false",
    )
    run = (
        f"sumo -n net.xml -r r.xml --step-length {STEP} --fcd-output fcd.xml --precision 6"
        " --collision.action none"
    )
    run += (
        " --device.ssm.file ssm.xml --device.ssm.range 400 --time-to-teleport -1"
        " --device.ssm.extratime 60"
    )
    for name, *words in (net, run.split()):
        subprocess.run(
            [program_of_sumo(name, "test"), *words],
            cwd=folder,
            check=True,
            capture_output=True,
        )
    rows: Rows = defaultdict(dict)
    for step in ET.parse(folder / "fcd.xml").getroot():
        for row in step:
            values = (
                float(row.attrib["x"]),
                float(row.attrib["y"]),
                float(row.attrib["speed"]),
            )
            rows[row.attrib["id"]][float(step.attrib["time"])] = values
    return rows, {
        row.attrib["ego"] + row.attrib["foe"]: row
        for row in ET.parse(folder / "ssm.xml").getroot()
    }


def shared(rows: Rows, one: str, other: str) -> tuple[FloatArray, FloatArray]:
    """The rows of two vehicles at the times at which both are on the road, shape (T, 3) each."""
    times = sorted(rows[one].keys() & rows[other].keys())
    return np.array([rows[one][time] for time in times]), np.array(
        [rows[other][time] for time in times]
    )


def measured(name: str, run: SimulationRuns) -> float:
    return float(OPTIONAL_METRICS[name].function(run, THRESHOLDS)[0])


@SLOW
def test_behind_a_slower_car_ttc_and_drac_are_those_of_the_device(
    tmp_path: Path,
) -> None:
    """Both divide the gap by the closing speed, and half its square by the gap, at the ends of
    steps.
    """
    rng = default_rng(1)
    traffic = list[str]()
    nodes = edges = ""
    for i in range(RUNS):
        nodes += f'<node id="a{i}" x="0" y="{20 * i}"/><node id="b{i}" x="600" y="{20 * i}"/>'
        edges += f'<edge id="e{i}" from="a{i}" to="b{i}" numLanes="1" speed="50" width="{WIDTH}"/>'
        traffic.append(f'<route id="r{i}" edges="e{i}"/>')
        fast, slow, gap = rng.uniform(12, 30), rng.uniform(1, 10), rng.uniform(30, 80)
        traffic.append(vehicle(f"ego{i}", f"r{i}", 0, 50, fast, ego=True))
        traffic.append(
            vehicle(f"foe{i}", f"r{i}", 0, 50 + LENGTH + gap, slow, ego=False)
        )
    rows, conflicts = simulate(tmp_path, nodes, edges, traffic)
    for i in range(RUNS):
        ego, foe = shared(rows, f"ego{i}", f"foe{i}")
        gap, closing = (foe - ego)[:, [0]] - LENGTH, (ego - foe)[:, [2]]
        run = made_up_runs(STEP, ego[:, [2]], gap)
        run = replace(run, encounter=Encounter(gap, gap, closing, gap > 0))
        for name, tag in (("ttc_min", "minTTC"), ("drac", "maxDRAC")):
            of_device = float(conflicts[f"ego{i}foe{i}"].find(tag).attrib["value"])
            assert measured(name, run) == pytest.approx(of_device, rel=2e-3)
