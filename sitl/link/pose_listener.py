"""An listener on a vehicle's MAVLink link: what it says of its pose, and how to make it say so.

Pure: bytes in, bytes out, times given. Nothing that could steer the vehicle is sent: a heartbeat,
and requests for messages.
"""

import math
from collections.abc import Iterator
from typing import TypeAlias

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.clock import NS_PER_S
from sitl.rotation import Quat, Vec3, from_euler, integrate

Pose: TypeAlias = tuple[Vec3, Quat]
"""position_ned_m, ned_from_body_wxyz"""

SYSTEM_ID = 246
"""Not 255: ArduPilot takes a heartbeat with its ground station's id for that station's presence,
and an listener must not hide that the pilot's has gone."""
POSE_MAX_AGE_NS = NS_PER_S
HOUSEKEEPING_NS = NS_PER_S
ROUNDS_BEFORE_EULER = 3
"""Requests for the quaternion that go unanswered before Euler angles are asked for as well."""
QUATERNION = mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
POSITION = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED
FRAME_STARTS = (mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2)


class PoseTracker:
    """Pose of one vehicle from its MAVLink messages; pure, times are given.

    A reading with a value that is not finite, or a quaternion that is not one, is ignored.
    """

    def __init__(self) -> None:
        self._attitude: tuple[int, Quat, Vec3] | None = None
        self._position: tuple[int, Vec3, Vec3] | None = None

    def take(self, message: mavlink.MAVLink_message, arrived_ns: int) -> None:
        """Take in ATTITUDE_QUATERNION, ATTITUDE or LOCAL_POSITION_NED; others mean nothing here."""
        match message.get_type():
            case "ATTITUDE_QUATERNION":
                wxyz = (message.q1, message.q2, message.q3, message.q4)
                self._take_attitude(wxyz, message, arrived_ns)
            case "ATTITUDE":
                angles_rad = (message.roll, message.pitch, message.yaw)
                if all(map(math.isfinite, angles_rad)):
                    self._take_attitude(from_euler(*angles_rad), message, arrived_ns)
            case "LOCAL_POSITION_NED":
                position_m = (message.x, message.y, message.z)
                velocity_mps = (message.vx, message.vy, message.vz)
                if all(map(math.isfinite, position_m + velocity_mps)):
                    self._position = (arrived_ns, position_m, velocity_mps)

    def _take_attitude(self, wxyz: Quat, message: mavlink.MAVLink_message, arrived_ns: int) -> None:
        rate_radps = (message.rollspeed, message.pitchspeed, message.yawspeed)
        norm = math.hypot(*wxyz)
        if 0.9 < norm < 1.1 and all(map(math.isfinite, rate_radps)):
            w, x, y, z = (part / norm for part in wxyz)
            self._attitude = (arrived_ns, (w, x, y, z), rate_radps)

    def pose_at(self, now_ns: int) -> Pose | None:
        """Carried on to ``now_ns`` at constant velocity and body rate; None if a part of it is
        missing or older than POSE_MAX_AGE_NS."""
        if self._attitude is None or self._position is None:
            return None
        attitude_ns, wxyz, rate_radps = self._attitude
        position_ns, position_m, velocity_mps = self._position
        if now_ns - min(attitude_ns, position_ns) > POSE_MAX_AGE_NS:
            return None
        dt_s = (now_ns - position_ns) / NS_PER_S
        north_m, east_m, down_m = (
            p + v * dt_s for p, v in zip(position_m, velocity_mps, strict=True)
        )
        attitude = integrate(wxyz, rate_radps, (now_ns - attitude_ns) / NS_PER_S)
        return (north_m, east_m, down_m), attitude


class PoseListener:
    """Our end of the MAVLink conversation, without a socket: bytes in, bytes out.

    Follows the first autopilot that it hears and asks it, once a second, for each message that
    comes at less than half of the wanted rate.
    """

    def __init__(self, *, rate_hz: float) -> None:
        self._mav = mavlink.MAVLink(
            None, srcSystem=SYSTEM_ID, srcComponent=mavlink.MAV_COMP_ID_ONBOARD_COMPUTER
        )
        self._mav.robust_parsing = True
        self._rate_hz = rate_hz
        self._tracker = PoseTracker()
        self._vehicle: int | None = None
        self._received: dict[int, int] = {}
        self._rounds_without_quaternion = 0
        self._due_ns: int | None = None

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take in what arrived; garbage and other senders are ignored."""
        for message in self._messages(data):
            if message.get_srcComponent() != mavlink.MAV_COMP_ID_AUTOPILOT1:
                continue
            if self._vehicle is None and _is_autopilot(message):
                self._vehicle = message.get_srcSystem()
            if message.get_srcSystem() == self._vehicle:
                kind = message.get_msgId()
                self._received[kind] = self._received.get(kind, 0) + 1
                self._tracker.take(message, now_ns)

    def _messages(self, data: bytes) -> Iterator[mavlink.MAVLink_message]:
        """Parse; where garbage looked like a frame, what it swallowed is read again."""
        mav = self._mav
        message = mav.parse_char(data)
        while message is not None:
            if message.get_type() != "BAD_DATA":
                yield message
            elif message.data[0] in FRAME_STARTS:
                mav.buf = bytearray(message.data[1:]) + mav.buf[mav.buf_index :]
                mav.buf_index = 0
            message = mav.parse_char(b"")

    def pose_at(self, now_ns: int) -> Pose | None:
        """See `PoseTracker.pose_at`."""
        return self._tracker.pose_at(now_ns)

    def outgoing(self, now_ns: int) -> list[bytes]:
        """Packets to send now: a heartbeat and requests once a second, else nothing."""
        if self._due_ns is not None and now_ns < self._due_ns:
            return []
        self._due_ns = now_ns + HOUSEKEEPING_NS
        heartbeat = self._mav.heartbeat_encode(
            type=mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
            autopilot=mavlink.MAV_AUTOPILOT_INVALID,
            base_mode=0,
            custom_mode=0,
            system_status=mavlink.MAV_STATE_ACTIVE,
        )
        messages = [heartbeat, *(self._request(kind) for kind in self._scarce())]
        self._received.clear()
        return [message.pack(self._mav) for message in messages]

    def _scarce(self) -> list[int]:
        """Messages to ask for."""
        if self._vehicle is None:
            return []
        wanted = [QUATERNION, POSITION]
        self._rounds_without_quaternion += 1
        if self._received.get(QUATERNION):
            self._rounds_without_quaternion = 0
        if self._rounds_without_quaternion > ROUNDS_BEFORE_EULER:
            wanted.append(mavlink.MAVLINK_MSG_ID_ATTITUDE)
        return [kind for kind in wanted if self._received.get(kind, 0) < self._rate_hz / 2]

    def _request(self, kind: int) -> mavlink.MAVLink_message:
        return self._mav.command_long_encode(
            target_system=self._vehicle,
            target_component=mavlink.MAV_COMP_ID_AUTOPILOT1,
            command=mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
            confirmation=0,
            param1=kind,
            param2=1e6 / self._rate_hz,
            **dict.fromkeys(("param3", "param4", "param5", "param6", "param7"), 0),
        )


def _is_autopilot(message: mavlink.MAVLink_message) -> bool:
    return bool(
        message.get_type() == "HEARTBEAT" and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID
    )
