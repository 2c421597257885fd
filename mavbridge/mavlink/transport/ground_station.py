"""Rights of a ground station that shares our link: all but stream rates, sticks and setpoints.

Stream rates belong to the link, not to who asks for them: a request of the ground station would
slow our state down. Its sticks and setpoints would mix with ours in the vehicle.
"""

import struct
from enum import Enum, auto
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_MS
from mavbridge.mavlink.codec.frames import RawPacket
from mavbridge.mavlink.codec.messages import Endpoint

HELD_NS = 500 * NS_PER_MS
"""So long after our last sticks the vehicle still acts on them."""
IN_USE_NS = 1000 * NS_PER_MS
"""So long after it moved a stick of the ground station counts as in use."""
MOVED = 0.1
"""Share of full deflection from which a stick is not an untouched one any more."""

_SETPOINTS = (
    dialect.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET,
    dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED,
    dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT,
    dialect.MAVLINK_MSG_ID_SET_ACTUATOR_CONTROL_TARGET,
    dialect.MAVLINK_MSG_ID_MANUAL_SETPOINT,
)
_COMMANDS = (dialect.MAVLINK_MSG_ID_COMMAND_LONG, dialect.MAVLINK_MSG_ID_COMMAND_INT)
_COMMAND = struct.Struct("<28xHBB")
"""Both: 28 bytes of parameters, the command, and the system and component that shall do it."""
_MANUAL_CONTROL = struct.Struct("<4h")
_OVERRIDE = struct.Struct("<4H")
_ABSENT_AXIS, _UNDRIVEN_US = 32767, (0, 65535)


class Verdict(Enum):
    """What becomes of a packet of the ground station."""

    PASS = auto()
    DROP = auto()
    DENY = auto()
    """Not passed on, and answered as a command that the vehicle has refused."""


class _Sticks(NamedTuple):
    """Shares of full deflection in [-1, 1]; None: not driven."""

    roll: float | None
    pitch: float | None
    throttle: float | None
    yaw: float | None


class GroundStationRules:
    """Judges each packet; without I/O."""

    def __init__(self, *, sticks_win: bool) -> None:
        self._sticks_win = sticks_win
        self.dropped = 0
        """Packets that were not passed on."""
        self.texts: list[str] = []
        """Messages for the user, each once; the reader empties the list."""
        self._told: set[str] = set()
        self.has_won = False
        """Its sticks have taken over from ours; true until our flight is over."""
        self._held_ns: int | None = None
        self._moved_ns: int | None = None
        self._rest_throttle: float | None = None

    def on_our_sticks(self, now_ns: int) -> None:
        """Note that sticks of ours were sent."""
        self._held_ns = now_ns

    def judge(self, frame: RawPacket, now_ns: int, *, is_engaged: bool) -> Verdict:
        """Decide on a packet; ``is_engaged`` while our sticks are in use or being given back."""
        verdict = self._judge(frame, now_ns, is_engaged=is_engaged)
        self.dropped += verdict is not Verdict.PASS
        return verdict

    def overruled(self, now_ns: int, *, is_engaged: bool) -> str | None:
        """Why our sticks may not be sent, or None."""
        self._update(now_ns, is_engaged=is_engaged)
        if self.has_won:
            return "the ground station's sticks have taken over"
        if self._moved_ns is not None and now_ns - self._moved_ns < IN_USE_NS:
            return "the ground station's sticks are in use: let go of them"
        return None

    def _judge(self, frame: RawPacket, now_ns: int, *, is_engaged: bool) -> Verdict:
        if frame.message_id in _COMMANDS:
            command, _, _ = _command(frame)
            if command != dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
                return Verdict.PASS
            self._tell_of_rates()
            return Verdict.DENY
        if frame.message_id == dialect.MAVLINK_MSG_ID_REQUEST_DATA_STREAM:
            self._tell_of_rates()
            return Verdict.DROP
        if frame.message_id in _SETPOINTS:
            self._tell("the ground station's setpoints are dropped: they would mix with ours")
            return Verdict.DROP
        if (sticks := _sticks(frame)) is None:
            return Verdict.PASS
        if not self._sticks_win:
            text = "the ground station's sticks are dropped: --gcs-sticks-win lets them take over"
            self._tell(text)
            return Verdict.DROP
        return self._judge_sticks(sticks, now_ns, is_engaged=is_engaged)

    def _judge_sticks(self, sticks: _Sticks, now_ns: int, *, is_engaged: bool) -> Verdict:
        is_ours = self._update(now_ns, is_engaged=is_engaged)
        has_moved = self._has_moved(sticks)
        if has_moved:
            self._moved_ns = now_ns
        if not is_ours:
            self._rest_throttle = sticks.throttle
            return Verdict.PASS
        if has_moved and not self.has_won:
            self.has_won = True
            self.texts.append("the ground station's sticks have taken over")
        return Verdict.PASS if self.has_won else Verdict.DROP

    def _update(self, now_ns: int, *, is_engaged: bool) -> bool:
        """Whether the vehicle is ours; once it is not, nobody has taken it from us."""
        is_held = self._held_ns is not None and now_ns - self._held_ns < HELD_NS
        self.has_won &= is_engaged or is_held
        return is_engaged or is_held

    def _has_moved(self, sticks: _Sticks) -> bool:
        """A stick is off its centre, or the throttle is not where it was before our flight.

        A throttle has no centre that holds for all: at rest it is in the middle, or down.
        """
        off_centre = (sticks.roll, sticks.pitch, sticks.yaw)
        if any(value is not None and abs(value) > MOVED for value in off_centre):
            return True
        if sticks.throttle is None:
            return False
        if self._rest_throttle is None:
            self._rest_throttle = sticks.throttle
        return abs(sticks.throttle - self._rest_throttle) > MOVED

    def _tell_of_rates(self) -> None:
        text = "the ground station's requests for message rates are refused"
        self._tell(f"{text}: rates belong to the link, and the policy needs ours")

    def _tell(self, text: str) -> None:
        if text not in self._told:
            self._told.add(text)
            self.texts.append(text)


def denial(frame: RawPacket, vehicle: Endpoint) -> bytes:
    """COMMAND_ACK with which the vehicle would refuse the command in this packet."""
    command, system, component = _command(frame)
    codec = dialect.MAVLink(
        None,
        srcSystem=system or vehicle.system,
        srcComponent=component or vehicle.component,
    )
    denied = dialect.MAV_RESULT_DENIED
    ack: bytes = codec.command_ack_encode(command, denied, 0, 0, *frame.source).pack(codec)
    return ack


def _command(frame: RawPacket) -> tuple[int, int, int]:
    command, system, component = _COMMAND.unpack(_padded(frame.payload, _COMMAND.size))
    return command, system, component


def _sticks(frame: RawPacket) -> _Sticks | None:
    """Sticks of RC_CHANNELS_OVERRIDE, on ArduPilot's default channels, or of MANUAL_CONTROL."""
    if frame.message_id == dialect.MAVLINK_MSG_ID_RC_CHANNELS_OVERRIDE:
        channels_us = _OVERRIDE.unpack(_padded(frame.payload, _OVERRIDE.size))
        return _Sticks(*(None if us in _UNDRIVEN_US else (us - 1500) / 500 for us in channels_us))
    if frame.message_id == dialect.MAVLINK_MSG_ID_MANUAL_CONTROL:
        x, y, z, r = _MANUAL_CONTROL.unpack(_padded(frame.payload, _MANUAL_CONTROL.size))
        pitch, roll, up, yaw = (None if v == _ABSENT_AXIS else v / 1000 for v in (x, y, z, r))
        return _Sticks(roll, pitch, None if up is None else 2.0 * up - 1.0, yaw)
    return None


def _padded(payload: bytes, size: int) -> bytes:
    return payload[:size].ljust(size, b"\0")
