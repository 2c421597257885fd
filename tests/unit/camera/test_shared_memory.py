import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from helpers.fakes import START_NS, FakeClock
from mavbridge.camera import shared_memory
from mavbridge.camera.shared_memory import SharedMemoryCamera
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from mavbridge.core.errors import CameraError
from sitl.camera.shm import FramePublisher

pytestmark = pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="needs /dev/shm")

WIDTH, HEIGHT = 8, 5
STRIDE = 192
"""32 + 8 * 5 * 3 = 152, rounded up to 64."""


def header(*, width=WIDTH, height=HEIGHT, channels=3, slots=4, magic=b"MBSHM\0\0\1"):
    return magic + struct.pack("<IIIIQQ", width, height, channels, slots, 0, 1)


class HandWriter:
    """A writer independent of the simulator's; a test can stop it between any two fields."""

    def __init__(self, path: Path) -> None:
        self.path = path
        draft = path.with_suffix(".draft")
        draft.write_bytes(header().ljust(64 + 4 * STRIDE, b"\0"))
        draft.replace(path)
        self._file = path.open("r+b", buffering=0)

    def put(self, offset, layout, *values):
        self._file.seek(offset)
        self._file.write(struct.pack(layout, *values))

    def begin(self, frame_id, captured_ns, grey):
        """Half a frame: the sequence number is left odd."""
        start = 64 + frame_id % 4 * STRIDE
        self.put(start, "<QQq", 2 * frame_id + 1, frame_id, captured_ns)
        self.put(start + 32, f"{WIDTH * HEIGHT * 3}s", bytes([grey]) * (WIDTH * HEIGHT * 3))

    def finish(self, frame_id):
        self.put(64 + frame_id % 4 * STRIDE, "<Q", 2 * frame_id + 2)

    def announce(self, frame_id):
        self.put(24, "<Q", frame_id)

    def publish(self, frame_id, captured_ns, grey=0):
        self.begin(frame_id, captured_ns, grey)
        self.finish(frame_id)
        self.announce(frame_id)

    def set_closed(self):
        self.put(32, "<Q", 2)

    def close(self):
        self._file.close()


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
    writer = HandWriter(path)
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


def test_a_frame_comes_with_its_stamp_and_cannot_be_written(camera, writer):
    writer.publish(1, START_NS - 5 * NS_PER_MS, grey=77)
    frame = camera.read(0)
    assert (frame.frame_id, frame.captured_ns) == (1, START_NS - 5 * NS_PER_MS)
    assert frame.rgb.shape == (HEIGHT, WIDTH, 3)
    assert frame.rgb.dtype == np.uint8
    assert set(frame.rgb.ravel().tolist()) == {77}
    assert not frame.rgb.flags.writeable
    assert camera.read(30 * NS_PER_MS) is None  # given once
    camera.close()
    assert set(frame.rgb.ravel().tolist()) == {77}


def test_the_newest_frame_wins_and_the_skipped_are_counted(camera, writer, clock):
    for frame_id in range(1, 7):
        writer.publish(frame_id, START_NS + frame_id, grey=frame_id)
    assert camera.read(0).frame_id == 6
    assert camera.dropped_frames == 5
    late = SharedMemoryCamera(writer.path.name, clock=clock)
    assert (late.read(0).frame_id, late.dropped_frames) == (6, 0)  # from before the opening
    late.close()


def test_a_half_written_frame_is_waited_for(camera, writer, clock):
    writer.begin(1, START_NS, grey=3)
    writer.announce(1)
    assert camera.read(0) is None
    clock.on_sleep = lambda: writer.finish(1)
    assert camera.read(10 * NS_PER_MS).frame_id == 1


def test_a_lapped_copy_is_thrown_away_and_the_newer_frame_taken(camera, writer, monkeypatch):
    """The writer comes round to the slot while its pixels are being copied."""
    writer.publish(1, START_NS, grey=1)
    laps = iter([lambda: writer.publish(5, START_NS + 5, grey=5)])

    def interrupted():
        if barriers.pop(0) == "after copy":
            next(laps, lambda: None)()

    barriers = ["newest", "before copy", "after copy", *["later"] * 3]
    monkeypatch.setattr(shared_memory, "memory_barrier", interrupted)
    frame = camera.read(0)
    assert (frame.frame_id, frame.captured_ns, frame.rgb[0, 0, 0]) == (5, START_NS + 5, 5)


def test_a_writer_that_falls_silent_is_dead_after_two_seconds(camera, writer, clock):
    writer.publish(1, START_NS)
    camera.read(0)
    clock.advance_ns(2 * NS_PER_S - 1)
    assert camera.read(0) is None
    clock.advance_ns(1)
    with pytest.raises(CameraError, match=f"{writer.path.name}: no new frame for 2 s"):
        camera.read(0)


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda writer: (writer.set_closed(), writer.path.unlink()), "closed"),
        (lambda writer: writer.publish(2, START_NS - 100 * NS_PER_S), "CLOCK_MONOTONIC"),
    ],
)
def test_a_writer_that_closed_or_leaves_our_clock_is_named_as_the_cause(
    camera, writer, clock, spoil, told
):
    writer.publish(1, START_NS)
    camera.read(0)
    spoil(writer)
    with pytest.raises(CameraError, match=told):
        camera.read(3 * NS_PER_S)
    assert clock.now_ns() <= START_NS + 2 * NS_PER_S + NS_PER_MS


def test_a_writer_that_starts_again_is_followed_and_ids_keep_rising(camera, writer, clock):
    for frame_id in (1, 2, 3):
        writer.publish(frame_id, START_NS)
    assert camera.read(0) is not None
    successors = []

    def restart():
        if not successors:
            successors.append(HandWriter(writer.path))
            successors[0].publish(1, clock.now_ns(), grey=42)

    clock.on_sleep = restart
    frame = camera.read(NS_PER_S)
    assert (frame.frame_id, frame.rgb[0, 0, 0]) == (4, 42)
    successors[0].close()


def test_a_name_that_is_not_there_says_what_to_start_and_what_is_there(writer, clock):
    camera = SharedMemoryCamera("nobody", clock=clock)
    assert camera.read(0) is None
    assert "python -m sitl --camera shm:nobody" in camera.waiting_reason
    assert writer.path.name in camera.waiting_reason
    camera.close()


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        pytest.param(b"", "wrong magic", id="empty"),
        pytest.param(header(magic=b"MBSHM\0\0\2").ljust(832, b"\0"), "wrong magic", id="version"),
        pytest.param(header(channels=4).ljust(832, b"\0"), "4 channels", id="channels"),
        pytest.param(header(width=0).ljust(832, b"\0"), "impossible", id="no width"),
        pytest.param(header().ljust(64 + 4 * STRIDE + 1, b"\0"), "it has 833", id="long"),
    ],
)
def test_a_file_in_another_format_is_refused(path, clock, content, complaint):
    path.write_bytes(content)
    with pytest.raises(CameraError, match=complaint):
        SharedMemoryCamera(path.name, clock=clock)


def test_a_pipe_among_the_segments_is_not_waited_for(path, clock):
    os.mkfifo(path)
    with pytest.raises(CameraError, match="a pipe or a device, not a file"):
        SharedMemoryCamera(path.name, clock=clock)
    assert "there is none" in SharedMemoryCamera("nobody", clock=clock).waiting_reason


SOLID_FRAMES = """
import sys, time
import numpy as np
from sitl.camera.shm import FramePublisher
publisher = FramePublisher(sys.argv[1], 320, 240)
print("ready", flush=True)
sys.stdin.readline()
for frame_id in range(1, 4001):
    publisher.publish(np.full((240, 320, 3), frame_id % 251, np.uint8), time.monotonic_ns())
publisher.close()
"""


@pytest.mark.system
def test_no_torn_frame_from_a_writer_at_full_speed(path):
    """Another process publishes as fast as it can; each frame read must be of one colour."""
    with subprocess.Popen(
        [sys.executable, "-c", SOLID_FRAMES, path.name],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as writer:
        assert writer.stdout.readline() == "ready\n"
        camera = SharedMemoryCamera(path.name, clock=MonotonicClock())
        writer.stdin.write("go\n")
        writer.stdin.flush()
        frames = read_until(4000, camera)
        camera.close()
    assert writer.returncode == 0
    assert len(frames) > 1
    assert all(low == high == frame_id % 251 for frame_id, low, high in frames)


def read_until(last_id, camera):
    """(frame_id, least, greatest value) of each frame that was seen."""
    seen = []
    while not seen or seen[-1][0] < last_id:
        frame = camera.read(10 * NS_PER_S)
        seen.append((frame.frame_id, frame.rgb.min(), frame.rgb.max()))
    return seen


def test_depth_is_read_as_it_was_written(path, clock):
    """By the description of the format, and by the simulator's writer: both are 16-bit."""
    depth = (1000 * np.arange(HEIGHT * WIDTH)).astype(np.uint16).reshape(HEIGHT, WIDTH)
    stride = 128  # 32 + 8 * 5 * 2 = 112, rounded up to 64
    head = header(channels=1)[:24] + struct.pack("<QQ", 1, 1)
    slots = bytearray(4 * stride)
    slots[stride : stride + 24] = struct.pack("<QQq", 2, 1, START_NS)
    slots[stride + 32 : stride + 112] = depth.astype("<u2").tobytes()
    path.write_bytes(head.ljust(64, b"\0") + bytes(slots))
    camera = SharedMemoryCamera(path.name, clock=clock)
    for captured_ns in (START_NS, START_NS + 1):
        frame = camera.read(NS_PER_S)
        assert frame.rgb.dtype == np.uint16
        assert np.array_equal(frame.rgb, depth)
        assert frame.captured_ns == captured_ns
        if captured_ns == START_NS:
            publisher = FramePublisher(path.name, WIDTH, HEIGHT, is_depth=True)
            publisher.publish(depth, START_NS + 1)
    with pytest.raises(ValueError, match="want uint16"):
        publisher.publish(np.zeros((HEIGHT, WIDTH, 3), np.uint8), START_NS)
    publisher.close()
    camera.close()
