import socket
import threading
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavbridge.camera.shared_memory import SharedMemoryCamera
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from sitl.camera.follow import film_vehicle
from sitl.camera.fpv import CameraOptions, FpvRenderer
from sitl.clock import StopRequest
from sitl.course import make_course
from sitl.vehicle.rotation import IDENTITY

SHM = "mb-test-follow"
POSITION_M = (2.0, 0.5, -2.5)


@pytest.mark.system
@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="needs /dev/shm")
def test_a_vehicle_over_udp_is_seen_through_shared_memory(capfd):
    """A vehicle that streams only after it was asked to; the frames must show its pose."""
    stop = StopRequest()
    course = make_course(7)
    options = CameraOptions(shm_name=SHM, image_size=96, fps=50.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.bind(("127.0.0.1", 0))
        vehicle.settimeout(10)
        url = f"udpout:127.0.0.1:{vehicle.getsockname()[1]}"
        follower = threading.Thread(
            target=film_vehicle, args=(url, course, options, stop.is_set), name="test-follow"
        )
        follower.start()
        camera = SharedMemoryCamera(SHM, clock=MonotonicClock())
        frame = stream_until_frame(vehicle, camera)
        stop.set()
        follower.join(10)
        camera.close()
    assert not follower.is_alive()
    assert not Path("/dev/shm", SHM).exists()
    wanted = FpvRenderer(course, 96, 96).render(POSITION_M, IDENTITY)
    np.testing.assert_array_equal(frame.rgb, wanted)
    complaints = capfd.readouterr().err
    assert complaints.count("no pose") == 1
    assert complaints.count("publishing") == 1


def stream_until_frame(vehicle, camera):
    """Answers packet by packet: heartbeat to heartbeat, a pose to each request."""
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    heartbeat = mav.heartbeat_encode(2, 3, 0, 0, 4)
    pose = [
        mav.attitude_quaternion_encode(0, *IDENTITY, 0, 0, 0),
        mav.local_position_ned_encode(0, *POSITION_M, 0, 0, 0),
    ]
    while True:
        data, follower = vehicle.recvfrom(1000)
        (message,) = mavlink.MAVLink(None).parse_buffer(data)
        for answer in [heartbeat] if message.get_type() == "HEARTBEAT" else pose:
            vehicle.sendto(answer.pack(mav), follower)
        if message.get_type() == "COMMAND_LONG":
            frame = camera.read(5 * NS_PER_S)
            assert frame is not None
            return frame
