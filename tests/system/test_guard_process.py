"""The guard as a process: what it loads, how it starts, and how it outlives its parent."""

import signal
import socket
import subprocess
import sys
from pathlib import Path

from faults.processes import Process
from faults.record import aftermath
from faults.stage import faulty_policy, staged
from mavbridge.core.link_settings import LinkSettings
from mavbridge.flight.guard_process import GuardProcess
from mavbridge.guard.values import GuardSettings
from sitl.clock import Clock

FLY = ("--dual-rate", "--mode", "ALT_HOLD", "--arm")
END_S = 15


def test_without_a_receiver_neutral_goes_on_until_the_vehicle_is_disarmed(tmp_path: Path) -> None:
    with staged(tmp_path, "--receiver", "none", renders=False) as flying:
        flying.start(*FLY, "--policy", faulty_policy("Leaning"))
        flying.wait_for_lean()
        at_ns = flying.kill(signal.SIGKILL)
        assert not flying.guard.has_ended(2.5)
        second = subprocess.run(
            [*flying.command(tmp_path / "second.json"), "--policy", faulty_policy("Leaning")],
            env=flying.environment(),
            capture_output=True,
            text=True,
            timeout=30,
            check=False,
        )
        assert "a guard still giving sticks back" in second.stderr
        assert second.returncode == 2
        flying.relay.disarm()
        assert flying.guard.has_ended(END_S)
    report = flying.vehicle_report()
    assert aftermath(report, at_ns, "none").mode in ("BRAKE", "LAND")
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
