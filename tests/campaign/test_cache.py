"""The cache of simulations: what was simulated is not simulated again, whatever happens to the
folder; and evidence never reads it.
"""

from __future__ import annotations

import os
import pickle
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import diskcache
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from safevar_sumo.api.simulation import load_study
from safevar_sumo.campaign import batches, cache
from safevar_sumo.campaign.batches import ask_why_no_verdict, evaluate_all
from safevar_sumo.campaign.cache import (
    CommandCache,
    keep_simulations,
    simulate_anew,
)
from safevar_sumo.campaign.evaluation import Selection, Task, evaluate_settings
from safevar_sumo.errors import InputError
from safevar_sumo.questions.catalogue import list_models
from safevar_sumo.questions.sampling import sobol_settings
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet
from tests.support.in_process import SLOW, InlinePool, own_network, run_python, write

OWN_ADS = """
from threshold import TTC
from safevar_sumo.ads import ScalarAds

class Own(ScalarAds):
    def drive(self, seen):
        brakes = seen.closing_speed > 0 and seen.gap / seen.closing_speed < TTC
        return (0.0, 1.0) if brakes else (0.3, 0.0)
"""
"""A driving system whose threshold [s] is in another module of the user's."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of an empty cache."""
    monkeypatch.setenv("SAFEVAR_CACHE", str(tmp_path / "kept"))
    return tmp_path / "kept"


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Numbers of settings that were simulated, of each batch."""
    numbers = list[int]()

    def count(task: Task, rows: FloatArray) -> Evaluations:
        numbers.append(len(rows))
        return evaluate_settings(task, rows)

    monkeypatch.setattr(batches, "evaluate_settings", count)
    return numbers


def evaluated(
    study: Study, settings: FloatArray, *, fresh: bool = False
) -> Evaluations:
    """Settings as a question evaluates them, in a process of its own."""
    with keep_simulations(fresh=fresh):
        return evaluate_all(study, settings, InlinePool(), verified=0)


def some_settings(study: Study, number: int) -> FloatArray:
    return sobol_settings(CharacteristicSet.of(study), number)


@pytest.fixture
def eight(folder: Path, simulated: list[int]) -> tuple[Study, FloatArray]:
    """A study, and eight settings of it that were simulated."""
    study = load_study("smoke")
    settings = some_settings(study, 8)
    evaluated(study, settings)
    return study, settings


def assert_equal(one: Evaluations, other: Evaluations) -> None:
    """To the bit, in every array."""
    assert_array_equal(one.settings, other.settings)
    assert [*one.results] == [*other.results]
    for name, values in one.results.items():
        assert_array_equal(values, other.results[name])
        assert values.dtype == other.results[name].dtype
    assert_array_equal(one.points, other.points)


@pytest.mark.parametrize("name", ["smoke", "r152", "sun"])
def test_what_was_simulated_is_read_and_is_the_same_to_the_bit(
    name: str, folder: Path, simulated: list[int]
) -> None:
    """Also the points of a matrix at which vehicles are worst, and metrics that are undefined."""
    study = load_study(name)
    settings = some_settings(study, 64)
    first = evaluated(study, settings)
    assert sum(simulated) == 64
    assert_equal(evaluated(study, settings), first)
    assert sum(simulated) == 64
    assert_equal(evaluated(study, settings, fresh=True), first)
    assert sum(simulated) == 128


@SLOW
def test_what_differs_is_simulated(folder: Path, simulated: list[int]) -> None:
    """Other settings, other points, another study, and what the title does not change."""
    study = load_study("alks")
    settings = some_settings(study, 8)
    evaluated(study, settings)
    evaluated(load_study(study, title="Another title"), settings)
    assert sum(simulated) == 8
    evaluated(study, some_settings(study, 9))
    assert sum(simulated) == 17
    evaluated(load_study(study, step_length=0.05), settings)
    assert sum(simulated) == 25
    with keep_simulations():
        evaluate_all(study, settings, InlinePool(), selection=Selection(points=(1,)))
    assert sum(simulated) == 33


def test_an_interrupted_question_goes_on_where_it_was(
    folder: Path, simulated: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Portions that had ended when it was interrupted are not simulated again."""
    monkeypatch.setattr(batches, "PORTION", 16)
    study = load_study("smoke")
    settings = some_settings(study, 64)
    kept = list[int]()

    def interrupt(number: int) -> None:
        kept.append(number)
        if sum(kept) > 40:
            raise KeyboardInterrupt

    with keep_simulations(), pytest.raises(KeyboardInterrupt):
        evaluate_all(study, settings, InlinePool(), interrupt, verified=0)
    simulated.clear()
    again = evaluated(study, settings)
    assert sum(simulated) == 32
    assert_equal(again, evaluated(study, settings, fresh=True))


def test_a_distribution_may_lack_a_version(
    folder: Path, in_tmp: Path, simulated: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also beside another one of its name."""
    for name, version in (("with", "Version: 1\n"), ("without", "")):
        metadata = in_tmp / name / "twice-1.dist-info" / "METADATA"
        metadata.parent.mkdir(parents=True)
        metadata.write_text(f"Metadata-Version: 2.1\nName: twice\n{version}")
        monkeypatch.syspath_prepend(str(metadata.parents[1]))
    cache._environment.cache_clear()
    study = load_study("smoke")
    for _ in "ab":
        evaluated(study, some_settings(study, 4))
    cache._environment.cache_clear()
    assert sum(simulated) == 4


@SLOW
def test_what_was_simulated_while_an_input_changed_is_refused_and_not_kept(
    folder: Path, simulated: list[int], in_tmp: Path
) -> None:
    own = own_network(in_tmp / "own")
    study = load_study("smoke", scenario={"parameters": {"network": str(own)}})
    settings = some_settings(study, 8)
    traffic = own / "traffic.rou.xml"

    def edit(size: int) -> None:
        traffic.write_text(traffic.read_text() + "<!-- edited -->\n")

    with (
        keep_simulations(),
        pytest.raises(InputError, match=r"rou\.xml has changed since: it was ch"),
    ):
        evaluate_all(study, settings, InlinePool(), edit, verified=0)
    edited = evaluated(study, settings)
    assert sum(simulated) == 16, "nothing was kept"
    assert_equal(evaluated(study, settings, fresh=True), edited)


@SLOW
def test_simulations_of_user_code_are_kept_for_the_running_command_and_its_continuation(
    folder: Path, simulated: list[int], in_tmp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What user code reads cannot be known: here a file whose name no study has."""
    monkeypatch.setattr(batches, "PORTION", 16)
    monkeypatch.setattr(batches, "SMALL_PORTION", 16)
    write(
        "threshold.py", "from pathlib import Path\nTTC = float(Path('t').read_text())"
    )
    write("own.py", OWN_ADS)
    write("t", "3.0")
    study = load_study("smoke", ads={"model": "own:Own"})
    settings = some_settings(study, 64)

    def ask(command: str, after: float = np.inf) -> Evaluations:
        """As a command does, which is interrupted after so many settings."""
        simulated.clear()
        seen = list[int]()

        def interrupt(number: int) -> None:
            seen.append(number)
            if sum(seen) > after:
                raise KeyboardInterrupt

        with keep_simulations(command):
            evaluate_all(study, settings, InlinePool(), interrupt, verified=0)
            return evaluate_all(study, settings, InlinePool(), verified=0)

    # A command finds what it has simulated itself; another one does not.
    first = ask("risk own")
    assert sum(simulated) == 64
    ask("risk own")
    assert sum(simulated) == 64
    assert not [*(folder / "commands").glob("*[!k]")], "only locks are left"

    # An interrupted command is continued once, and by itself alone.
    for command, continued in (("risk own", 32), ("risk own", 0), ("rules own", 0)):
        if continued:
            with pytest.raises(KeyboardInterrupt):
                ask("risk own", after=40)
            with pytest.warns(
                UserWarning, match=r"continues: 32 simulated at \d\d:\d\d"
            ):
                assert_equal(ask(command), first)
        else:
            assert_equal(ask(command), first)
        assert sum(simulated) == 64 - continued

    # Nobody continues what is older than a day, or simulated with other modules.
    with pytest.raises(KeyboardInterrupt):
        ask("risk own", after=40)
    write("own.py", OWN_ADS + "# changed\n")
    ask("risk own")
    assert sum(simulated) == 64
    write("own.py", OWN_ADS)
    monkeypatch.setattr(cache, "DAY", -1.0)
    ask("risk own")
    assert sum(simulated) == 64


def test_the_cache_of_a_running_command_is_not_removed_however_old_it_is(
    folder: Path, in_tmp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another command removes what is older than a day, but nothing that is in use."""
    write("own.py", OWN_ADS)
    write("threshold.py", "TTC = 1.5\n")
    study = load_study("smoke", ads={"model": "own:Own"})
    monkeypatch.setattr(cache, "DAY", -1.0)
    commands = [CommandCache(folder, name, is_fresh=False) for name in "ab"]
    first, second = [command.of(study, ()) for command in commands]
    assert first is not None
    assert second is not None
    first.put(b"key", b"content")
    assert CommandCache(folder, "a", is_fresh=False).of(study, ()) is None
    assert first.get(b"key") == b"content"

    # What an interrupted command has left is removed.
    for command in commands:
        command.end(is_interrupted=True)
    other = CommandCache(folder, "c", is_fresh=False)
    assert other.of(study, ()) is not None
    assert len([path for path in (folder / "commands").iterdir() if path.is_dir()]) == 1
    other.end(is_interrupted=False)


def test_an_altered_entry_is_simulated_again(
    eight: tuple[Study, FloatArray], folder: Path, simulated: list[int]
) -> None:
    """One byte of each entry is changed, and one entry takes another one's place."""
    with diskcache.Cache(str(folder)) as entries:
        for key in [*entries]:
            content = bytearray(entries[key])
            content[-20] ^= 1
            entries[key] = bytes(content)
    evaluated(*eight)
    assert sum(simulated) == 16


def test_nothing_is_unpickled(
    eight: tuple[Study, FloatArray], folder: Path, simulated: list[int], tmp_path: Path
) -> None:
    """An entry that somebody has planted would make a file."""

    class Planted:
        def __reduce__(self) -> tuple[object, ...]:
            return os.mkdir, (str(tmp_path / "planted"),)

    with sqlite3.connect(folder / "cache.db") as database:
        database.execute(
            "UPDATE Cache SET mode = 4, filename = NULL, value = ?",
            [pickle.dumps(Planted())],
        )
    evaluated(*eight)
    assert sum(simulated) == 16
    assert not (tmp_path / "planted").exists()


@pytest.mark.parametrize("fault", ["no folder", "no database", "full"])
def test_without_a_usable_folder_all_is_simulated_and_one_line_says_so(
    fault: str, folder: Path, simulated: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    if fault == "no folder":
        folder.write_text("a file")
    elif fault == "no database":
        folder.mkdir()
        (folder / "cache.db").write_bytes(b"no database at all" * 1000)
    else:

        def fail(*_: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(diskcache.Cache, "set", fail)
    study = load_study("smoke")
    settings = [some_settings(study, number) for number in (4, 5)]
    with (
        pytest.warns(UserWarning, match="simulations are not kept: .*kept") as warnings,
        keep_simulations(),
    ):
        _ = [evaluate_all(study, some, InlinePool(), verified=0) for some in settings]
    assert len(warnings) == 1
    assert sum(simulated) == 9


def test_the_oldest_simulations_make_room(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "SIZE_LIMIT", 300_000)
    with keep_simulations():
        kept = cache.cache_of(load_study("smoke"), [])
        for number in range(100):
            kept.put(str(number).encode(), os.urandom(20_000))
        assert kept.get(b"99") is not None
        assert kept.get(b"0") is None
        assert kept.extent()[1] < 450_000


@SLOW
def test_two_processes_share_a_cache(folder: Path) -> None:
    """Both ask the same question at once, then one of them asks again: the same bytes."""
    question = ["-m", "safevar_sumo", "risk", "smoke", "--samples", "500", "--json"]
    both = [
        subprocess.Popen([sys.executable, *question], stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    answers = {process.communicate()[0] for process in both}
    answers.add(run_python(*question).stdout)
    assert len(answers) == 1
    assert "probability" in answers.pop()


def test_evidence_does_not_check_itself(
    eight: tuple[Study, FloatArray], simulated: list[int]
) -> None:
    with simulate_anew():
        evaluated(*eight)
    assert sum(simulated) == 16


def test_the_list_says_where_simulations_are_and_how_large(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert list_models("cache").table()["entries"].tolist() == [0]
    study = load_study("smoke")
    with keep_simulations():
        evaluate_all(study, some_settings(study, 8), InlinePool(), verified=0)
        ask_why_no_verdict(study, InlinePool())
    row = list_models("cache").table().iloc[0]
    assert row["folder"] == str(folder)
    assert row["entries"] == 2
    assert 0 < row["size"] < 1
    monkeypatch.setenv("SAFEVAR_CACHE", "off")
    assert "not kept" in list_models("cache").verdict
