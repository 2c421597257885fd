"""Frames of the simulator's writer, whose own tests read it by the description of the format."""

import os
import struct
from pathlib import Path

import numpy as np
import pytest

from helpers.fakes import START_NS, FakeClock
from mavbridge.camera import shared_memory
from mavbridge.camera.shared_memory import SharedMemoryCamera
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.errors import CameraError
from sitl.camera.shm import SEQ, FramePublisher

pytestmark = pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="needs /dev/shm")

WIDTH, HEIGHT = 8, 5


def header(*, width=WIDTH, channels=3, magic=b"MBSHM\0\0\1"):
    return magic + struct.pack("<IIIIQQ", width, HEIGHT, channels, 4, 0, 1)


def grey(level):
    return np.full((HEIGHT, WIDTH, 3), level, np.uint8)


class HookedClock(FakeClock):
    """Calls back in each sleep: what another process would do meanwhile."""

    def __init__(self):
        super().__init__()
        self.on_sleep = lambda: None

    def sleep_until_ns(self, deadline_ns):
        super().sleep_until_ns(deadline_ns)
        self.on_sleep()


@pytest.fixture
def path():
    path = Path("/dev/shm", f"mb-test-reader-{os.getpid()}")
    yield path
    path.unlink(missing_ok=True)


@pytest.fixture
def writer(path):
    writer = FramePublisher(path.name, WIDTH, HEIGHT)
    yield writer
    writer.close()


@pytest.fixture
def clock():
    return HookedClock()


@pytest.fixture
def camera(writer, clock):
    camera = SharedMemoryCamera(writer.path.name, clock=clock)
    yield camera
    camera.close()


def test_the_newest_frame_wins_with_its_stamp_and_the_skipped_are_counted(camera, writer, clock):
    for number in range(1, 7):
        writer.publish(grey(number), START_NS - number)
    frame = camera.read(0)
    assert (frame.frame_id, frame.captured_ns, frame.is_stamped) == (6, START_NS - 6, True)
    assert camera.dropped_frames == 5
    assert camera.read(30 * NS_PER_MS) is None  # given once
    late = SharedMemoryCamera(writer.path.name, clock=clock)
    assert (late.read(0).frame_id, late.dropped_frames) == (6, 0)  # from before the opening
    late.close()
    camera.close()
    assert np.array_equal(frame.rgb, grey(6))
    assert frame.rgb.dtype == np.uint8
    assert not frame.rgb.flags.writeable


def test_a_half_written_frame_is_waited_for(camera, writer, clock):
    writer.publish(grey(3), START_NS, is_whole=False)
    assert camera.read(0) is None

    def finish():
        writer._fields[1][SEQ] = 2

    clock.on_sleep = finish
    assert camera.read(10 * NS_PER_MS).frame_id == 1


def test_a_lapped_copy_is_thrown_away_and_the_newer_frame_taken(camera, writer, monkeypatch):
    """The writer comes round to the slot while its pixels are being copied."""
    writer.publish(grey(1), START_NS)
    barriers = ["newest", "before copy", "after copy", *["later"] * 3]

    def interrupted():
        if barriers.pop(0) == "after copy":
            for number in range(2, 6):
                writer.publish(grey(number), START_NS + number)

    monkeypatch.setattr(shared_memory, "memory_barrier", interrupted)
    frame = camera.read(0)
    assert (frame.frame_id, frame.captured_ns, frame.rgb[0, 0, 0]) == (5, START_NS + 5, 5)


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda writer: None, "no new frame for 2 s"),
        (FramePublisher.close, "closed"),
        (lambda writer: writer.publish(grey(0), START_NS - 100 * NS_PER_S), "CLOCK_MONOTONIC"),
    ],
)
def test_a_writer_is_dead_after_two_seconds_and_the_cause_is_named(
    camera, writer, clock, spoil, told
):
    writer.publish(grey(0), START_NS)
    camera.read(0)
    spoil(writer)
    assert camera.read(2 * NS_PER_S - 1) is None
    with pytest.raises(CameraError, match=rf"{writer.path.name}: .*{told}"):
        camera.read(3 * NS_PER_S)
    assert clock.now_ns() <= START_NS + 2 * NS_PER_S + NS_PER_MS


def test_a_writer_that_starts_again_is_followed_and_ids_keep_rising(camera, writer, clock):
    for _ in range(3):
        writer.publish(grey(0), START_NS)
    assert camera.read(0) is not None
    successors = []

    def restart():
        if not successors:
            successors.append(FramePublisher(writer.path.name, WIDTH, HEIGHT))
            successors[0].publish(grey(42), clock.now_ns())

    clock.on_sleep = restart
    frame = camera.read(NS_PER_S)
    assert (frame.frame_id, frame.rgb[0, 0, 0]) == (4, 42)
    successors[0].close()


def test_a_name_that_is_not_there_says_what_to_start_and_what_is_there(writer, clock):
    camera = SharedMemoryCamera("nobody", clock=clock)
    assert camera.read(0) is None
    writer_command = "python -m sitl --connect udpout:127.0.0.1:14550 --camera shm:nobody"
    assert writer_command in camera.waiting_reason
    assert writer.path.name in camera.waiting_reason
    camera.close()


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        pytest.param(b"", "wrong magic", id="empty"),
        pytest.param(header(magic=b"MBSHM\0\0\2").ljust(832, b"\0"), "wrong magic", id="version"),
        pytest.param(header(channels=4).ljust(832, b"\0"), "4 channels", id="channels"),
        pytest.param(header(width=0).ljust(832, b"\0"), "impossible", id="no width"),
        pytest.param(header().ljust(833, b"\0"), "take 832 bytes, it has 833", id="long"),
        pytest.param(None, "a pipe or a device, not a file", id="pipe"),
    ],
)
def test_a_file_in_another_format_is_refused(path, clock, content, complaint):
    if content is None:
        os.mkfifo(path)
    else:
        path.write_bytes(content)
    with pytest.raises(CameraError, match=complaint):
        SharedMemoryCamera(path.name, clock=clock)
    assert "there is none" in SharedMemoryCamera("nobody", clock=clock).waiting_reason


def test_depth_is_read_as_it_was_written(path, clock):
    """By the description of the format, and by the simulator's writer."""
    depth = (1000 * np.arange(HEIGHT * WIDTH)).astype(np.uint16).reshape(HEIGHT, WIDTH)
    stride = 128  # 32 + 8 * 5 * 2 = 112, rounded up to 64
    head = header(channels=1)[:24] + struct.pack("<QQ", 1, 1)
    slots = bytearray(4 * stride)
    slots[stride : stride + 24] = struct.pack("<QQq", 2, 1, START_NS)
    slots[stride + 32 : stride + 112] = depth.astype("<u2").tobytes()
    path.write_bytes(head.ljust(64, b"\0") + bytes(slots))
    camera = SharedMemoryCamera(path.name, clock=clock)
    assert np.array_equal(camera.read(NS_PER_S).rgb, depth)
    publisher = FramePublisher(path.name, WIDTH, HEIGHT, is_depth=True)
    publisher.publish(depth, START_NS + 1)
    assert np.array_equal(camera.read(NS_PER_S).rgb, depth)
    publisher.close()
    camera.close()
