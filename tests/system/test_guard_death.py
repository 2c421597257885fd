"""What the death of the flight process leaves, beyond the safe vehicle of the catalogue of faults.

Limits are those that the guard is built for, times two or so: other tests run on the same cores.
"""

import signal
import subprocess
from pathlib import Path

import pytest

from faults.record import Aftermath, Receiver, VehicleReport, aftermath
from faults.relay import Override
from faults.stage import faulty_policy, staged
from helpers.flight_logs import logged_overrides

pytestmark = pytest.mark.system

FLY = ("--dual-rate", "--mode", "ALT_HOLD", "--arm")
RELEASE = Override(0, 0, 0, 0)
DEATH_LIMIT_MS = 150
"""The aim on a machine of its own is 60 ms."""
END_S = 15


def assert_safe(report: VehicleReport, receiver: Receiver, at_ns: int) -> Aftermath:
    measured = aftermath(report, at_ns, receiver)
    assert measured.safe_ms <= DEATH_LIMIT_MS
    assert not measured.flew_again
    assert report["refused_messages"] == 0
    return measured


def test_a_killed_flight_process_leaves_a_safe_vehicle_and_a_whole_log(tmp_path: Path) -> None:
    recording = tmp_path / "recording"
    with staged(tmp_path, "--receiver", "mid", renders=False) as flying:
        flying.start(*FLY, "--policy", faulty_policy("Deliberate"), "--record", str(recording))
        flying.wait_for_lean()
        assert flying.guard.peak_memory_mb() < 60
        at_ns = flying.kill(signal.SIGKILL)
        assert flying.guard.has_ended(END_S)
        heartbeats = len(flying.relay.sent_since(0, "HEARTBEAT"))
        flying.observe(1.2)
        assert len(flying.relay.sent_since(0, "HEARTBEAT")) == heartbeats
        status, _ = flying.end()
    assert status == -signal.SIGKILL
    assert_safe(flying.vehicle_report(), "mid", at_ns)
    overrides = flying.relay.overrides
    assert overrides[-1] == RELEASE
    logged = list(logged_overrides(recording / "link.tlog"))
    assert logged[-1] == RELEASE
    assert logged == overrides[-len(logged) :]


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
        assert str(flying.guard.pid) in second.stderr + second.stdout
        assert second.returncode == 2
        flying.relay.disarm()
        assert flying.guard.has_ended(END_S)
    report = flying.vehicle_report()
    measured = assert_safe(report, "none", at_ns)
    assert measured.mode in ("BRAKE", "LAND")
    assert not any(entry["failsafe"] for entry in report["sticks"] if entry["armed"])
