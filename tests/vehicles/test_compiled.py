"""The compiled step of `carla`: the bits of a plain Python loop over one vehicle, wherever a
vehicle stands in a batch; compiled once, and without a cache, too.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.campaign.batches import COMPILING, compile_vehicle
from safevar_sumo.records import Command
from safevar_sumo.vehicles import carla_step, compiled
from safevar_sumo.vehicles.carla_step import Car, CarlaState
from tests.support.in_process import SLOW, InlinePool, run_python
from tests.support.runs import STEP, SYSTEMS, drawn, prepare

CARLA = SYSTEMS["carla"].vehicle


@pytest.fixture(scope="module")
def plain() -> ModuleType:
    """The file of the equations as Python reads it."""
    spec = importlib.util.spec_from_file_location("plain", carla_step.__file__)
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "plain", module)
        patch.setattr(compiled, "equation", lambda function: function)
        patch.setattr(compiled, "compiled", lambda function: function)
        spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("n", [1, 65])
def test_a_step_has_the_bits_of_a_plain_loop_over_one_vehicle(
    n: int, plain: ModuleType
) -> None:
    """From rest through all gears, with held gears, to a standstill with locked wheels; the first
    and the last of n.
    """
    p = prepare("carla", drawn("carla", n, 3), road=0.6)
    rng = np.random.default_rng(5)
    state = CARLA.at_rest(p)
    cars = [Car(*map(float, p.rows[:, i])) for i in (0, n - 1)]
    alone = [CarlaState(*[0.0] * 8) for _ in cars]
    for step in range(round(20 / STEP)):
        throttle = np.where(step * STEP < 14, rng.choice([0.6, 1.0], n), 0.0)
        brake = np.where(step * STEP < 15, rng.choice([0.0, 0.02], n), 1.0)
        if step * STEP == 4:
            state = CARLA.hold_gear(p, state, np.full(n, True))
            alone = [one._replace(since_shift=-np.inf) for one in alone]
        if step * STEP == 6:
            state = CARLA.hold_gear(p, state, np.full(n, False))
            alone = [one._replace(since_shift=CARLA.shift_latency) for one in alone]
        state = CARLA.advance(p, state, Command(throttle, brake))
        for k, i in enumerate((0, n - 1)):
            one = alone[k]
            for _ in range(p.substeps):
                one = plain.move(
                    cars[k], p.law, one, float(throttle[i]), float(brake[i])
                )
            if one.brake > 0 and one.speed < cars[k].standstill:
                one = one._replace(speed=0.0, wheel_speed=0.0)
            alone[k] = one
            assert (
                np.array([column[i] for column in state]).tobytes()
                == np.array(one, dtype=float).tobytes()
            ), step
    assert alone[0].speed == 0.0


LOADING = """
from safevar_sumo.api.simulation import load_study
from safevar_sumo.sumo.system import assemble
vehicle = assemble(load_study("rain")).vehicle
print(vehicle.compile(only_load=True), vehicle.compile())
"""


def loaded(folder: str) -> str:
    """What a new process finds in a cache: whether the step is compiled, and is then; and its
    errors.
    """
    environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
    done = run_python("-c", LOADING, env=environment)
    return done.stdout.strip() + done.stderr


@SLOW
def test_a_process_finds_compiled_what_an_earlier_one_compiled(tmp_path: Path) -> None:
    assert [loaded(str(tmp_path)) for _ in range(2)] == ["False True", "True True"]


def test_without_a_cache_functions_are_compiled_in_silence(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Numba finds no folder for the file of a function that was typed."""
    code: dict[str, Any] = {}
    exec(compile("def double(x):\n    return 2.0 * x", "nowhere", "exec"), code)
    double = compiled.compiled(code["double"])
    assert not compiled.is_compiled(lambda: double(1.0))
    assert (
        double(1.5),
        compiled.is_compiled(lambda: double(1.0)),
        *capfd.readouterr(),
    ) == (
        3.0,
        True,
        "",
        "",
    )


@pytest.mark.parametrize("is_ready", [False, True])
def test_progress_says_that_the_vehicle_is_compiled_once_a_pool(
    is_ready: bool, monkeypatch: Any
) -> None:
    asked = list[bool]()
    shown = list[str]()

    def compile_model(self: Any, *, only_load: bool = False) -> bool:
        asked.append(only_load)
        return is_ready

    monkeypatch.setattr(type(CARLA), "compile", compile_model)
    pool = InlinePool()
    for name in ("rain", "rain", "lgsvl"):
        compile_vehicle(
            load_study(name), pool, lambda stage, done, total: shown.append(stage)
        )
    assert (asked, shown) == (
        ([True], []) if is_ready else ([True, False], [COMPILING])
    )
