"""User code: looked up by its name, checked before a call, and every fault of it is an error that
names it.
"""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.records import differences
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble
from tests.in_process import run
from tests.made_up import original_of
from tests.plugins.conftest import ADS, SCALAR, Mine

CONSTANT = SCALAR + "    def drive(self, seen):\n        return {}, 0.0\n"


def throttle(study: Path) -> float:
    system = assemble(load_study(str(study)))
    drive_and_score(system, original_of(system))
    driver = system.ads.start(1, system.nominal, 0.05)[0]
    return float(driver.drive(None)[0])


def test_beside_the_study_comes_before_the_working_directory(mine: Mine, folder: Path) -> None:
    Path("mine.py").write_text(CONSTANT.format(0.1))
    mine(CONSTANT.format(0.9))
    assert throttle(folder / "mine.toml") == 0.9
    (folder / "mine.py").unlink()
    assert throttle(folder / "mine.toml") == 0.1


@pytest.mark.parametrize(
    ("code", "ads", "where"),
    [
        (
            SCALAR + "    def drive(self, seen):\n        return 1 / 0\n",
            'model = "bought:Mine"',
            "drive",
        ),
        (
            "def step(traci, vehicle_id):\n    return 1 / 0\n",
            'model = "bought:step"\nkind = "traci"',
            "step",
        ),
    ],
)
def test_an_error_of_an_installed_driving_system_has_its_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, code: str, ads: str, where: str
) -> None:
    installed = folder / "site-packages"
    installed.mkdir()
    (installed / "bought.py").write_text(code)
    monkeypatch.syspath_prepend(str(installed))
    study = folder / "it.toml"
    study.write_text(f'extends = "smoke"\nname = "it"\n[ads]\n{ads}\n')
    line = len(code.splitlines())
    with pytest.raises(
        UserCodeError, match=rf"raised in {where}: ZeroDivisionError.*bought\.py:{line}\)"
    ):
        throttle(study)
    del sys.modules["bought"]


def test_two_studies_with_modules_of_one_name_get_their_own_whatever_the_order(
    tmp_path: Path,
) -> None:
    for place, value in (("a", 0.2), ("b", 0.4)):
        (tmp_path / place).mkdir()
        (tmp_path / place / "mine.toml").write_text(f'extends = "smoke"\nname = "mine"\n{ADS}')
        (tmp_path / place / "mine.py").write_text(
            "from sibling import VALUE\n" + CONSTANT.format("VALUE")
        )
        (tmp_path / place / "sibling.py").write_text(f"VALUE = {value}\n")
    result = [throttle(tmp_path / place / "mine.toml") for place in ("a", "b", "a")]
    assert result == [0.2, 0.4, 0.2]


def test_a_module_that_was_edited_is_read_anew_and_so_is_what_it_imports(
    mine: Mine, folder: Path
) -> None:
    (folder / "sibling.py").write_text("VALUE = 0.2\n")
    mine("from sibling import VALUE\n" + CONSTANT.format("VALUE"))
    assert throttle(folder / "mine.toml") == 0.2
    (folder / "sibling.py").write_text("VALUE = 0.6\n")  # as long as before, within the same second
    assert throttle(folder / "mine.toml") == 0.6


def test_a_file_named_like_an_installed_module_is_refused_only_where_it_is_meant(
    mine: Mine, folder: Path
) -> None:
    (folder / "scipy.py").write_text("raise RuntimeError('not scipy')")
    mine("import numpy, scipy\n" + CONSTANT.format(0.1))
    (folder / "numpy.py").write_text(CONSTANT.format(0.1))
    with pytest.raises(InputError, match=r"cannot be imported: .*numpy/__init__.py has no 'Mine'"):
        mine("", '[ads]\nmodel = "numpy:Mine"\n')


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        ("os:system", "not a class"),
        ("mine:Mine", "has no method drive(seen)"),
        ("mine:NotEnough", "has a method drive that does not take (seen, memory)"),
        ("mine:Scalar", "has a method drive that does not take (seen)"),
        ("mine:Odd", "has no method drive(seen, memory)"),
        ("mine:nothing", "has no 'nothing'"),
        ("mine:Mine.Inner", "mine:Mine.Inner"),
    ],
)
def test_a_class_that_does_not_meet_the_contract_is_refused_before_a_call(
    model: str, expected: str, mine: Mine, folder: Path
) -> None:
    module = (
        SCALAR + "    pass\n\n\nclass Called:\n    def __init__(self):\n        open('called',"
        " 'w').close()\n\n    def start(self, n, nominal, step): ...\n\n\nclass"
        " NotEnough(Called):\n    def drive(self, seen): ...\n\n\nclass Odd(Called):\n    drive ="
        " 3\n\n\nclass Scalar(ScalarAds):\n    def drive(self, seen, memory): ...\n"
    )
    with pytest.raises(InputError) as caught:
        mine(module, f'[ads]\nmodel = "{model}"\nparameters = {{ command = "touch called" }}\n')
    assert expected in str(caught.value)
    assert len(str(caught.value).splitlines()) <= 2
    assert not Path("called").exists()


@pytest.mark.parametrize(
    ("module", "expected"),
    [
        (
            "import nothing_of_that_name\n",
            "ModuleNotFoundError: No module named 'nothing_of_that_name' ({}:1)",
        ),
        ("\n\n1 / 0\n", "ZeroDivisionError: division by zero ({}:3)"),
        ("x = (\n", "SyntaxError: '(' was never closed"),
    ],
)
def test_a_module_that_fails_is_reported_with_its_line_and_can_be_corrected(
    module: str, expected: str, mine: Mine, folder: Path
) -> None:
    with pytest.raises(InputError) as caught:
        mine(module)
    assert expected.format(folder / "mine.py") in str(caught.value)
    mine(CONSTANT.format(0.3))
    assert "mine" in sys.modules


VEHICLE = '[vehicle]\nmodel = "mine:Mine"\n[vehicle.characteristics]\n{}\n[ads]\nmodel = "krauss"\n'
SCENARIO = '[scenario]\nmodel = "mine:Mine"\n'
NATIVE = load_study("native")
ROWS = "\n".join(
    f'{name} = {{ unit = "{row.unit}", original = {row.original}, lower = {row.lower}, upper ='
    f" {row.upper} }}"
    for name, row in NATIVE.vehicle.characteristics.items()
)


def failing(system: object) -> str:
    settings = np.repeat(original_of(system), 3, axis=0)  # type: ignore[attr-defined]
    with pytest.raises(UserCodeError) as caught:
        drive_and_score(system, settings)  # type: ignore[arg-type]
    assert len(str(caught.value).splitlines()) <= 2
    return str(caught.value)


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("1 / 0", "raised in drive: ZeroDivisionError: division by zero"),
        (r"raise RuntimeError('my\n message')", "raised in drive: RuntimeError: my message ("),
        ("raise KeyboardInterrupt", "raised in drive: KeyboardInterrupt ("),
        ("pass", "returned None from drive"),
        ("return 0, 2", "returned brake = 2.0 from drive"),
    ],
)
def test_a_scalar_ads_that_is_wrong(body: str, expected: str, mine: Mine, folder: Path) -> None:
    message = failing(mine(SCALAR + f"    def drive(self, seen):\n        {body}\n"))
    subject = "user code" if "raised" in expected else "ads.model = 'mine:Mine'"
    assert f"{subject} {expected}" in message
    assert f"({folder / 'mine.py'}:{6 if 'raised' in expected else 5})" in message, (
        "the line that raises, or the method's own"
    )


PRESSED = (
    "    def drive(self, seen):\n        import signal\n       "
    " signal.raise_signal(signal.{})\n        return 0, 0\n"
)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_ctrl_c_passes(name: str, mine: Mine) -> None:
    """Its handler is the same afterwards."""
    ctrl_c = mine(SCALAR + PRESSED.format(name))
    number = signal.Signals[name]
    handler = signal.signal(number, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            drive_and_score(ctrl_c, original_of(ctrl_c))
        assert signal.getsignal(number) is signal.default_int_handler
    finally:
        signal.signal(number, handler)


def test_what_user_code_does_on_ctrl_c_stays(mine: Mine) -> None:
    handler = signal.getsignal(signal.SIGINT)
    own = (
        "        import signal\n        signal.signal(signal.SIGINT, print)\n        return 0, 0\n"
    )
    system = mine(f"{SCALAR}    def drive(self, seen):\n{own}")
    try:
        drive_and_score(system, original_of(system))
        assert signal.getsignal(signal.SIGINT) is print
    finally:
        signal.signal(signal.SIGINT, handler)


@pytest.mark.parametrize(
    ("drive", "code", "message"),
    [
        (PRESSED.format("SIGINT"), 130, "interrupted"),
        (PRESSED.format("SIGTERM"), 130, "interrupted"),
        (
            "    def drive(self, seen):\n        raise KeyboardInterrupt\n",
            2,
            "user code raised in drive: KeyboardInterrupt (",
        ),
    ],
)
def test_a_command_is_interrupted_by_ctrl_c_alone(
    drive: str, code: int, message: str, mine: Mine, folder: Path
) -> None:
    mine(SCALAR + drive)
    assert message in run("simulate", str(folder / "mine.toml"), expect=code).stderr


ARRAYS = "from safevar_sumo.records import Command\n\n\n"
ARRAYS += (
    "class Mine:\n    def start(self, n, nominal, step):\n        return n\n\n    def drive(self,"
    " seen, memory):\n"
)


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("seen.speed[:] = 0", "ValueError: assignment destination is read-only"),
        (
            "return (seen.speed * 0, seen.speed), memory",
            "an object with the attributes throttle, brake",
        ),
        ("return Command(seen.speed * 0, seen.speed[:2]), memory", "brake of shape (2,)"),
    ],
)
def test_an_ads_over_arrays_that_is_wrong(body: str, expected: str, mine: Mine) -> None:
    assert expected in failing(mine(ARRAYS + f"        {body}\n"))


def delegated(method: str, body: str, **arguments_of: str) -> str:
    """Methods that call those of the inner model; `method` does more: `body`."""
    return "".join(
        f"    def {name}(self, {arguments}):\n        result = self.inner.{name}({arguments})\n"
        f"        {body if name == method else 'pass'}\n        return result\n\n"
        for name, arguments in arguments_of.items()
    )


def vehicle(method: str, body: str) -> str:
    return (
        "import numpy as np\nfrom safevar_sumo.vehicles.sensing import SumoVehicle\n\n\nclass"
        " Mine:\n    UNITS = SumoVehicle.UNITS\n\n    def __init__(self):\n        self.inner ="
        " SumoVehicle(reference_mass=1500)\n\n    def prepare(self, characteristics, road_friction,"
        " step):\n        return self.inner.prepare(characteristics, road_friction, step)\n\n"
        + delegated(
            method,
            body,
            sumo_type="prepared",
            at_rest="prepared",
            sense="prepared, state, seen",
            advance="prepared, state, command",
        )
    )


@pytest.mark.parametrize(
    ("method", "body", "expected"),
    [
        ("advance", "result = result._replace(speed=-result.speed - 1)", "returned speed = -"),
        (
            "advance",
            "result = result._replace(speed=np.zeros(7))",
            "returned speed of shape (7,) from advance",
        ),
        (
            "at_rest",
            "result = result._replace(speed=result.speed + 9)",
            "returned speed = 9.0 from at_rest",
        ),
        ("sense", "result = result[0]", "from sense"),
        (
            "sense",
            "result = (result[0]._replace(gap=result[0].gap * np.nan), result[1])",
            "returned gap = nan from sense",
        ),
        (
            "sumo_type",
            "result = result._replace(decel=0 * result.decel)",
            "returned decel = 0.0 from sumo_type",
        ),
    ],
)
def test_a_vehicle_that_is_wrong(method: str, body: str, expected: str, mine: Mine) -> None:
    def tried() -> None:
        system = mine(vehicle(method, body), VEHICLE.format(ROWS))
        drive_and_score(system, np.repeat(original_of(system), 3, axis=0))

    with pytest.raises(UserCodeError) as caught:
        tried()
    assert expected in str(caught.value)
    assert "vehicle.model = 'mine:Mine'" in str(caught.value)


def scenario(method: str, body: str) -> str:
    return (
        "import numpy as np\nfrom safevar_sumo.scenarios import PedestrianCrossing\n\n\nclass"
        " Mine:\n    network, duration = 'pedestrian_crossing', 2.0\n\n    def __init__(self):\n   "
        "     self.inner = PedestrianCrossing()\n\n"
        + delegated(method, body, begin="world", observe="world, step, memory", encounter="trace")
    )


@pytest.mark.parametrize(
    ("method", "body", "expected"),
    [
        ("begin", "world.vehicle_positions('vut')[:] = 0", "read-only"),
        (
            "observe",
            "result = (result[0]._replace(gap=result[0].gap * np.nan), result[1])",
            "returned gap = nan from observe",
        ),
        (
            "observe",
            "result = (result[0]._replace(over=result[0].gap), result[1])",
            "returned over",
        ),
        (
            "observe",
            "result = (result[0]._replace(gap='near'), result[1])",
            "returned gap = 'near'",
        ),
        (
            "encounter",
            "result = result._replace(separation=result.separation[0])",
            "returned separation of shape (3,)",
        ),
        ("begin", "raise ValueError('boom')", "user code raised in begin: ValueError: boom"),
        ("observe", "raise ValueError('boom')", "user code raised in observe: ValueError: boom"),
        (
            "encounter",
            "return result\n\n    def actors(self, roads):\n        result = None",
            "returned None from actors",
        ),
        (
            "encounter",
            (
                "result = result._replace(in_conflict=result.in_conflict | True,"
                " distance=result.distance * np.nan)"
            ),
            "returned distance = nan",
        ),
    ],
)
@pytest.mark.parametrize("reacts", [True, False])
def test_a_scenario_that_is_wrong(
    method: str, body: str, expected: str, reacts: bool, mine: Mine
) -> None:
    module = scenario(method, body).replace("2.0\n", f"2.0\n    reactive_actors = {reacts}\n", 1)
    message = failing(mine(module, SCENARIO))
    assert expected in message
    assert ("mine.py" if "raised" in message else "scenario.model = 'mine:Mine'") in message


def test_what_user_code_tells_numpy_ends_with_its_call(mine: Mine) -> None:
    """The package divides by closing speeds of 0."""
    strict = "import numpy as np\n\nnp.seterr(all='raise')\n" + CONSTANT.format(0.2)
    strict = strict.replace(
        "def drive(self, seen):\n", "def drive(self, seen):\n        np.seterr(all='raise')\n"
    )
    before = np.geterr()
    expected = drive_and_score(system := mine(CONSTANT.format(0.2)), original_of(system))
    found = drive_and_score(mine(strict), original_of(system))
    assert not [*differences(expected.results, found.results)]
    assert np.geterr() == before


def test_a_simulation_in_this_process_that_takes_longer_than_the_limit_names_the_line(
    mine: Mine,
) -> None:
    system = mine(
        CONSTANT.format("__import__('time').sleep(60)"), f"{ADS}[search]\ntime_limit = 0.2\n"
    )
    with pytest.raises(
        UserCodeError, match=r"longer than the time limit of 0\.2 s \(.*mine\.py:6\)"
    ):
        drive_and_score(system, original_of(system))


def test_user_code_that_catches_all_errors_ends_at_the_time_limit_too(mine: Mine) -> None:
    module = (
        CONSTANT.format("[wait() for _ in range(9)]")
        + "\n\ndef wait():\n    try:\n        __import__('time').sleep(60)\n    except Exception:\n"
        "        pass\n"
    )
    system = mine(module, f"{ADS}[search]\ntime_limit = 0.2\n")
    with pytest.raises(UserCodeError, match="longer than the time limit"):
        drive_and_score(system, original_of(system))
