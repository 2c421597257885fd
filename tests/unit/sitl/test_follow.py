import socket
import threading
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavbridge.camera.shared_memory import SharedMemoryCamera
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from sitl.camera.follow import open_wire, run_follow
from sitl.camera.fpv import FpvRenderer
from sitl.course.layout import make_course
from sitl.errors import UsageError
from sitl.rotation import IDENTITY
from sitl.stopping import StopRequest

SHM = "mb-test-follow"
POSITION_M = (2.0, 0.5, -2.5)


@pytest.mark.parametrize(
    "url",
    [
        "",
        "udp",
        "udp:127.0.0.1",
        "udp::14551",
        "tcp:host:0",
        "tcp:host:65536",
        "serial:a:1",
        "udp:a:b",
    ],
)
def test_an_address_that_is_none_is_refused(url):
    with pytest.raises(UsageError):
        open_wire(url)


def test_a_port_in_use_is_refused():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(UsageError, match="cannot listen on 127"):
            open_wire(f"udp:127.0.0.1:{taken.getsockname()[1]}")


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_refused(fps):
    with pytest.raises(UsageError, match="frame rate"):
        run_follow("udpout:127.0.0.1:9", SHM, 7, 64, 48, fps, StopRequest())


def test_a_listening_wire_answers_whoever_spoke():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(10)
        listening = open_wire(f"udpout:127.0.0.1:{peer.getsockname()[1]}")
        assert listening.read() is None
        listening.send(b"hello")
        data, address = peer.recvfrom(100)
        assert data == b"hello"
        peer.sendto(b"answer", address)
        assert read_within_deadline(listening) == b"answer"
        listening.close()


def test_a_lost_tcp_connection_is_made_again_by_the_next_send():
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(10)
        wire = open_wire(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        assert wire.read() is None
        for greeting in (b"first", b"second"):
            wire.send(greeting)
            accepted, _ = server.accept()
            with accepted:
                accepted.settimeout(10)
                assert accepted.recv(100) == greeting
                accepted.sendall(b"answer to " + greeting)
                assert read_within_deadline(wire) == b"answer to " + greeting
            wait_for_end(wire)
        wire.close()


def test_a_tcp_peer_that_is_not_there_is_no_error():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    wire = open_wire(f"tcp:127.0.0.1:{port}")
    wire.send(b"anybody?")
    assert wire.read() is None
    wire.close()


def read_within_deadline(wire):
    clock = MonotonicClock()
    deadline_ns = clock.now_ns() + 10 * NS_PER_S
    while clock.now_ns() < deadline_ns:
        data = wire.read()
        if data is not None:
            return data
    raise AssertionError("nothing arrived within 10 s")


def wait_for_end(wire):
    clock = MonotonicClock()
    deadline_ns = clock.now_ns() + 10 * NS_PER_S
    while wire._socket is not None:
        assert clock.now_ns() < deadline_ns
        wire.read()


@pytest.mark.system
@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="needs /dev/shm")
def test_a_vehicle_over_udp_is_seen_through_shared_memory(capfd):
    """A vehicle that streams only after it was asked to; the frames must show its pose."""
    stop = StopRequest()
    course = make_course(7)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.bind(("127.0.0.1", 0))
        vehicle.settimeout(10)
        url = f"udpout:127.0.0.1:{vehicle.getsockname()[1]}"
        follower = threading.Thread(
            target=run_follow, args=(url, SHM, 7, 96, 64, 50.0, stop), name="test-follow"
        )
        follower.start()
        camera = SharedMemoryCamera(SHM, clock=MonotonicClock())
        frame = stream_until_frame(vehicle, camera)
        stop.set()
        follower.join(10)
        camera.close()
    assert not follower.is_alive()
    assert not Path("/dev/shm", SHM).exists()
    wanted = FpvRenderer(course, 96, 64).render(POSITION_M, IDENTITY)
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
