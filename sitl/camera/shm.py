"""Writer of frames in shared memory; format: docs/formats.md."""

import math
import mmap
import os
import struct
import tempfile
import threading
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sitl import UsageError

MAGIC = b"MBSHM\0\0\1"
HEADER_BYTES = 64
SLOT_HEADER_BYTES = 32
CHANNELS = 3
SLOTS = 4
LIVE, CLOSED = 1, 2
NEWEST, STATE = 3, 4  # fields of the header, in units of 8 bytes
SEQ, FRAME_ID, CAPTURED_NS = 0, 1, 2  # fields of a slot, in units of 8 bytes


class FramePublisher:
    """Publishes RGB or depth frames of one size under a name, from one thread."""

    def __init__(self, name: str, width: int, height: int, *, is_depth: bool = False) -> None:
        if not name or "/" in name or name.startswith("."):
            raise UsageError(f"shm:{name}: want a name such as fpv, without '/' or a leading '.'")
        folder = Path("/dev/shm")  # noqa: S108 - the system's place for shared memory
        self._path = (folder if folder.is_dir() else Path(tempfile.gettempdir())) / name
        self._type = np.dtype("<u2" if is_depth else "u1")
        self._shape = (height, width) if is_depth else (height, width, CHANNELS)
        size = math.prod(self._shape) * self._type.itemsize
        stride = -(-(SLOT_HEADER_BYTES + size) // 64) * 64
        header = struct.pack("<IIII", width, height, 1 if is_depth else CHANNELS, SLOTS)
        try:
            self._map, self._inode = _create(self._path, header, HEADER_BYTES + SLOTS * stride)
        except OSError as error:
            reason = f"{error.strerror}; give another name or make room in {self._path.parent}"
            raise UsageError(f"shm:{name}: {reason}") from error
        self._header = np.frombuffer(self._map, np.int64, HEADER_BYTES // 8)
        starts = range(HEADER_BYTES, HEADER_BYTES + SLOTS * stride, stride)
        self._fields = [np.frombuffer(self._map, np.int64, 4, start) for start in starts]
        self._pixels = [
            np.ndarray(self._shape, self._type, self._map, start + SLOT_HEADER_BYTES)
            for start in starts
        ]
        self._frame_id = 0
        self._lock = threading.Lock()

    @property
    def path(self) -> Path:
        return self._path

    def publish(
        self, rgb: NDArray[np.uint8 | np.uint16], captured_ns: int, *, is_whole: bool = True
    ) -> None:
        """Publish a frame, [height, width, 3] uint8 or [height, width] uint16, as the newest.

        ``is_whole=False`` leaves it marked as being written, like a writer that stopped halfway.

        Raises:
            ValueError: the shape or type is not the announced one, or the publisher is closed.
        """
        if rgb.shape != self._shape or rgb.dtype != self._type:
            raise ValueError(f"want {self._type} {self._shape}, got {rgb.dtype} {rgb.shape}")
        if not self._fields:
            raise ValueError("publish after close")
        self._frame_id += 1
        fields = self._fields[self._frame_id % SLOTS]
        fields[SEQ] |= 1  # odd: being written
        self._memory_barrier()
        fields[FRAME_ID] = self._frame_id
        fields[CAPTURED_NS] = captured_ns
        self._pixels[self._frame_id % SLOTS][:] = rgb
        self._memory_barrier()
        fields[SEQ] += is_whole
        self._memory_barrier()
        self._header[NEWEST] = self._frame_id

    def close(self) -> None:
        """Mark the stream as closed. Remove the name unless another writer has taken it over."""
        if not self._fields:
            return
        self._header[STATE] = CLOSED
        if self._path.exists() and self._path.stat().st_ino == self._inode:
            self._path.unlink()
        self._fields, self._pixels, self._header = [], [], np.empty(0, np.int64)
        self._map.close()

    def _memory_barrier(self) -> None:
        """Order earlier stores before later ones, for readers on other cores.

        Python has no barrier; taking and freeing a lock is one on every platform (POSIX 4.12).
        """
        with self._lock:
            pass


def _create(path: Path, header: bytes, size: int) -> tuple[mmap.mmap, int]:
    """Create the file under a temporary name, then rename it: no reader sees half a header."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with draft.open("w+b") as file:
            file.truncate(size)
            file.write(MAGIC + header + struct.pack("<QQ", 0, LIVE))
            file.flush()
            mapped = mmap.mmap(file.fileno(), size)
            inode = os.fstat(file.fileno()).st_ino
        draft.replace(path)
    except OSError:
        draft.unlink(missing_ok=True)
        raise
    return mapped, inode
