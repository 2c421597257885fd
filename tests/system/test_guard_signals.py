"""Signals, terminals and ends in order: the guard outlives what ends or stops its parent."""

import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from faults.processes import Process
from faults.record import aftermath
from faults.relay import Override
from faults.stage import ORDERLY, faulty_policy, staged
from mavbridge.core.link_settings import LinkSettings
from mavbridge.flight.guard_process import GuardProcess
from mavbridge.guard.settings import GuardSettings
from sitl.clock import Clock

pytestmark = pytest.mark.system

FLY = ("--dual-rate", "--mode", "ALT_HOLD", "--arm", "--policy", faulty_policy("Leaning"))
RELEASE = Override(0, 0, 0, 0)
END_LIMIT_MS = 400
"""A main thread that shows the state five times a second hears of the signal at once."""
END_S = 15


def test_a_terminal_that_nobody_reads_does_not_hold_up_the_end(tmp_path: Path) -> None:
    with staged(tmp_path, "--receiver", "mid", renders=False) as flying:
        flying.start(*FLY, is_read=False)
        flying.wait_for_lean()
        flying.fill_output()
        flying.observe(0.5)  # until a thread waits for the reader
        at_ns = flying.kill(signal.SIGTERM)
        assert flying.guard.has_ended(END_S)
        status, _ = flying.end()
        ended_s = (time.monotonic_ns() - at_ns) / 1e9
    assert status in ORDERLY
    assert ended_s < 10
    measured = aftermath(flying.vehicle_report(), at_ns, "mid")
    assert measured.safe_ms <= END_LIMIT_MS
    assert flying.relay.overrides[-1] == RELEASE


def test_without_a_receiver_the_end_is_a_landing(tmp_path: Path) -> None:
    with staged(tmp_path, "--receiver", "none", renders=False) as flying:
        # A busy machine may end the flight by a fault before, and without a receiver the vehicle
        # would be held for ever then, as it should be.
        flying.start(*FLY, "--duration", "6", "--on-fault", "land")
        flying.wait_for_lean()
        status, output = flying.end()
    assert status in ORDERLY, output
    report = flying.vehicle_report()
    assert report["final"]["mode"] == "LAND"
    assert report["final"]["landed"]
    assert not report["final"]["armed"]
    assert not report["crashed"]
    assert not any(entry["failsafe"] for entry in report["sticks"] if entry["armed"])


HEAVY = ("numpy", "torch", "cv2", "openvino", "rerun", "rich", "cyclopts")
START_LIMIT_S = 2.0
"""The aim on a machine of its own is 0.5 s."""


def test_the_guard_loads_nothing_heavy() -> None:
    script = "import sys, mavbridge.guard.__main__; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=30, check=True
    ).stdout.split()
    assert [name for name in HEAVY if name in loaded] == []


def test_the_guard_starts_at_once_and_stays_small() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.bind(("127.0.0.1", 0))
        vehicle.settimeout(START_LIMIT_S)
        address = f"udpout:127.0.0.1:{vehicle.getsockname()[1]}"
        guard = GuardProcess(GuardSettings(link=LinkSettings(connect=address)), Clock())
        try:
            vehicle.recv(1024)  # its heartbeat
            peak_mb = Process(guard.pid, Clock()).peak_memory_mb()
        finally:
            guard.close()
            assert guard.wait(5)
    assert peak_mb < 60
