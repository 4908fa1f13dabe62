"""Places where a name in a study is looked up; code is not called before it meets its contract."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import assemble
from tests.plugins.beside import ADS, SCALAR, Mine

CONSTANT = SCALAR + "    def drive(self, seen):\n        return {}, 0.0\n"


def throttle(study: Path) -> float:
    system = assemble(load_study(str(study)))
    evaluate(system, system.characteristics.original[None])
    driver = system.ads.start(1, system.nominal, 0.05)[0]
    return float(driver.drive(None)[0])


def test_beside_the_study_comes_before_the_working_directory(mine: Mine, folder: Path) -> None:
    Path("mine.py").write_text(CONSTANT.format(0.1))
    mine(CONSTANT.format(0.9))
    assert throttle(folder / "mine.toml") == 0.9
    (folder / "mine.py").unlink()
    assert throttle(folder / "mine.toml") == 0.1


def test_two_studies_with_modules_of_one_name_get_their_own_whatever_the_order(tmp_path: Path) -> None:
    for place, value in (("a", 0.2), ("b", 0.4)):
        (tmp_path / place).mkdir()
        (tmp_path / place / "mine.toml").write_text(f'extends = "smoke"\nname = "mine"\n{ADS}')
        (tmp_path / place / "mine.py").write_text("from sibling import VALUE\n" + CONSTANT.format("VALUE"))
        (tmp_path / place / "sibling.py").write_text(f"VALUE = {value}\n")
    result = [throttle(tmp_path / place / "mine.toml") for place in ("a", "b", "a")]
    assert result == [0.2, 0.4, 0.2]


def test_a_module_that_was_edited_is_read_anew_and_so_is_what_it_imports(mine: Mine, folder: Path) -> None:
    (folder / "sibling.py").write_text("VALUE = 0.2\n")
    mine("from sibling import VALUE\n" + CONSTANT.format("VALUE"))
    assert throttle(folder / "mine.toml") == 0.2
    (folder / "sibling.py").write_text("VALUE = 0.6\n")  # as long as before, within the same second
    assert throttle(folder / "mine.toml") == 0.6


def test_a_file_with_the_name_of_an_installed_module_is_refused_where_it_is_meant_and_ignored_where_not(
    mine: Mine, folder: Path
) -> None:
    (folder / "scipy.py").write_text("raise RuntimeError('not scipy')")
    mine("import numpy, scipy\n" + CONSTANT.format(0.1))
    (folder / "numpy.py").write_text(CONSTANT.format(0.1))
    with pytest.raises(InputError, match=r"cannot be imported: AttributeError: .*numpy/__init__.py has no 'Mine'"):
        mine("", '[ads]\nmodel = "numpy:Mine"\n')


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        ("os:system", "is a function, not a class"),
        ("os:path", "is a module, not a class"),
        ("subprocess:Popen", "has no method start(n, nominal, step)"),
        ("mine:Mine", "has no method drive(seen)"),
        ("mine:NotEnough", "has a method drive that does not take (seen, memory)"),
        ("mine:Scalar", "has a method drive that does not take (seen)"),
        ("mine:Odd", "has drive = 3 instead of a method drive(seen, memory)"),
        ("mine:nothing", "has no 'nothing'"),
        ("__main__:Mine", "cannot import from __main__"),
        ("mine:", "mine:"),
        (":Mine", ":Mine"),
        ("no where:Mine", "no where:Mine"),
        ("mine:Mine.Inner", "mine:Mine.Inner"),
    ],
)
def test_a_class_that_does_not_meet_the_contract_is_refused_before_a_call(
    model: str, expected: str, mine: Mine, folder: Path
) -> None:
    module = (
        SCALAR + "    pass\n\n\nclass Called:\n    def __init__(self):\n        open('called', 'w').close()\n\n"
        "    def start(self, n, nominal, step): ...\n\n\nclass NotEnough(Called):\n    def drive(self, seen): ...\n\n\n"
        "class Odd(Called):\n    drive = 3\n\n\nclass Scalar(ScalarAds):\n    def drive(self, seen, memory): ...\n"
    )
    with pytest.raises(InputError) as caught:
        mine(module, f'[ads]\nmodel = "{model}"\nparameters = {{ command = "touch called" }}\n')
    assert expected in str(caught.value)
    assert len(str(caught.value).splitlines()) <= 2
    assert not Path("called").exists()


@pytest.mark.parametrize(
    ("module", "expected"),
    [
        ("import nothing_of_that_name\n", "ModuleNotFoundError: No module named 'nothing_of_that_name' ({}:1)"),
        ("\nraise SystemExit(3)\n", "SystemExit: 3 ({}:2)"),
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


@pytest.mark.slow
def test_a_numpy_py_in_the_working_directory_is_not_numpy(tmp_path: Path) -> None:
    for name in ("numpy", "random"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('not this one')\n")
    command = [
        sys.executable,
        "-m",
        "safevar_sumo",
        "study",
        "smoke",
        "--runs",
        "1",
        "--evaluations",
        "10",
        "--jobs",
        "1",
        "--quiet",
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_script_in_the_folder_of_the_study_stays_the_main_module(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(
        'extends = "native"\nname = "mine"\n[ads]\nkind = "traci"\nmodel = "mine:step"\n'
    )
    (tmp_path / "mine.py").write_text("def step(traci, vehicle_id):\n    traci.vehicle.setSpeed(vehicle_id, 5)\n")
    (tmp_path / "script.py").write_text(
        "import safevar_sumo as sv\nsv.simulate('mine.toml')\nprint(len(sv.evaluate('mine.toml', [{'mass': 1600}])))\n"
    )
    output = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert output.stdout.split() == ["1"], output.stderr
