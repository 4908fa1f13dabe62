"""User code: looked up by its name, checked before a call, and every fault of it is an error that
names it.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.plugins.contract import user_errors
from safevar_sumo.plugins.process import defer_interrupts, this_process
from safevar_sumo.sumo.matrix import drive_and_score
from tests.support.in_process import run, write
from tests.support.made_up import assert_same_results, original_of, system_of
from tests.support.user_code import ADS, SCALAR, Mine

CONSTANT = SCALAR + "    def drive(self, seen):\n        return {}, 0.0\n"


def throttle(study: Path) -> float:
    system = system_of(str(study))
    drive_and_score(system, original_of(system))
    return float(system.ads.start(1, system.nominal, 0.05)[0].drive(None)[0])


def test_beside_the_study_comes_before_the_working_directory(
    mine: Mine, folder: Path
) -> None:
    write("mine.py", CONSTANT.format(0.1))
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
        UserCodeError,
        match=rf"raised in {where}: ZeroDivisionError.*bought\.py:{line}\)",
    ):
        throttle(study)
    del sys.modules["bought"]


def test_two_studies_with_modules_of_one_name_get_their_own_whatever_the_order(
    tmp_path: Path,
) -> None:
    for place, value in (("a", 0.2), ("b", 0.4)):
        (tmp_path / place).mkdir()
        (tmp_path / place / "mine.toml").write_text(
            f'extends = "smoke"\nname = "mine"\n{ADS}'
        )
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
    (folder / "sibling.py").write_text(
        "VALUE = 0.6\n"
    )  # as long as before, within the same second
    assert throttle(folder / "mine.toml") == 0.6


def test_a_module_that_fails_can_be_corrected_and_does_not_see_a_file_named_like_an_installed_one(
    mine: Mine, folder: Path
) -> None:
    with pytest.raises(InputError):
        mine("1 / 0\n")
    (folder / "scipy.py").write_text("raise RuntimeError('not scipy')")
    mine("import scipy\n" + CONSTANT.format(0.3))


def test_a_lone_surrogate_in_an_error_of_the_user_can_be_printed(
    mine: Mine, folder: Path
) -> None:
    mine(
        SCALAR
        + "    def drive(self, seen):\n        raise ValueError('bad \\ud800 text')\n"
    )
    assert run(f"check {folder / 'mine.toml'}", expect=1).stdout.encode()


PRESSED = (
    "    def drive(self, seen):\n        import signal\n       "
    " signal.raise_signal(signal.{})\n        return 0, 0\n"
)


@contextmanager
def handled_by_default(name: str) -> Iterator[None]:
    """A signal interrupts, also if these tests run in a background in which it is ignored; its
    handler is the same afterwards.
    """
    number = signal.Signals[name]
    handler = signal.signal(number, signal.default_int_handler)
    try:
        yield
        assert signal.getsignal(number) is signal.default_int_handler
    finally:
        signal.signal(number, handler)


def test_what_user_code_does_on_ctrl_c_stays(mine: Mine) -> None:
    handler = signal.getsignal(signal.SIGINT)
    own = (
        "        import signal\n        signal.signal(signal.SIGINT, print)\n   "
        "     return 0, 0\n"
    )
    system = mine(f"{SCALAR}    def drive(self, seen):\n{own}")
    try:
        drive_and_score(system, original_of(system))
        assert signal.getsignal(signal.SIGINT) is print
    finally:
        signal.signal(signal.SIGINT, handler)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_command_is_interrupted_by_ctrl_c(
    name: str, mine: Mine, folder: Path
) -> None:
    mine(SCALAR + PRESSED.format(name))
    with handled_by_default(name):
        assert (
            "interrupted" in run(f"simulate {folder / 'mine.toml'}", expect=130).stderr
        )


def test_ctrl_c_waits_for_a_compiler() -> None:
    done = []

    @defer_interrupts()
    def compile_it() -> None:
        signal.raise_signal(signal.SIGINT)
        done.append("compiled")

    with handled_by_default("SIGINT"), pytest.raises(KeyboardInterrupt):
        compile_it()
    assert done == ["compiled"]


def test_a_handler_that_was_not_set_from_python_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(signal, "getsignal", lambda _: None)
    monkeypatch.setattr(signal, "signal", lambda *_: pytest.fail("set"))
    with defer_interrupts():
        pass


def take_streams() -> None:
    sys.stdout = sys.stderr = None  # type: ignore[assignment]


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (take_streams, r"sys\.stdout or sys\.stderr to None"),
        (
            lambda: os.close(this_process.descriptor),
            "closed descriptors of its process",
        ),
    ],
)
def test_a_process_without_streams_or_descriptors_is_an_error(
    damage: Callable[[], None], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(this_process, "descriptor", os.open(os.devnull, os.O_RDONLY))
    before = sys.stdout, sys.stderr
    with pytest.raises(UserCodeError, match=told), user_errors("mine.toml"):
        damage()
    assert (sys.stdout, sys.stderr) == before


def test_what_user_code_tells_numpy_ends_with_its_call(mine: Mine) -> None:
    """The package divides by closing speeds of 0."""
    strict = "import numpy as np\n\nnp.seterr(all='raise')\n" + CONSTANT.format(0.2)
    strict = strict.replace(
        "def drive(self, seen):\n",
        "def drive(self, seen):\n        np.seterr(all='raise')\n",
    )
    before = np.geterr()
    expected = drive_and_score(
        system := mine(CONSTANT.format(0.2)), original_of(system)
    )
    found = drive_and_score(mine(strict), original_of(system))
    assert_same_results(expected, found)
    assert np.geterr() == before
