"""The writer against docs/formats.md, read with struct and not with the reader."""

import os
import struct
from pathlib import Path

import numpy as np
import pytest

from sitl import UsageError
from sitl.camera.shm import FramePublisher

WIDTH, HEIGHT = 10, 6
STRIDE = 256
"""32 + 10 * 6 * 3 = 212, rounded up to 64."""

pytestmark = pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="needs /dev/shm")


@pytest.fixture
def name():
    return f"mb-test-writer-{os.getpid()}"


@pytest.fixture
def publisher(name):
    publisher = FramePublisher(name, WIDTH, HEIGHT)
    yield publisher
    publisher.close()


def raw(name):
    return Path("/dev/shm", name).read_bytes()


def grey(value):
    return np.full((HEIGHT, WIDTH, 3), value, np.uint8)


def test_frames_go_round_the_slots(publisher, name):
    for frame_id in range(1, 7):
        publisher.publish(grey(frame_id), captured_ns=1000 + frame_id)
    data = raw(name)
    assert struct.unpack_from("<Q", data, 24) == (6,)
    for frame_id in (3, 4, 5, 6):
        start = 64 + frame_id % 4 * STRIDE
        seq, stored_id, captured_ns = struct.unpack_from("<QQq", data, start)
        assert seq % 2 == 0
        assert (stored_id, captured_ns) == (frame_id, 1000 + frame_id)
        assert set(data[start + 32 : start + 32 + WIDTH * HEIGHT * 3]) == {frame_id}


def test_close_marks_the_stream_as_closed_and_removes_the_name(name):
    publisher = FramePublisher(name, WIDTH, HEIGHT)
    with Path("/dev/shm", name).open("rb") as kept:
        publisher.close()
        publisher.close()
        assert struct.unpack_from("<Q", kept.read(), 32) == (2,)
    assert not Path("/dev/shm", name).exists()
    with pytest.raises(ValueError, match="after close"):
        publisher.publish(grey(0), captured_ns=1)


def test_frames_that_are_not_whole_stay_marked_as_being_written(publisher, name):
    for number in range(1, 6):  # the fifth is in the slot of the first again
        publisher.publish(grey(number), number, is_whole=False)
    (sequence,) = struct.unpack_from("<q", raw(name), 64 + STRIDE)
    assert sequence == 1
    for number in range(6, 10):
        publisher.publish(grey(number), number)
    (sequence,) = struct.unpack_from("<q", raw(name), 64 + STRIDE)
    assert sequence == 2


def test_a_name_that_cannot_be_taken_leaves_nothing_behind(name):
    taken = Path("/dev/shm", name)
    taken.mkdir()
    try:
        with pytest.raises(UsageError, match=name):
            FramePublisher(name, WIDTH, HEIGHT)
        assert not list(taken.parent.glob(f".{name}.*"))
    finally:
        taken.rmdir()
