"""A run's journal: its contents after truncation, damage, a full disk and a killed process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.records import Evaluations, differences
from safevar_sumo.results import Journal, JournalReader, journal_head
from safevar_sumo.results.journal import (
    SECONDS_BETWEEN_ATTEMPTS,
    JournalContent,
    open_and_lock,
    read_journal,
)
from tests.support.in_process import SLOW

BATCHES = 4
ROWS = 3
RESULT = [1, 5]
BUDGET = 99
HEAD = journal_head("study", "nsga2-00", ("a", "b"))
in_one_folder = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=100
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where a journal may be."""
    return tmp_path / "a.jsonl"


def batch(number: int) -> Evaluations:
    """Rows that their values identify; one is a collision, one failed."""
    values = np.arange(ROWS) + 10.0 * number
    outcome = np.array(["stopped", "collision", "simulator-error"])
    metrics = {
        name: np.where(outcome == "simulator-error", np.nan, values + i / 7)
        for i, name in enumerate(("safety_degree", "tet"))
    }
    return Evaluations(
        settings=np.stack([values, values + 0.1], axis=1),
        outcome=outcome,
        metrics=metrics,
        f_diff=values / 3,
        collision_speed=np.where(outcome == "collision", values, np.nan),
        f_num_diff=np.ones(ROWS),
    )


def append(journal: Journal, first: int = 0) -> None:
    """Append the batches from `first` on."""
    for number in range(first, BATCHES):
        positions = [ROWS * number + row for row in range(ROWS)]
        journal.append(positions, batch(number))


def write(path: Path, finished: bool = True) -> list[int]:
    """Write a new journal; returns the offsets at which its lines end."""
    path.unlink(missing_ok=True)
    journal = Journal(path, HEAD)
    append(journal)
    if finished:
        journal.finish(RESULT, BUDGET)
    journal.close()
    lines = path.read_bytes().splitlines(keepends=True)
    return np.cumsum([*map(len, lines)]).tolist()


def same(one: Evaluations, other: Evaluations) -> bool:
    rest = (
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("settings", "f_diff", "f_num_diff")
    )
    return all(rest) and not any(differences(one.results, other.results))


def holds_the_first(batches: int, content: JournalContent) -> bool:
    """Whether the journal holds exactly the first batches."""
    positions, evaluations, *_ = content
    if not batches:
        return not (positions or len(evaluations))
    expected = Evaluations.concatenate(list(map(batch, range(batches))))
    return positions == list(range(ROWS * batches)) and same(evaluations, expected)


def complete(journal: Journal, first: int) -> None:
    append(journal, first)
    journal.close()
    assert holds_the_first(BATCHES, read_journal(journal.path, HEAD))


def test_a_journal_returns_its_evaluations(tmp_path: Path) -> None:
    path = tmp_path / "runs" / "a.jsonl"
    write(path)
    journal = Journal(path, HEAD)
    journal.close()
    for content in (journal.content, read_journal(path, HEAD)):
        assert holds_the_first(BATCHES, content)
        assert content.solutions == {BUDGET: RESULT}
    _, first = content.requested_within(ROWS)
    assert same(first, batch(0)), "positions count from 0: the first three"


def test_a_journal_is_a_table_that_pandas_reads(path: Path) -> None:
    write(path)
    head, *lines, _ = map(json.loads, path.read_text().splitlines())
    assert head["characteristics"] == ["a", "b"]
    frame = pd.concat(map(pd.DataFrame, lines))
    expected = Evaluations.concatenate(list(map(batch, range(BATCHES))))
    assert frame["evaluation"].tolist() == list(range(ROWS * BATCHES))
    for name, column in (
        ("b", expected.settings[:, 1]),
        ("collision_speed", expected.collision_speed),
    ):
        assert np.array_equal(frame[name].to_numpy(dtype=float), column, equal_nan=True)
    assert lines[0]["tet"][2] is None, "undefined"


@SLOW
@in_one_folder
@given(st.data())
def test_a_truncated_journal_loads_its_whole_lines_and_continues(
    path: Path, data: st.DataObject
) -> None:
    ends = write(path)
    left = data.draw(st.integers(0, ends[-1] - 1))
    os.truncate(path, left)
    whole = sum(end <= left for end in ends)
    journal = Journal(path, HEAD)
    assert holds_the_first(max(0, whole - 1), journal.content)
    assert not journal.content.solutions
    complete(journal, max(0, whole - 1))


def edited(line: bytes, **columns: object) -> bytes:
    """The line with other columns and its checksum as it was; None leaves a column out."""
    table = {**json.loads(line), **columns}
    return (
        json.dumps(
            {name: column for name, column in table.items() if column is not None}
        ).encode()
        + b"\n"
    )


ALTERATIONS: dict[str, Callable[[bytes], bytes]] = {
    "an outcome that does not exist": lambda line: line.replace(
        b"stopped", b"exploded"
    ),
    "another outcome": lambda line: line.replace(b'"collision"', b'"stopped"'),
    "a digit": lambda line: line.replace(b"11.1", b"11.2"),
    "a digit at the end of a number": lambda line: line.replace(
        b"3.6666666666666665", b"3.6666666666666664"
    ),
    "an undefined value": lambda line: line.replace(b'"tet":[10.', b'"tet":[null,10.'),
    "a value out of its domain": lambda line: line.replace(b'"a":[10.0', b'"a":[1e99'),
    "a missing column": lambda line: edited(line, tet=None),
    "a new column": lambda line: edited(line, tat=[1.0] * ROWS),
    "positions": lambda line: edited(line, evaluation=[90, 91, 92]),
    "a reason": lambda line: edited(line, reason=["why", None, None]),
    "spaces": edited,
    "no checksum": lambda line: edited(line, crc32=None),
    "another checksum": lambda line: edited(line, crc32=1),
    "its checksum as text": lambda line: edited(
        line, crc32=str(json.loads(line)["crc32"])
    ),
    "nothing": lambda line: b"",
    "zeros": lambda line: line.replace(b":", b"\0", 2),
    "twice": lambda line: 2 * line,
}


@pytest.mark.parametrize("alteration", ALTERATIONS)
def test_an_altered_line_and_all_after_it_are_not_believed(
    alteration: str, path: Path
) -> None:
    """A reader leaves the file as it is; what is lost is simulated again."""
    ends = write(path)
    whole = path.read_bytes().splitlines(keepends=True)
    altered = {
        line: ALTERATIONS[alteration](whole[line]) for line in range(1, BATCHES + 1)
    }
    numbers = [line for line in altered if altered[line] != whole[line]]
    assert numbers
    for line in numbers:
        path.write_bytes(
            damaged := b"".join([*whole[:line], altered[line], *whole[line + 1 :]])
        )
        intact = line - (alteration != "twice")
        content = read_journal(path, HEAD)
        assert holds_the_first(intact, content)
        assert not content.solutions
        assert path.read_bytes() == damaged
        journal = Journal(path, HEAD)
        assert path.stat().st_size == ends[intact]
        complete(journal, intact)


def test_other_solutions_and_lines_in_another_order_are_not_believed(
    path: Path,
) -> None:
    write(path)
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b'"solutions":[1,5]', b'"solutions":[1,4]'))
    assert not read_journal(path, HEAD).solutions
    head, first, second, *rest = whole.splitlines(keepends=True)
    path.write_bytes(b"".join([head, second, first, *rest]))
    assert holds_the_first(0, read_journal(path, HEAD))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("solutions", value) for value in ([9999], [-1], "x", None, [[1]], ["1"], 5)),
        *(("evaluation", value) for value in (None, "abc", [0, 1], ["0", "1", "2"])),
        *(("a", value) for value in (None, ["x", 1, 2], [1], "abc")),
        *(("outcome", None), ("f_diff", [1, 2]), ("budget", [1])),
    ],
)
def test_a_line_with_wrong_values_and_a_right_checksum_is_simulated_again(
    name: str, value: object, path: Path
) -> None:
    write(path)
    head, *lines = map(json.loads, path.read_text().splitlines())
    place = -1 if name in ("solutions", "budget") else 1
    lines[place][name] = value
    texts = [json.dumps(head)]
    checksum = zlib.crc32(texts[0].encode())
    for line in lines:
        del line["crc32"]
        text = json.dumps(line)
        checksum = zlib.crc32(text.encode(), checksum)
        texts.append(f'{text[:-1]},"crc32":{checksum}}}')
    path.write_text("\n".join(texts) + "\n")
    journal = Journal(path, HEAD)
    assert holds_the_first(BATCHES if place == -1 else 1, journal.content)
    assert not journal.content.solutions
    journal.close()


def test_the_zeros_that_a_crash_of_the_machine_leaves_are_cut_off(
    path: Path,
) -> None:
    path.write_bytes(b"\0" * 99)
    Journal(path, HEAD).close()
    assert holds_the_first(0, read_journal(path, HEAD))
    write(path, finished=False)
    path.write_bytes(path.read_bytes() + b"\0" * 99)
    assert holds_the_first(BATCHES, Journal(path, HEAD).content)


def test_a_reader_follows_a_journal_that_grows_line_by_line(path: Path) -> None:
    ends = write(path)
    whole = path.read_bytes()
    path.unlink()
    reader = JournalReader(path, BUDGET)
    assert reader.asked() == 0
    for size in range(0, len(whole), 7):
        path.write_bytes(whole[:size])
        assert reader.asked() == ROWS * max(sum(end <= size for end in ends) - 1, 0)
        assert not reader.is_finished
        assert reader.asked() + reader.left == BUDGET
    asked = reader.asked()
    path.write_bytes(whole)
    assert (reader.asked(), reader.left, reader.is_finished) == (asked, 0, True)


@pytest.mark.parametrize(
    ("study", "run"), [("other", "nsga2-00"), ("study", "nsga2-01")]
)
@pytest.mark.parametrize("opened", [Journal, read_journal])
def test_a_journal_of_another_study_or_run_is_refused(
    path: Path, opened: Callable[..., object], study: str, run: str
) -> None:
    write(path)
    with pytest.raises(
        InputError, match="belongs to another study, version or run, or is no journal"
    ):
        opened(path, journal_head(study, run, ("a", "b")))


@SLOW
def test_a_run_has_one_owner_and_the_lock_ends_with_the_process(path: Path) -> None:
    code = "from safevar_sumo.results import Journal\nfrom pathlib import Path\n"
    code += f"J = Journal(Path({str(path)!r}), {HEAD})\n"
    code += "print('locked', flush=True)\nimport time\ntime.sleep(60)\n"
    other = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
    )
    assert other.stdout.readline() == "locked\n"
    with pytest.raises(
        SafevarError, match=r"a\.jsonl: another process works on this run"
    ):
        Journal(path, HEAD)
    other.kill()
    Journal(path, HEAD).close()  # waits until the other has ended
    other.communicate()


def test_a_journal_that_is_removed_while_another_process_waits_for_it_is_made_anew(
    path: Path,
) -> None:
    first = open_and_lock(path)
    with ThreadPoolExecutor() as threads:
        waiting = threads.submit(open_and_lock, path)
        time.sleep(2 * SECONDS_BETWEEN_ATTEMPTS)
        path.unlink()
        first.close()
        with waiting.result() as second:
            assert os.path.samestat(os.fstat(second.fileno()), path.stat())


def test_a_retry_drops_the_first_batch_that_failed_and_all_after_it(
    path: Path,
) -> None:
    whole = Evaluations.concatenate([batch(0), batch(1)])
    journal = Journal(path, HEAD)
    for rows in ([0, 1], [2, 3], [4]):  # the third row has failed
        journal.append(rows, whole.take(rows))
    journal.finish([0], BUDGET)
    journal.close()
    Journal(path, HEAD, retry_failed=True).close()
    content = read_journal(path, HEAD)
    assert content.positions == [0, 1]
    assert same(content.evaluations, whole.take([0, 1]))
    assert not content.solutions
