import errno
import os
from pathlib import Path

import pytest

from mavbridge.recording.video.ring import MAX_BYTES, MAX_SLOTS, MIN_SLOTS, allocate, ring_shape


@pytest.mark.parametrize(("side", "slots"), [(224, MAX_SLOTS), (1080, 9), (3000, MIN_SLOTS)])
def test_memory_is_bounded(side: int, slots: int) -> None:
    assert ring_shape(side, side).slots == slots
    assert slots == MIN_SLOTS or slots * side * side * 3 <= MAX_BYTES


def test_too_little_memory_is_an_error_now_and_not_a_crash_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reserved: list[str] = []

    def refuse(fd: int, _offset: int, _size: int) -> None:
        reserved.append(str(Path(f"/proc/self/fd/{fd}").readlink()))
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    with pytest.raises(OSError, match="No space"):
        allocate(ring_shape(20, 20))
    assert reserved[0].startswith("/dev/shm/")
    assert reserved[0].endswith("(deleted)"), "nothing stays, whoever is killed"
