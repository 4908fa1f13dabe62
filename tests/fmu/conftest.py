"""FMUs, exported once for all tests, and studies that use them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from safevar_sumo.study import load_study
from safevar_sumo.sumo.system import System, assemble
from tests.fmu.exported import SEEN, SMALL, SMALL_3, VEHICLE, aeb, exported

NATIVE = """
extends = "native"
name = "native_aeb"
[ads]
model = "aeb"
parameters = { margin = 6.0, cruise_speed = 8.0 }
"""
ADS = f"""
extends = "native_aeb.toml"
name = "exported_aeb"
[ads]
kind = "fmu"
model = "ExportedAeb.fmu"
parameters = {{ margin = 6.0 }}
inputs = {{ step = "interval", {", ".join(f'{name} = "seen_{name}"' for name in SEEN)} }}
outputs = {{ throttle = "accelerator", brake = "brake_pedal" }}
"""
QUICK_ADS = """
extends = "native"
name = "small"
[ads]
kind = "fmu"
model = "Small.fmu"
parameters = { where = 1e9 }
inputs = { gap = "gap", speed = "speed" }
outputs = { acceleration = "pedal" }
"""
PLANT = """
extends = "native_aeb.toml"
name = "exported_vehicle"
[vehicle]
kind = "fmu"
model = "ExportedVehicle.fmu"
inputs.throttle = "accelerator"
inputs.brake = "brake_pedal"
inputs.road_friction = "friction"
inputs.step = "interval"
inputs.initial_speed = "start_speed"
outputs = { speed = "v", throttle = "throttle_now", brake = "brake_now" }
sensors = { latency = "reactionTime", range = "sensorRange" }
sumo_type.mass = "mass"
sumo_type.accel = "most_accel"
sumo_type.decel = "most_decel"
sumo_type.max_speed = "maxSpeed"
sumo_type.actuator_lag = "actuatorLag"
[vehicle.characteristics]
"""


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the FMUs and their studies."""
    folder = tmp_path_factory.mktemp("fmus")
    (folder / "native_aeb.toml").write_text(NATIVE)
    study = load_study(str(folder / "native_aeb.toml"))
    exported(aeb(assemble(study).nominal), folder, "aeb")
    exported(VEHICLE, folder, "vehicle")
    exported(SMALL_3, folder, "small_3", third=True)
    rows = "".join(
        f'{name} = {{ unit = "{row.unit}", original = {row.original}, lower = {row.lower}, upper = {row.upper} }}\n'
        for name, row in study.vehicle.characteristics.items()
    )
    exported(SMALL.format(then="self.pedal = 8.0 - self.speed if self.gap > 15 else -9.0"), folder, "small")
    (folder / "small.toml").write_text(QUICK_ADS)
    (folder / "exported_aeb.toml").write_text(ADS)
    (folder / "exported_vehicle.toml").write_text(PLANT + rows)
    return folder


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., System]:
    """The system of an FMU that runs `then` within a gap of 25 m; `table` replaces the study's table, `edit` changes
    the FMU's file.
    """
    monkeypatch.chdir(tmp_path)

    def system(
        then: str = "self.pedal = 1.0",
        table: str = "",
        edit: Callable[[Path], object] = lambda fmu: None,
        time_limit: float = 300,
        options: dict[str, str] | None = None,
    ) -> System:
        fmu = exported(SMALL.format(then=then), tmp_path, "small", **options or {})
        edit(fmu)
        (tmp_path / "small.toml").write_text(f"""
extends = "native"
name = "small"
[ads]
kind = "fmu"
model = "Small.fmu"
{
            table
            or '''parameters = { where = 25.0 }
inputs = { gap = "gap", speed = "speed" }
outputs = { brake = "pedal" }'''
        }
[search]
time_limit = {time_limit}
""")
        return assemble(load_study("small.toml"), "small.toml")

    return system
