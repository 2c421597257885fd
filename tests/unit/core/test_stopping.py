"""The request to stop must survive signals that arrive inside its own handling."""

import os
import signal
import subprocess
import sys
import time

import pytest

from helpers.fakes import FakeClock
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.stopping import ONE_REQUEST_NS, StopRequest, stop_on_signals

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
        assert waiting.stdout is not None
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
import sys, time, types
from mavbridge.core.errors import UserError
def meta(arguments):
    try:
        print("started", flush=True)
        time.sleep(60)
    finally:
        print("cleaning up", flush=True)
        {clean_up}
sys.modules["mavbridge.cli"] = types.SimpleNamespace(cli=types.SimpleNamespace(meta=meta))
sys.argv = ["mavbridge"]
from mavbridge.__main__ import main
main()
"""


@pytest.mark.parametrize(
    ("clean_up", "pauses_s", "is_cleaned"),
    [
        ("time.sleep(60)", (0.4,), False),
        ("time.sleep(0.1); raise UserError('at the end')\n        time.sleep(60)", (), None),
        ("time.sleep(1); print('clean', flush=True)", (0.01, 0.02), True),
        ("sys.exit(130)\n        ", (0.4,), None),
    ],
)
def test_a_second_ctrl_c_while_a_start_ends_is_no_traceback(
    clean_up: str, pauses_s: tuple[float, ...], is_cleaned: bool | None
) -> None:
    """Soon after the first it is the same request; later it ends the process at once."""
    program = INTERRUPTED_START.format(clean_up=clean_up)
    with subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as starting:
        assert starting.stdout is not None
        assert starting.stdout.readline() == "started\n"
        starting.send_signal(signal.SIGINT)
        assert starting.stdout.readline() == "cleaning up\n"
        for pause_s in pauses_s:
            time.sleep(pause_s)
            starting.send_signal(signal.SIGINT)
        try:
            output, complaint = starting.communicate(timeout=20)
        finally:
            starting.kill()
    assert "Traceback" not in complaint
    if is_cleaned is not None:
        assert starting.returncode == 130
        assert ("clean\n" in output) is is_cleaned


def test_a_signal_wakes_who_waits() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with stop_on_signals() as stop:
        assert not stop.wait(0.0)
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.wait(30.0)
        assert stop.wait(0.0)
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_second_request_is_counted_and_a_burst_is_one() -> None:
    clock = FakeClock()
    stop = StopRequest(clock)
    assert not stop.wait(0.0)
    for _ in range(3):
        stop.set()
        clock.advance_ns(ONE_REQUEST_NS - 1)
    assert stop.requests == 1
    assert stop.wait(0.0)
    assert not any(stop.wait(0.0, requests=2) for _ in range(4))
    clock.advance_ns(1)
    stop.set()
    assert stop.requests == 2
    assert stop.wait(0.0, requests=2)


END = """
import sys, threading
from mavbridge.core.stopping import end_process
{before}
end_process(5, lambda: print("last words", file=sys.stderr))
"""
WRITER_ASLEEP = """
threading.Thread(target=lambda: sys.stderr.write("x" * 1_000_000), daemon=True).start()
"""


@pytest.mark.parametrize(("before", "expected"), [("", b"last words\n"), (WRITER_ASLEEP, None)])
def test_the_process_ends_whether_or_not_anybody_reads(before: str, expected: bytes | None) -> None:
    """``sys.exit`` fails here: it waits for the lock of the stream that the writer holds."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
    command = [sys.executable, "-c", END.format(before=before)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, env=environment) as ending:
        assert ending.stderr is not None
        try:
            assert ending.wait(30.0) == 5
        finally:
            ending.kill()
        if expected is not None:
            assert ending.stderr.read() == expected
