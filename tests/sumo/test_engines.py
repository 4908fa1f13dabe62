"""libsumo in this process and SUMO behind a TraCI socket are the same simulation; TTC is SUMO's own TTC."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.errors import EnvironmentFault
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


def test_broken_traffic_is_an_error_in_sumos_words(tmp_path: Path) -> None:
    files = copied_network("lead_vehicle_stopped", 1)
    broken = tmp_path / "traffic.rou.xml"
    broken.write_text(files.traffic.read_text().replace("0.road", "nowhere"))
    with pytest.raises(EnvironmentFault, match="nowhere"), open_world(CopiedNetwork(files.network, broken, files.options), 1) as world:
        world.depart()
    with open_world(files, 1) as world:  # and the process is as good as before
        world.depart()
