"""Camera on another vehicle: its reported pose in, frames of the course out.

The vehicle's local NED is used as the frame of the course, so the vehicle must start at the origin,
heading north. Only heartbeats and message requests are sent, nothing that could steer the vehicle.
"""

import math
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from typing import TypeAlias

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.camera.fpv import CameraOptions, FpvRenderer
from sitl.camera.shm import FramePublisher
from sitl.clock import NS_PER_S, Clock, next_slot_ns
from sitl.course import Course
from sitl.link.telemetry import Message
from sitl.link.transport import FOLLOWER_KINDS, open_transport
from sitl.vehicle.rotation import Quat, Vec3, integrate, norm, normalised, plus

ReportedPose: TypeAlias = tuple[Vec3, Quat]  # position_ned_m, ned_from_body_wxyz

SYSTEM_ID = 246
"""Not 255: ArduPilot would count our heartbeats as its ground station's and miss the loss of the
pilot's ground station."""
POSE_MAX_AGE_NS = NS_PER_S
REQUEST_PERIOD_NS = NS_PER_S
QUATERNION = mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
POSITION = mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED
MESSAGES_PER_FRAME = 2
MAX_MESSAGE_HZ = 200.0  # within ArduPilot's limit at its default loop rate
NO_POSE = "no pose from the vehicle in the last second, so no frames"


class PoseListener:
    """Tracks the pose of the first autopilot heard, without I/O: bytes in, bytes out.

    Once a second it requests each message that arrives at less than half of the wanted rate. It
    ignores a reading with a non-finite value or a quaternion far from unit length.
    """

    def __init__(self, *, rate_hz: float) -> None:
        self._mav = mav.MAVLink(
            None, srcSystem=SYSTEM_ID, srcComponent=mav.MAV_COMP_ID_ONBOARD_COMPUTER
        )
        self._mav.robust_parsing = True
        self._rate_hz = rate_hz
        self._vehicle: int | None = None
        self._attitude: tuple[int, Quat, Vec3] | None = None
        self._position: tuple[int, Vec3, Vec3] | None = None
        self._received = Counter[int]()
        self._due_ns: int | None = None

    def receive(self, data: bytes, arrived_ns: int) -> None:
        """Parse received bytes; ignore garbage and other senders."""
        for message in self._mav.parse_buffer(data) or ():
            if message.get_srcComponent() != mav.MAV_COMP_ID_AUTOPILOT1:
                continue
            is_heartbeat = message.get_type() == "HEARTBEAT"
            is_autopilot = is_heartbeat and message.autopilot != mav.MAV_AUTOPILOT_INVALID
            if self._vehicle is None and is_autopilot:
                self._vehicle = message.get_srcSystem()
            if message.get_srcSystem() == self._vehicle:
                self._received[message.get_msgId()] += 1
                self._update(message, arrived_ns)

    def pose_at(self, now_ns: int) -> ReportedPose | None:
        """Return the pose extrapolated to ``now_ns`` at constant velocity and body rate.

        None if position or attitude is missing or older than POSE_MAX_AGE_NS.
        """
        if self._attitude is None or self._position is None:
            return None
        attitude_ns, wxyz, rate_radps = self._attitude
        position_ns, position_m, velocity_mps = self._position
        if now_ns - min(attitude_ns, position_ns) > POSE_MAX_AGE_NS:
            return None
        now_m = plus(position_m, velocity_mps, (now_ns - position_ns) / NS_PER_S)
        return now_m, integrate(wxyz, rate_radps, (now_ns - attitude_ns) / NS_PER_S)

    def outgoing(self, now_ns: int) -> list[bytes]:
        """Return the packets to send now: a heartbeat and requests once a second, else none."""
        if self._due_ns is not None and now_ns < self._due_ns:
            return []
        self._due_ns = now_ns + REQUEST_PERIOD_NS
        own_type, no_autopilot = mav.MAV_TYPE_ONBOARD_CONTROLLER, mav.MAV_AUTOPILOT_INVALID
        messages = [
            mav.MAVLink_heartbeat_message(own_type, no_autopilot, 0, 0, mav.MAV_STATE_ACTIVE, 3)
        ]
        number, interval_us = mav.MAV_CMD_SET_MESSAGE_INTERVAL, 1e6 / self._rate_hz
        enough = self._rate_hz / 2
        missing = [kind for kind in (QUATERNION, POSITION) if self._received[kind] < enough]
        for kind in missing if self._vehicle is not None else ():
            to, params = (self._vehicle, mav.MAV_COMP_ID_AUTOPILOT1), (kind, interval_us)
            request = mav.MAVLink_command_long_message(*to, number, 0, *params, *[0.0] * 5)
            messages.append(request)
        self._received.clear()
        return [message.pack(self._mav) for message in messages]

    def _update(self, message: Message, arrived_ns: int) -> None:
        match message.get_type():
            case "ATTITUDE_QUATERNION":
                rate_radps = (message.rollspeed, message.pitchspeed, message.yawspeed)
                wxyz = (message.q1, message.q2, message.q3, message.q4)
                if 0.9 < norm(wxyz) < 1.1 and all(map(math.isfinite, rate_radps)):
                    self._attitude = (arrived_ns, normalised(wxyz), rate_radps)
            case "LOCAL_POSITION_NED":
                position_m = (message.x, message.y, message.z)
                velocity_mps = (message.vx, message.vy, message.vz)
                if all(map(math.isfinite, position_m + velocity_mps)):
                    self._position = (arrived_ns, position_m, velocity_mps)


def film_vehicle(
    url: str, course: Course, camera: CameraOptions, should_stop: Callable[[], bool]
) -> None:
    """Publish the view from the vehicle on ``url`` until ``should_stop``.

    ``url``: ``udp:HOST:PORT`` and ``udpin:`` listen, ``udpout:`` and ``tcp:`` connect. No frames
    are published while the pose is unknown or older than 1 s; changes are printed on stderr.

    Raises:
        UsageError: the address cannot be parsed or bound, or the name cannot be used.
    """
    clock = Clock()
    renderer = FpvRenderer(course, camera.image_size, camera.image_size)
    listener = PoseListener(rate_hz=min(MESSAGES_PER_FRAME * camera.fps, MAX_MESSAGE_HZ))
    period_ns = round(NS_PER_S / camera.fps)
    due_ns = clock.now_ns()
    was_known: bool | None = None
    with (
        closing(open_transport(url, clock, FOLLOWER_KINDS)) as transport,
        closing(FramePublisher(camera.shm_name, camera.image_size, camera.image_size)) as publisher,
    ):
        while not should_stop():
            clock.sleep_until_ns(due_ns)
            for received in transport.drain():
                listener.receive(received.data, received.arrived_ns)
            now_ns = clock.now_ns()
            for packet in listener.outgoing(now_ns):
                transport.send(packet)
            pose = listener.pose_at(now_ns)
            if pose is not None:
                publisher.publish(renderer.render(*pose), now_ns)
            if was_known is not (pose is not None):
                was_known = pose is not None
                text = "pose received, publishing frames" if was_known else NO_POSE
                sys.stderr.write(f"camera: {url}: {text}\n")
            due_ns = next_slot_ns(due_ns, period_ns, clock.now_ns())
