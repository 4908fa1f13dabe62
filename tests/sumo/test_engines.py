"""libsumo in this process and SUMO behind a TraCI socket are the same simulation; TTC is SUMO's own TTC."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.errors import EnvironmentFault, SimulationError
from safevar_sumo.metrics import time_to_collision
from safevar_sumo.records import Trace
from safevar_sumo.study import load_study
from safevar_sumo.sumo.engine import Engine, open_world
from safevar_sumo.sumo.matrix import simulate
from safevar_sumo.sumo.network import CopiedNetwork, copied_network
from safevar_sumo.sumo.system import assemble


@pytest.mark.parametrize("study", ["rain", "lgsvl", "native"])
def test_libsumo_and_traci_give_the_same_trace(study: str) -> None:
    system = assemble(load_study(study))
    settings = np.stack([system.characteristics.original, system.characteristics.upper])
    here, socket = (simulate(system, settings, engine) for engine in (Engine.LIBSUMO, Engine.TRACI))
    assert here.outcome.tolist() == socket.outcome.tolist()
    for field in fields(Trace):
        assert np.array_equal(getattr(here.trace, field.name), getattr(socket.trace, field.name)), field.name


def test_ttc_is_that_of_sumos_ssm_device(tmp_path: Path) -> None:
    """SUMO's surrogate safety measures device logs TTC between the vehicle and the parked one; both see the same gap and speed."""
    system = assemble(load_study("lgsvl"))
    log = tmp_path / "ssm.xml"
    options = ("--device.ssm.explicit", "0.vut", "--device.ssm.measures", "TTC", "--device.ssm.thresholds", "1000",
               "--device.ssm.range", "200", "--device.ssm.extratime", "100", "--device.ssm.trajectories", "true",
               "--device.ssm.file", str(log))
    run = simulate(system, system.characteristics.original[np.newaxis], options=options)
    conflict = next(one for one in ElementTree.parse(log).getroot().iter("conflict") if one.get("foe") == "0.parked_ahead")
    times = [float(text) for text in conflict.find("timeSpan").get("values").split()]  # type: ignore[union-attr]
    theirs = dict(zip(times, conflict.find("TTCSpan").get("values").split(), strict=True))  # type: ignore[union-attr]
    ours, compared = time_to_collision(run)[:, 0], 0
    for sample, time in enumerate(run.trace.time):
        told = theirs.get(round(time, 3), "NA")
        if told != "NA" and np.isfinite(ours[sample]) and run.trace.speed[sample, 0] > 0.1:
            assert ours[sample] == pytest.approx(float(told), abs=0.0051)  # it is logged with two decimals
            compared += 1
    assert compared > 20


def test_broken_traffic_is_an_error_in_sumos_words(tmp_path: Path) -> None:
    files = copied_network("lead_vehicle_stopped", 1)
    broken = tmp_path / "traffic.rou.xml"
    broken.write_text(files.traffic.read_text().replace("0.road", "nowhere"))
    with pytest.raises(EnvironmentFault, match="nowhere"), open_world(CopiedNetwork(files.network, broken, files.options), 1) as world:
        world.depart()
    with open_world(files, 1) as world:  # and the process is as good as before
        world.depart()


def test_a_vehicle_that_finds_no_place_is_an_error(tmp_path: Path) -> None:
    files = copied_network("lead_vehicle_stopped", 1)
    traffic = tmp_path / "traffic.rou.xml"
    traffic.write_text(files.traffic.read_text().replace('departPos="20"', 'departPos="84"'))
    with open_world(CopiedNetwork(files.network, traffic, files.options), 1) as world, pytest.raises(SimulationError, match="no place"):
        world.depart()
