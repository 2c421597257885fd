"""Films the course from any other vehicle: its reported pose in, camera frames out.

The vehicle's local NED is taken for the frame of the course, so it must start at the origin,
heading north.
"""

import sys
from collections.abc import Callable
from contextlib import closing

from sitl.camera.fpv import CameraOptions, FpvRenderer
from sitl.camera.shm import FramePublisher
from sitl.clock import NS_PER_S, Clock
from sitl.course.layout import Course
from sitl.link.pose_listener import PoseListener
from sitl.link.transport import FOLLOWER_KINDS, open_transport

MESSAGES_PER_FRAME = 2
MAX_MESSAGE_HZ = 200.0  # within what ArduPilot can send at its default loop rate
NO_POSE = "no pose from the vehicle in the last second, so no frames"


def film_vehicle(
    url: str, course: Course, camera: CameraOptions, should_stop: Callable[[], bool]
) -> None:
    """Publish the view from the vehicle on ``url`` until ``should_stop``.

    ``url``: ``udp:HOST:PORT`` or ``udpin:`` listens, ``udpout:`` and ``tcp:`` connect to it. While
    the pose is unknown or older than 1 s no frames are published; changes are printed on stderr.

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
            due_ns += period_ns * (1 + max(0, clock.now_ns() - due_ns) // period_ns)
