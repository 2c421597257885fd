"""The request to stop must survive signals that arrive inside its own handling."""

import os
import signal
import subprocess
import sys

import pytest

from helpers.fakes import FakeClock
from helpers.programs import ended
from mavbridge.core.stopping import (
    INTERRUPTED,
    ONE_REQUEST_NS,
    StopRequest,
    interrupt_once,
    stop_on_signals,
)

WAITING = """
import sys
from {module} import {context}

with {context}() as stop:
    print("ready", flush=True)
    while not {asked}:
        pass
    sys.stdin.read()
print("ended")
"""


@pytest.mark.parametrize(
    ("module", "context", "asked"),
    [
        ("mavbridge.core.stopping", "stop_on_signals", "stop.wait(0.001)"),
        ("sitl.clock", "stop_on_signal", "stop.is_set()"),
    ],
)
def test_any_number_of_signals_at_once_is_one_stop(module: str, context: str, asked: str) -> None:
    """A ``threading.Event`` fails here: handlers inside handlers wait for each other's lock."""
    program = WAITING.format(module=module, context=context, asked=asked)
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as waiting:
        assert waiting.stdout.readline() == "ready\n"
        for _ in range(5_000):
            waiting.send_signal(signal.SIGINT)
            waiting.send_signal(signal.SIGTERM)
        try:
            output, _ = waiting.communicate(timeout=60)
        finally:
            waiting.kill()
    assert output == "ended\n"


INTERRUPTED_START = """
import sys, threading, types
def meta(arguments):
    try:
        print("started", flush=True)
        threading.Event().wait(60)
    finally:
        print("cleaning up", flush=True)
        sys.stdin.readline()
        print("clean", flush=True)
sys.modules["mavbridge.cli"] = types.SimpleNamespace(cli=types.SimpleNamespace(meta=meta))
sys.argv = ["mavbridge"]
from mavbridge.__main__ import main
main()
"""


def test_a_second_ctrl_c_while_a_start_cleans_up_is_no_traceback() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED_START],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as starting:
        assert starting.stdout.readline() == "started\n"
        starting.send_signal(signal.SIGINT)
        assert starting.stdout.readline() == "cleaning up\n"
        starting.send_signal(signal.SIGINT)
        try:
            _, complaint = starting.communicate("\n", timeout=20)
        finally:
            starting.kill()
    assert "Traceback" not in complaint
    assert starting.returncode == INTERRUPTED


def test_ctrl_c_is_one_request_for_a_moment_and_then_an_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock, statuses = FakeClock(), list[int]()
    monkeypatch.setattr("mavbridge.core.stopping.os._exit", statuses.append)
    before = signal.getsignal(signal.SIGINT)
    try:
        interrupt_once(clock)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        clock.advance_ns(ONE_REQUEST_NS - 1)
        signal.raise_signal(signal.SIGINT)
        assert statuses == []
        clock.advance_ns(ONE_REQUEST_NS)
        signal.raise_signal(signal.SIGINT)
        assert statuses == [INTERRUPTED]
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_signal_wakes_who_waits() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with stop_on_signals() as stop:
        assert not stop.wait(0.0)
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.wait(30.0)
        assert stop.wait(0.0)
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_that_the_parent_has_ignored_stays_ignored(number: signal.Signals) -> None:
    """As of ``nohup``, and of a shell for a program in the background."""
    before = signal.signal(number, signal.SIG_IGN)
    try:
        with stop_on_signals() as stop:
            signal.raise_signal(number)
            assert not stop.is_set()
    finally:
        signal.signal(number, before)


def test_a_second_request_is_counted_and_a_burst_is_one() -> None:
    clock = FakeClock()
    stop = StopRequest(clock)
    for _ in range(3):
        stop.set()
        clock.advance_ns(ONE_REQUEST_NS - 1)
    assert stop.requests == 1
    assert stop.wait(0.0)
    clock.advance_ns(1)
    stop.set()
    assert stop.requests == 2


END = """
import sys
from mavbridge.core.stopping import end_process
end_process(5, lambda: print("last words", file=sys.stderr))
"""


def test_the_process_ends_with_its_last_words() -> None:
    """Also if nobody reads: terminal-stalled in tests/faults/catalogue/host.toml."""
    process = ended(sys.executable, "-c", END)
    assert (process.returncode, process.stderr) == (5, "last words\n")
