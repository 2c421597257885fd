"""Reads everything that leaves the guard by pymavlink alone, and judges it."""

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.output_flights import OutputFlight
from helpers.wire import WireEnd
from mavbridge.core.clock import NS_PER_S

_QUIET = ("HEARTBEAT", "TIMESYNC", "STATUSTEXT", "PARAM_REQUEST_READ")
_IGNORED, _RELEASED = 65535, 0
_MOST_LEAN_RAD, _MOST_RATE_RADPS = math.radians(80.5), math.radians(220.5)
_MOST_SPEED_MPS = 20.5
_MOST_COMMANDS = 200
"""In a second: those for a mode come every 100 ms, and each pretended reboot brings a few."""


class WireJudge:
    """Follows one flight; ``read`` raises AssertionError."""

    def __init__(self, flight: OutputFlight) -> None:
        self._flight = flight
        self._end = WireEnd()
        self._second = 0
        self._requests = 0

    def read(self) -> None:
        """Judge what has left since the last call."""
        for at_ns, data in self._flight.up.sent:
            messages = self._end.read(data)
            assert len(messages) == 1, f"{len(messages)} messages in {data.hex()}"
            self._judge(messages[0], at_ns)

    def _judge(self, message: Any, at_ns: int) -> None:
        name = message.get_type()
        if message.get_srcSystem() == 42:
            return  # the harness
        match name:
            case "RC_CHANNELS_OVERRIDE":
                _judge_override(message)
            case "MANUAL_CONTROL":
                _judge_manual_control(message)
            case "SET_ATTITUDE_TARGET":
                _judge_attitude(message)
            case "SET_POSITION_TARGET_LOCAL_NED":
                _judge_velocity(message)
            case "COMMAND_LONG":
                self._judge_command(message, at_ns)
            case _:
                assert name in _QUIET, f"{name} was sent"

    def _judge_command(self, message: Any, at_ns: int) -> None:
        """No arming, no takeoff: the flight is engaged in the air."""
        allowed = (
            *(dialect.MAV_CMD_DO_SET_MODE, dialect.MAV_CMD_SET_MESSAGE_INTERVAL),
            dialect.MAV_CMD_REQUEST_MESSAGE,
        )
        assert message.command in allowed, f"command {message.command} was sent"
        second = at_ns // NS_PER_S
        self._requests = self._requests + 1 if second == self._second else 1
        self._second = second
        assert self._requests <= _MOST_COMMANDS, "a flood of commands"


def _judge_override(m: Any) -> None:
    channels = [getattr(m, f"chan{number}_raw") for number in range(1, 9)]
    used = [us for us in channels if us != _IGNORED]
    assert len(used) == 4, channels
    is_release = all(us == _RELEASED for us in used)
    assert is_release or all(800 <= us <= 2200 for us in used), channels
    assert not any(getattr(m, f"chan{number}_raw") for number in range(9, 19))


def _judge_manual_control(m: Any) -> None:
    assert all(abs(value) <= 1000 for value in (m.x, m.y, m.r)), m
    assert 0 <= m.z <= 1000, m
    assert m.z > 150 or abs(m.r) <= 800, f"a gesture that arms: {m}"
    assert m.buttons == 0, m


def _judge_attitude(m: Any) -> None:
    assert 0.0 <= m.thrust <= 1.0, m  # scaled to where a vehicle says that it hovers, up to 0.9
    w, x, y, z = m.q
    assert abs(math.hypot(w, x, y, z) - 1.0) < 1e-3, m
    assert 2 * math.asin(min(math.hypot(x, y), 1.0)) <= _MOST_LEAN_RAD, m
    rates = (m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate)
    assert all(abs(rate) <= _MOST_RATE_RADPS for rate in rates), m


def _judge_velocity(m: Any) -> None:
    assert math.hypot(m.vx, m.vy, m.vz) <= _MOST_SPEED_MPS, m
    assert abs(m.yaw_rate) <= _MOST_RATE_RADPS, m
