"""Ctrl-C while a pool works."""

from __future__ import annotations

import os
import signal
import threading
import time
from concurrent.futures import Future

import pytest

from safevar_sumo.workers.local import first_of, interrupts_noted, result_of


def press() -> None:
    signal.raise_signal(signal.SIGINT)


def test_ctrl_c_is_raised_where_a_result_is_waited_for_and_nowhere_else() -> None:
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), interrupts_noted():  # noqa: PT012
        press()
        press()
        with pytest.raises(KeyboardInterrupt):
            result_of(Future())
        press()  # while the pool is closed, say
    assert signal.getsignal(signal.SIGINT) is before
    with interrupts_noted():
        assert first_of([]) == set(), "what was pressed before is forgotten"


def test_ctrl_c_during_a_wait_is_noticed_soon() -> None:
    threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt), interrupts_noted():
        first_of([Future()])
    assert time.monotonic() - start < 5


def test_what_nobody_has_waited_for_is_raised_at_the_end() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), interrupts_noted():  # noqa: PT012
        press()
        done.append(True)
    assert done


def test_in_another_thread_handlers_are_left_alone() -> None:
    before = signal.getsignal(signal.SIGINT)
    seen = []

    def work() -> None:
        with interrupts_noted():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]
