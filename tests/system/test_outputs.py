"""Faults of the flight process under setpoints, by real processes."""

import signal
from pathlib import Path
from typing import Any

import pytest

from faults.relay import Sent
from faults.stage import Stage, staged

pytestmark = pytest.mark.system
"""The aim on a machine of its own is 60 ms."""
HANG_LIMIT_MS = 400
"""The aim is 270 ms: the stall that a new contract flies through, and 20 ms."""
MODE_LIMIT_MS = 400
LEAST_MPS = 1.0
TIMEOUT_S = 60.0
TAKEOFF = ("--takeoff", "2", "--policy", "scripted:square:velocity:air")


def is_flown(sent: Sent) -> bool:
    """The message tells the vehicle to move sideways or ahead."""
    is_setpoint, message = sent.name == "SET_POSITION_TARGET_LOCAL_NED", sent.message
    return is_setpoint and max(abs(message.vx), abs(message.vy)) > LEAST_MPS


def wait_for_a_leg(flying: Stage) -> None:
    """The square has begun."""
    sent = flying.relay.sent
    assert flying.relay.wait_until(lambda: bool(sent), TIMEOUT_S)
    assert flying.guard.pid
    assert flying.relay.wait_until(lambda: is_flown(sent[-1]), TIMEOUT_S)


def mode_ms(report: Any, at_ns: int, mode: str) -> float:
    """From a moment until the vehicle was in a mode, in which it stayed."""
    at_s = (at_ns - report["start_ns"]) / 1e9
    changes = [entry for entry in report["modes"] if entry["t_s"] >= at_s]
    assert [entry["mode"] for entry in changes] == [mode], report["modes"]
    return float((changes[0]["t_s"] - at_s) * 1e3)


def last_flown_ms(flying: Stage, at_ns: int) -> float:
    """Until the last message that told the vehicle to move; negative: before the moment."""
    flown = [sent.at_ns for sent in flying.relay.sent if is_flown(sent)]
    return (flown[-1] - at_ns) / 1e6


def test_px4s_offboard_when_the_flight_process_is_stopped(tmp_path: Path) -> None:
    with staged(tmp_path, "--autopilot", "px4", renders=False) as flying:
        flying.start("--dual-rate", "--arm", *TAKEOFF)
        wait_for_a_leg(flying)
        at_ns = flying.kill(signal.SIGSTOP)
        flying.observe(1.0)
        flying.kill(signal.SIGCONT)
        flying.observe(1.0)
        flying.kill(signal.SIGINT)
        status, output = flying.end()
    assert status == 4, output
    report = flying.vehicle_report()
    assert last_flown_ms(flying, at_ns) <= HANG_LIMIT_MS
    assert mode_ms(report, at_ns, "AUTO.LOITER") <= HANG_LIMIT_MS + MODE_LIMIT_MS
    setpoints = [sent for sent in flying.relay.sent if sent.name == "SET_POSITION_TARGET_LOCAL_NED"]
    assert setpoints[-1].at_ns < at_ns + 1e9, "the stream does not come back"
    assert not any(entry["failsafe"] for entry in report["sticks"])
