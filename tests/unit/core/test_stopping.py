"""The request to stop must survive signals that arrive inside its own handling."""

import os
import signal
import subprocess
import sys

import pytest

from mavbridge.core.stopping import StopRequest, stop_on_signals

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


def test_a_signal_wakes_who_waits() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with stop_on_signals() as stop:
        assert not stop.wait(0.0)
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.wait(30.0)
        assert stop.wait(0.0)
    assert signal.getsignal(signal.SIGTERM) is before


def test_asked_twice_is_asked_once() -> None:
    stop = StopRequest()
    stop.set()
    stop.set()
    assert stop.is_set()
    assert stop.wait(0.0)
