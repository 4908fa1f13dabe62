"""A script as SUMO users write it drives the vehicle under test: it reads SUMO, and what it commands goes through the plant."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.records import Outcome
from safevar_sumo.simulation import Engine, System, assemble, simulate
from safevar_sumo.study import ModelTable, load_study

SCRIPT = '''
def step(traci, vehicle_id):
    traci.vehicle.setSpeedMode(vehicle_id, 0)
    speed = traci.vehicle.getSpeed(vehicle_id)
    leader = traci.vehicle.getLeader(vehicle_id, 100)
    decel = traci.vehicle.getDecel(vehicle_id)
    if leader and leader[0] == "parked_ahead" and leader[1] < 3 + speed * 0.5 + speed ** 2 / (2 * 0.6 * decel):
        traci.vehicle.slowDown(vehicle_id, 0, max(speed / (0.6 * decel), 0.1))
    else:
        traci.vehicle.setSpeed(vehicle_id, 12)


def idle(traci, vehicle_id):
    assert traci.vehicle.getIDList() and set(traci.vehicle.getIDList()) == {"parked_ahead", "parked_beside", vehicle_id}
    assert traci.simulation.getTime() < 17


def jumps(traci, vehicle_id):
    traci.vehicle.moveTo(vehicle_id, "road_0", 50)


class Harsh:
    def start(self, traci, vehicle_id):
        traci.vehicle.setSpeedMode(vehicle_id, 32)

    def step(self, traci, vehicle_id):
        time = traci.simulation.getTime()
        traci.vehicle.setAcceleration(vehicle_id, 2.0 if time < 3 else -100.0, 1.0)
'''


def system(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> System:
    (folder / "my_controller.py").write_text(SCRIPT)
    monkeypatch.chdir(folder)
    return assemble(msgspec.structs.replace(load_study("native"), ads=ModelTable(model=f"my_controller:{name}", kind="traci")))


def test_a_script_stops_the_original_and_not_a_vehicle_that_has_lost_its_brakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = system("step", tmp_path, monkeypatch)
    weak = found.characteristics.original.copy()
    weak[found.characteristics.names.index("decel")] = 4.5
    weak[found.characteristics.names.index("brakeGain")] = 0.6
    both = np.stack([found.characteristics.original, weak])
    run = simulate(found, both)
    assert run.outcome.tolist() == [Outcome.STOPPED, Outcome.COLLISION]
    alone = simulate(found, both[1:])
    length = len(alone.trace.time)
    assert alone.trace.speed[:, 0].tobytes() == np.ascontiguousarray(run.trace.speed[:length, 1]).tobytes()
    assert run.trace.speed.max() == pytest.approx(12, abs=0.7)


def test_through_a_socket_it_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = system("step", tmp_path, monkeypatch)
    one = found.characteristics.original[np.newaxis]
    here, socket = (simulate(found, one, engine) for engine in (Engine.LIBSUMO, Engine.TRACI))
    assert here.trace.speed.tobytes() == socket.trace.speed.tobytes()


def test_without_a_command_sumos_own_driver_drives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = system("idle", tmp_path, monkeypatch)
    run = simulate(found, np.repeat(found.characteristics.original[np.newaxis], 2, axis=0))
    assert run.trace.speed.max() > 5
    assert run.trace.brake.max() > 0.5, "for the parked vehicle"


def test_a_wish_is_what_the_plant_makes_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = system("Harsh", tmp_path, monkeypatch)
    run = simulate(found, found.characteristics.original[np.newaxis])
    hardest = -np.diff(run.trace.speed[:, 0]).min() / run.trace.step
    assert 7 < hardest < 9.0
    assert run.outcome[0] == Outcome.STOPPED


@pytest.mark.parametrize(("name", "told"), [("jumps", "moveTo"), ("nothing", "has no 'nothing'")])
def test_what_it_may_not_do_is_told(name: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def drive() -> None:
        found = system(name, tmp_path, monkeypatch)
        simulate(found, found.characteristics.original[np.newaxis])

    with pytest.raises(InputError, match=told):
        drive()


@pytest.mark.parametrize(("table", "told"), [
    ({"model": "my_controller:Hrash", "kind": "traci"}, r"has no 'Hrash'\nlegal: package.module:Name$"),
    ({"model": "my_controller:Harsh", "kind": "traci", "parameters": {"margin": 2}}, r"^mine: ads.model = .* does not take ads.parameters"),
    ({"model": "my_controller:step", "kind": "traci", "parameters": {"margin": 2}}, r"^mine: ads.model = .* does not take ads.parameters"),
    ({"model": "my_controller:step"}, r'not a class\nlegal: .*; or with ads.kind = "traci" a function step\('),
])
def test_a_table_that_cannot_be_used_is_told_before_anything_is_simulated(
        table: dict[str, object], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_controller.py").write_text(SCRIPT)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=told):
        assemble(msgspec.structs.replace(load_study("native"), ads=msgspec.convert(table, ModelTable)), "mine")
