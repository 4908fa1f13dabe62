"""Every exception and every wrong result of a user's model is a UserCodeError; a model cannot alter measurements."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import assemble
from tests.plugins.beside import SCALAR, Mine

VEHICLE = '[vehicle]\nmodel = "mine:Mine"\n[vehicle.characteristics]\n{}\n[ads]\nmodel = "krauss"\n'
SCENARIO = '[scenario]\nmodel = "mine:Mine"\n'
NATIVE = load_study("native")
ROWS = "\n".join(
    f'{name} = {{ unit = "{row.unit}", original = {row.original}, lower = {row.lower}, upper = {row.upper} }}'
    for name, row in NATIVE.vehicle.characteristics.items()
)


def failing(system: object) -> str:
    settings = np.repeat(system.characteristics.original[None], 3, axis=0)  # type: ignore[attr-defined]
    with pytest.raises(UserCodeError) as caught:
        evaluate(system, settings)  # type: ignore[arg-type]
    assert len(str(caught.value).splitlines()) <= 2
    return str(caught.value)


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("1 / 0", "raised in drive: ZeroDivisionError: division by zero"),
        ("raise SystemExit(0)", "raised in drive: SystemExit: 0"),
        ("raise GeneratorExit", "raised in drive: GeneratorExit ("),
        ("raise BaseException(1, 2)", "raised in drive: BaseException: (1, 2) ("),
        (r"raise RuntimeError('my\n message')", "raised in drive: RuntimeError: my message ("),
        ("pass", "returned None from drive"),
        ("return 0.5", "returned 0.5 from drive"),
        ("return 0.5, 0, 0", "returned (0.5, 0, 0) from drive"),
        ("return '0.5', 0", "returned throttle = '0.5' from drive"),
        ("return 0, 2", "returned brake = 2.0 from drive"),
        ("return float('nan'), 0", "returned throttle = nan"),
        ("return [0.1, 0.2], 0", "returned throttle of shape (2,)"),
    ],
)
def test_a_scalar_ads_that_is_wrong(body: str, expected: str, mine: Mine, folder: Path) -> None:
    message = failing(mine(SCALAR + f"    def drive(self, seen):\n        {body}\n"))
    assert f"ads.model = 'mine:Mine' {expected}" in message
    assert f"({folder / 'mine.py'}:{6 if 'raised' in expected else 5})" in message, (
        "the line that raises, or the method's own"
    )


def test_ctrl_c_passes(mine: Mine) -> None:
    ctrl_c, handler = (
        mine(
            SCALAR + "    def drive(self, seen):\n        import signal\n        signal.raise_signal(signal.SIGINT)\n"
        ),
        None,
    )
    try:
        handler = signal.signal(signal.SIGINT, signal.default_int_handler)
        with pytest.raises(KeyboardInterrupt):
            evaluate(ctrl_c, ctrl_c.characteristics.original[None])
    finally:
        signal.signal(signal.SIGINT, handler)


def test_a_wrong_parameter_is_named_with_the_study_s_file(mine: Mine, folder: Path) -> None:
    with pytest.raises(InputError, match="nothing"):
        mine("", "[ads.parameters]\nnothing = 3\n")
    with pytest.raises(InputError) as caught:
        assemble(load_study(folder / "mine.toml"))
    assert str(caught.value).startswith(f"{folder / 'mine.toml'}: ads.parameters.nothing: there is no such key")


ADS = "class Mine:\n    def start(self, n, nominal, step):\n        return n\n\n    def drive(self, seen, memory):\n"


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("seen.speed[:] = 0", "ValueError: assignment destination is read-only"),
        ("return seen.speed", "from drive"),
        ("return (seen.speed * 0, 0)", "from drive"),
        ("return (seen.speed * 0, seen.speed[:2]), memory", "brake of shape (2,)"),
        ("return (0, 10**400), memory", "returned brake"),
    ],
)
def test_an_ads_over_arrays_that_is_wrong(body: str, expected: str, mine: Mine) -> None:
    assert expected in failing(mine(ADS + f"        {body}\n"))


def vehicle(method: str, body: str) -> str:
    return (
        "import numpy as np\nfrom safevar_sumo.vehicles.sumo import SumoVehicle\n\n\nclass Mine:\n    UNITS "
        "= SumoVehicle.UNITS\n\n"
        "    def __init__(self):\n        self.inner = SumoVehicle(reference_mass=1500)\n\n"
        "    def prepare(self, characteristics, road_friction, step):\n"
        "        return self.inner.prepare(characteristics, road_friction, step)\n\n"
        + "".join(
            f"    def {name}(self, {arguments}):\n        result = self.inner.{name}({arguments})\n"
            f"        {body if name == method else 'pass'}\n        return result\n\n"
            for name, arguments in (
                ("sumo_type", "prepared"),
                ("at_rest", "prepared"),
                ("sense", "prepared, state, seen"),
                ("advance", "prepared, state, command"),
            )
        )
    )


@pytest.mark.parametrize(
    ("method", "body", "expected"),
    [
        ("advance", "result = result._replace(speed=-result.speed - 1)", "returned speed = -"),
        ("advance", "result = result._replace(speed=result.speed * np.nan)", "returned speed = nan from advance"),
        ("advance", "result = result._replace(speed=result.speed + np.inf)", "returned speed = inf from advance"),
        ("advance", "result = result._replace(speed='fast')", "returned speed = 'fast' from advance"),
        ("advance", "result = result._replace(speed=np.zeros(7))", "returned speed of shape (7,) from advance"),
        ("advance", "result = None", "returned None from advance"),
        ("at_rest", "result = result._replace(speed=None)", "returned speed = None from at_rest"),
        ("at_rest", "result = result._replace(speed=result.speed + 9)", "returned speed = 9.0 from at_rest"),
        ("sense", "result = result[0]", "from sense"),
        (
            "sense",
            "result = (result[0]._replace(gap=result[0].gap * np.nan), result[1])",
            "returned gap = nan from sense",
        ),
        (
            "sense",
            "result = (result[0]._replace(speed=result[0].gap + np.inf), result[1])",
            "returned speed = inf from sense",
        ),
        ("sumo_type", "result = result._replace(decel=0 * result.decel)", "returned decel = 0.0 from sumo_type"),
        ("sumo_type", "result = result[0]", "from sumo_type"),
        (
            "sumo_type",
            "result = result._replace(max_speed=0 * result.max_speed + 2)",
            "expected: up to max_speed = 2 of its sumo_type",
        ),
    ],
)
def test_a_vehicle_that_is_wrong(method: str, body: str, expected: str, mine: Mine) -> None:
    def tried() -> None:
        system = mine(vehicle(method, body), VEHICLE.format(ROWS))
        evaluate(system, np.repeat(system.characteristics.original[None], 3, axis=0))

    with pytest.raises(UserCodeError) as caught:
        tried()
    assert expected in str(caught.value)
    assert "vehicle.model = 'mine:Mine'" in str(caught.value)


def test_a_users_vehicle_drives_to_the_bit_like_the_vehicle_that_it_wraps(mine: Mine, folder: Path) -> None:
    guarded = mine(vehicle("", ""), VEHICLE.format(ROWS))
    (folder / "ours.toml").write_text(
        'extends = "smoke"\nname = "ours"\n'
        + VEHICLE.format(ROWS).replace('"mine:Mine"', '"sumo"\nparameters = { reference_mass = 1500 }')
    )
    ours = assemble(load_study(str(folder / "ours.toml")))
    settings = np.random.default_rng(1).uniform(
        ours.characteristics.lower, ours.characteristics.upper, (4, len(ours.characteristics))
    )
    one, other = evaluate(guarded, settings), evaluate(ours, settings)
    assert all(np.array_equal(one.metrics[name], other.metrics[name], equal_nan=True) for name in one.metrics)


def scenario(method: str, body: str) -> str:
    return (
        "import numpy as np\nfrom safevar_sumo.scenarios import PedestrianCrossing\n\n\nclass Mine:\n"
        "    network, duration = 'pedestrian_crossing', 2.0\n\n    def __init__(self):\n        self.inner = "
        "PedestrianCrossing()\n\n"
        + "".join(
            f"    def {name}(self, {arguments}):\n        result = self.inner.{name}({arguments})\n"
            f"        {body if name == method else 'pass'}\n        return result\n\n"
            for name, arguments in (("begin", "world"), ("observe", "world, step, memory"), ("encounter", "trace"))
        )
    )


@pytest.mark.parametrize(
    ("method", "body", "expected"),
    [
        ("begin", "world.person_positions('nobody')", "raised in begin"),
        ("begin", "world.advance([1.0])", "has no 'advance'"),
        ("begin", "world.vehicle_positions('vut')[:] = 0", "read-only"),
        ("observe", "result = None", "returned None from observe"),
        (
            "observe",
            "result = (result[0]._replace(gap=result[0].gap * np.nan), result[1])",
            "returned gap = nan from observe",
        ),
        (
            "observe",
            "result = (result[0]._replace(lateral=result[0].gap + np.inf), result[1])",
            "returned lateral = inf from observe",
        ),
        ("observe", "result = (result[0]._replace(over=result[0].gap), result[1])", "returned over"),
        ("observe", "result = (result[0]._replace(gap='near'), result[1])", "returned gap = 'near'"),
        ("encounter", "result = result._replace(separation=result.separation[0])", "returned separation of shape (3,)"),
        (
            "encounter",
            "result = result._replace(in_conflict=result.in_conflict | True, distance=result.distance * np.nan)",
            "returned distance = nan",
        ),
        ("encounter", "result = result._replace(separation=result.separation + np.inf)", "returned separation = inf"),
        ("encounter", "trace.speed[:] = 0", "read-only"),
    ],
)
def test_a_scenario_that_is_wrong(method: str, body: str, expected: str, mine: Mine) -> None:
    message = failing(mine(scenario(method, body), SCENARIO))
    assert expected in message
    assert "scenario.model = 'mine:Mine'" in message


@pytest.mark.parametrize(
    "values",
    [
        "network, duration = 7, 2.0",
        "network, duration = 'pedestrian_crossing', 'long'",
        "network, duration = 'pedestrian_crossing', -1",
        "network = 'pedestrian_crossing'",
    ],
)
def test_a_scenario_without_a_network_or_a_duration_is_refused(values: str, mine: Mine) -> None:
    with pytest.raises(UserCodeError, match=r"network|duration"):
        mine(scenario("", "").replace("network, duration = 'pedestrian_crossing', 2.0", values), SCENARIO)
