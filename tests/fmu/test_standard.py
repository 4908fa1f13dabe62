"""Shipped models as FMUs drive as the originals; what the standard lets an FMU have."""

from __future__ import annotations

import multiprocessing
import re
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import psutil
import pytest

from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.records import Command
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import System, assemble
from tests.fmu.exported import CART, changed, exported
from tests.fmu.test_faults import Make, driven, edited, with_step

FULL_THROTTLE = Command(np.ones(1), np.zeros(1))
TABLE = """parameters = { where = 25.0 }
inputs = { gap = "gap" }
outputs = { brake = "pedal" }
"""


def test_an_fmu_of_fmi_3_is_given_and_tells_its_own_units(made: Path) -> None:
    """36 km/h are 10 m/s: 1.8 %; within 30,000 mm, 100 %."""
    (made / "third.toml").write_text("""
extends = "native"
name = "third"
[ads]
kind = "fmu"
model = "Third.fmu"
parameters = { where = 30000.0 }
inputs = { speed = "speed", gap = "gap" }
outputs = { brake = "wish" }
""")
    system = assemble(load_study(str(made / "third.toml")))
    np.testing.assert_allclose(
        driven(system, [40.0, 30.1, 29.9, 35.0]), [[0] * 4, [0.018, 0.018, 1.0, 0.018]], rtol=0, atol=1e-15
    )


@pytest.mark.parametrize(
    ("own", "step", "expected"),
    [
        (None, 0.1, [1, 2, 3, 4, 5, 6]),
        (0.02, 0.1, [5, 10, 15, 20, 25, 30]),
        (0.2, 0.1, [1, 1, 2, 2, 3, 3]),
        (0.06, 0.1, [2, 4, 5, 7, 9, 10]),
        (0.05, 0.025, [1, 1, 2, 2, 3, 3]),
    ],
)
def test_an_fmu_is_called_at_its_own_step(small: Make, own: float | None, step: float, expected: list[int]) -> None:
    """By the end of step k it has been called ceil((k + 1) step / own) times; between calls its outputs hold."""
    table = TABLE + (f"step = {own}" if own else "")
    np.testing.assert_allclose(
        driven(small("self.pedal = self.steps / 100", table), [20.0] * 6, step)[1], np.array(expected) / 100
    )
    np.testing.assert_allclose(driven(small("self.pedal = step", table), [20.0] * 2, step)[1], own or step)


def test_the_step_that_an_fmu_cannot_change_is_taken(small: Make) -> None:
    """In FMI 2.0: its default step, if it handles no other step."""
    np.testing.assert_allclose(
        driven(small("self.pedal = self.steps / 100", edit=with_step("0.025")), [20.0] * 3)[1], [0.04, 0.08, 0.12]
    )


@pytest.mark.slow
def test_one_instance_in_a_process_is_enough(small: Make) -> None:
    """Then each vehicle drives alone."""

    def degrees(system: System) -> np.ndarray:
        members = system.characteristics
        settings = members.original + np.linspace(0, 1, 9)[:, np.newaxis] * (members.upper - members.original)
        return evaluate(system, settings).f_safe

    table = TABLE.replace("brake", "acceleration").replace("25.0", "1e6")
    expected = degrees(small("self.pedal = 2.0 - 0.1 * self.steps", table))
    once = (
        "if now > 0 and Small.last is not self: raise RuntimeError('a second instance')\n            Small.last "
        "= self; "
    )
    with pytest.raises(UserCodeError, match="a second instance"):
        degrees(small(once + "self.pedal = 2.0 - 0.1 * self.steps", table))
    edit = edited('canBeInstantiatedOnlyOncePerProcess="false"', 'canBeInstantiatedOnlyOncePerProcess="true"')
    np.testing.assert_array_equal(degrees(small(once + "self.pedal = 2.0 - 0.1 * self.steps", table, edit)), expected)
    assert len(set(expected)) > 4


CART_TABLE = """
extends = "native"
name = "cart"
[ads]
model = "krauss"
[vehicle]
kind = "fmu"
model = "Cart.fmu"
inputs = {{ throttle = "accelerator", brake = "brake_pedal" }}
outputs = {{ speed = "v" }}
sumo_type = {{ mass = 1500, accel = "power", decel = "grip", max_speed = "top" }}
{more}
"""
DECLARED = {
    "power": 'unit="km/h/s" min="7.2" max="14.4"',
    "grip": 'unit="m/s2" min="5" max="9"',
    "top": 'unit="m/s" min="20"',
}
UNITS = (
    '<UnitDefinitions><Unit name="km/h/s"><BaseUnit m="1" s="-2" factor="0.2777777777777778"/></Unit></UnitDefinitions>'
)


@pytest.fixture
def cart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a cart whose parameters have units and domains."""
    monkeypatch.chdir(tmp_path)
    made = exported(CART, tmp_path, "cart").rename("plain.fmu")

    def edit(text: str) -> str:
        for name, said in DECLARED.items():
            text = re.sub(f'(name="{name}"[^>]*>\\s*<Real) ', f"\\1 {said} ", text)
        return text.replace("<ModelVariables>", UNITS + "<ModelVariables>")

    changed(made, tmp_path / "Cart.fmu", edit)
    return tmp_path


def test_a_vehicles_characteristics_are_the_parameters_that_its_fmu_declares(cart: Path) -> None:
    """The study's rows override them and may have another unit; a parameter without a bound needs a row to be a
    characteristic.
    """

    def rows(more: str) -> dict[str, tuple[str, float, float, float]]:
        (cart / "cart.toml").write_text(CART_TABLE.format(more=more))
        study = load_study("cart.toml")
        return {
            name: (row.unit, row.original, row.lower, row.upper) for name, row in study.vehicle.characteristics.items()
        }

    declared = {"power": ("km/h/s", 3.0, 7.2, 14.4), "grip": ("m/s2", 8.0, 5.0, 9.0)}
    with pytest.raises(InputError, match=r"characteristics.power.original = 3.0"):
        rows("")  # the start value is in the declared unit, and outside the declared domain
    over = "[vehicle.characteristics]\npower = { original = 10.8 }"
    assert rows(over) == {**declared, "power": ("km/h/s", 10.8, 7.2, 14.4)}
    assert rows(f"parameters = {{ grip = 7.0 }}\n{over}").keys() == {"power"}
    assert rows(over + "\ntop = { upper = 40 }")["top"] == ("m/s", 30.0, 20.0, 40.0)
    assert rows("[vehicle.characteristics]\npower = { unit = 'm/s^2', original = 3.0 }")["power"] == pytest.approx(
        ("m/s^2", 3.0, 2.0, 4.0)
    )


def test_a_characteristic_reaches_its_fmu_in_the_unit_that_it_declares(cart: Path) -> None:
    """Full throttle for 0.1 s gives 3 m/s^2 for every unit of the row; a unit of mass is refused."""
    text = CART_TABLE.replace('accel = "power"', "accel = 3.0")
    for row, power in (("power = { original = 10.8 }", 10.8), ("power = { unit = 'm/s^2', original = 3.0 }", 3.0)):
        (cart / "cart.toml").write_text(text.format(more=f"[vehicle.characteristics]\n{row}"))
        vehicle = assemble(load_study("cart.toml")).vehicle
        prepared = vehicle.prepare({"power": np.array([power]), "grip": np.array([8.0])}, 1.0, 0.1)
        state = vehicle.advance(prepared, vehicle.at_rest(prepared), FULL_THROTTLE)
        np.testing.assert_allclose(state.speed[0], 10.8 * 0.1)  # the FMU computes in its own unit
    wet = vehicle.prepare({"power": np.array([power]), "grip": np.array([8.0])}, 1.0, 0.1, wet=np.array([True]))
    assert (prepared.inputs["wet"], wet.inputs["wet"]) == (0, 1)
    row = "power = { unit = 'kg', original = 1, lower = 0.5, upper = 2 }"
    (cart / "cart.toml").write_text(text.format(more=f"[vehicle.characteristics]\n{row}"))
    with pytest.raises(InputError, match="its unit is 'km/h/s'"):
        assemble(load_study("cart.toml"))


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        (
            "[vehicle.ch",
            "sensors = { range = 0.0 }\n[vehicle.ch",
            "vehicle.sensors.range = 0\nexpected: a number above 0",
        ),
        (
            "[vehicle.ch",
            "sensors = { latency = -1 }\n[vehicle.ch",
            "vehicle.sensors.latency = -1\nexpected: a number of at least 0",
        ),
        (
            "[vehicle.ch",
            'sensors = { range = "v" }\n[vehicle.ch',
            "vehicle.sensors.range = 'v': there is no such characteristic",
        ),
        ("mass = 1500", "mass = 0.0", "vehicle.sumo_type.mass = 0"),
        (
            "10.8",
            "10.8, lower = 0",
            "vehicle.characteristics.power.lower = 0, the value of vehicle.sumo_type.accel\nexpected: a number above 0",
        ),
    ],
)
def test_what_no_vehicle_has_is_refused(old: str, new: str, problem: str, cart: Path) -> None:
    text = CART_TABLE.format(more="[vehicle.characteristics]\npower = { original = 10.8 }")
    (cart / "cart.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as error:
        assemble(load_study("cart.toml"), "cart.toml")
    assert str(error.value).startswith(f"cart.toml: {problem}")


def test_a_vehicle_of_another_step_is_where_its_line_between_two_points_is_and_goes_back_to_where_it_was(
    cart: Path,
) -> None:
    """A step of 0.4 s in a simulation with steps of 0.1 s; a second drive from a state in the middle is the same as the
    first.
    """
    (cart / "cart.toml").write_text(
        CART_TABLE.format(more="step = 0.4\n[vehicle.characteristics]\npower = { original = 10.8 }")
    )
    vehicle = assemble(load_study("cart.toml")).vehicle
    prepared = vehicle.prepare({"power": np.array([10.0]), "grip": np.array([8.0])}, 1.0, 0.1)
    states = [vehicle.at_rest(prepared)]
    for _ in range(6):
        states.append(vehicle.advance(prepared, states[-1], FULL_THROTTLE))
    np.testing.assert_allclose([one.speed[0] for one in states], np.arange(7.0))
    braked = vehicle.advance(prepared, states[4], Command(np.zeros(1), np.ones(1)))
    again = vehicle.advance(prepared, states[4], FULL_THROTTLE)
    np.testing.assert_allclose([braked.speed[0], again.speed[0]], [4 - 0.8, 5])


SETTINGS = 200
SIMULATIONS = 2_000
MOST_MEMORY = 20e6
"""Largest growth of the memory of all processes over these simulations [bytes]."""


def memory() -> int:
    """Memory of this process and its child processes [bytes]."""
    me = psutil.Process()
    return sum(process.memory_info().rss for process in (me, *me.children(recursive=True)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["exported_aeb", "exported_vehicle"])
def test_an_exported_model_drives_as_the_original(made: Path, name: str) -> None:
    native, fmu = (assemble(load_study(str(made / f"{one}.toml"))) for one in ("native_aeb", name))
    rng, members = np.random.default_rng(5), native.characteristics
    drawn = rng.uniform(members.lower, members.upper, (SETTINGS, len(members)))
    settings = members.filter(members.original + 0.6 * (drawn - members.original))
    expected, results = evaluate(native, settings), evaluate(fmu, settings)
    assert 20 < np.sum(expected.outcome == "collision") < 180
    np.testing.assert_array_equal(results.outcome, expected.outcome)
    for metric, values in expected.metrics.items():
        np.testing.assert_allclose(results.metrics[metric], values, rtol=0, atol=1e-9, err_msg=metric)


def growth_of_memory(path: str) -> int:
    """How much the memory of this process and its children grows over many simulations [bytes]."""
    system = assemble(load_study(path))
    members = system.characteristics
    settings = members.filter(np.random.default_rng(6).uniform(members.lower, members.upper, (SETTINGS, len(members))))
    first = evaluate(system, settings).f_safe
    for _ in range(2):  # fills caches
        evaluate(system, settings)
    before = memory()
    for _ in range(SIMULATIONS // SETTINGS):
        last = evaluate(system, settings).f_safe
    np.testing.assert_array_equal(last, first)
    return memory() - before


@pytest.mark.slow
def test_two_thousand_simulations_leave_nothing_behind(made: Path) -> None:
    """In a process of their own: in one that has run other tests, memory comes and goes."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        assert process.submit(growth_of_memory, str(made / "small.toml")).result() < MOST_MEMORY
