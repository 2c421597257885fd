import errno
import os
from pathlib import Path

import pytest

from mavbridge.recording.video.ring import MAX_BYTES, MAX_SLOTS, MIN_SLOTS, FrameRing


@pytest.mark.parametrize(("side", "slots"), [(224, MAX_SLOTS), (1080, 9), (3000, MIN_SLOTS)])
def test_memory_is_bounded(side: int, slots: int) -> None:
    ring = FrameRing.create(side, side)
    assert ring.shape.slots == slots
    assert slots == MIN_SLOTS or slots * side * side * 3 <= MAX_BYTES
    ring.close()


def test_too_little_memory_is_an_error_now_and_not_a_crash_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reserved: list[Path] = []

    def refuse(fd: int, _offset: int, _size: int) -> None:
        reserved.append(Path(f"/proc/self/fd/{fd}").readlink())
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    with pytest.raises(OSError, match="No space"):
        FrameRing.create(20, 20)
    assert reserved[0].parent == Path("/dev/shm")
    assert not reserved[0].exists()
