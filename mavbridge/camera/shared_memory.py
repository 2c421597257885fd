"""Reader of frames in shared memory: docs/shm_camera.md is the format."""

import mmap
import os
import struct
import tempfile
import threading
from pathlib import Path

import numpy as np

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import CameraError, UserError
from mavbridge.core.records import Frame, ImageArray

MAGIC = b"MBSHM\0\0\1"
HEADER = struct.Struct("<8sIIII")
HEADER_BYTES = 64
SLOT_HEADER_BYTES = 32
CHANNELS = 3
SLOTS = 4
MAX_SIDE_PX = 16384
CLOSED = 2
NEWEST, STATE = 3, 4
"""Places of the header's fields, in units of 8 bytes."""
SEQ, FRAME_ID, CAPTURED_NS = 0, 1, 2
"""Places of a slot's fields, in units of 8 bytes."""

POLL_NS = NS_PER_MS
STALL_NS = 2 * NS_PER_S
START_NS = 10 * NS_PER_S
"""Patience with a writer that is started after the reader."""
LOOK_AGAIN_NS = 200 * NS_PER_MS
"""How often a starving reader looks whether the name stands for another file by now."""
MAX_LAPS = 8
"""Copies that the writer may spoil in a row before the reader waits for the next poll."""


class SharedMemoryCamera:
    """Newest frame of a segment. Polls: the writer has no way to wake a reader.

    Follows the name when another writer takes it over. The file is mapped directly and read-only:
    `multiprocessing.shared_memory` would map it writable, and before Python 3.13 hand it to a
    resource tracker that removes it when the reader ends.
    """

    def __init__(self, name: str, *, clock: Clock) -> None:
        """Wait up to START_NS for the segment to appear.

        Raises:
            UserError: the name cannot be one.
            CameraError: it did not appear, or is not in the format.
        """
        self._path = _shm_path(name)
        self._clock = clock
        opened_ns = clock.now_ns()
        while not self._path.exists():
            if clock.now_ns() - opened_ns >= START_NS:
                raise CameraError(_absent(self._path))
            clock.sleep_until_ns(clock.now_ns() + LOOK_AGAIN_NS)
        self._segment = _Segment(self._path)
        self._first_id = 0
        self._seen_id = max(0, self._segment.newest_id() - 1)
        self._dropped_frames = 0
        self._stamp_age_ns: int | None = None
        self._look_again_ns = clock.now_ns() + LOOK_AGAIN_NS
        self._dead_ns = clock.now_ns() + START_NS

    @property
    def dropped_frames(self) -> int:
        """Frames that the writer published between two that were read."""
        return self._dropped_frames

    def read(self, timeout_ns: int) -> Frame | None:
        """See `ports.Camera`. Dead: no fresh frame for STALL_NS (START_NS at first)."""
        deadline_ns = self._clock.now_ns() + timeout_ns
        while True:
            frame = self._take()
            now_ns = self._clock.now_ns()
            if frame is not None:
                self._dead_ns = now_ns + STALL_NS
                self._look_again_ns = now_ns + LOOK_AGAIN_NS
                return frame
            if now_ns >= self._look_again_ns:
                self._look_again_ns = now_ns + LOOK_AGAIN_NS
                self._follow_name()
            if now_ns >= self._dead_ns:
                raise CameraError(self._cause_of_death())
            if now_ns >= deadline_ns:
                return None
            self._clock.sleep_until_ns(min(now_ns + POLL_NS, deadline_ns))

    def close(self) -> None:
        """Unmap the file; it stays, being the writer's."""
        self._segment.close()

    def _take(self) -> Frame | None:
        """The newest frame, if it is new, whole and fresh."""
        for _ in range(MAX_LAPS):
            newest_id = self._segment.newest_id()
            if newest_id <= self._seen_id:
                return None
            copied = self._segment.copy(newest_id)
            if copied is not None:
                break
        else:
            return None
        captured_ns, rgb = copied
        skipped = newest_id - self._seen_id - 1
        self._seen_id = newest_id
        self._stamp_age_ns = self._clock.now_ns() - captured_ns
        if abs(self._stamp_age_ns) > STALL_NS:
            return None
        self._dropped_frames += skipped
        return Frame(frame_id=self._first_id + newest_id, captured_ns=captured_ns, rgb=rgb)

    def _follow_name(self) -> None:
        """Map the file that has the name now, if it is another one. Frame ids go on counting."""
        try:
            status = self._path.stat()
        except FileNotFoundError:
            return
        if self._segment.is_same(status):
            return
        replaced, self._segment = self._segment, _Segment(self._path)
        replaced.close()
        self._first_id += self._seen_id
        self._seen_id = max(0, self._segment.newest_id() - 1)

    def _cause_of_death(self) -> str:
        spec = f"shm:{self._path.name}"
        if self._segment.is_closed():
            return f"{spec}: the writer has closed it, and no other has come: start it again"
        if self._stamp_age_ns is not None and abs(self._stamp_age_ns) > STALL_NS:
            return (
                f"{spec}: the newest frame is stamped {self._stamp_age_ns / NS_PER_S:.1f} s ago: "
                "its writer has died, or does not stamp on CLOCK_MONOTONIC"
            )
        return f"{spec}: no new frame for {STALL_NS / NS_PER_S:g} s: is its writer still running?"


class _Segment:
    """One mapped file, checked against the format."""

    def __init__(self, path: Path) -> None:
        try:
            with path.open("rb") as file:
                status = os.fstat(file.fileno())
                width, height = _checked_size(path.name, file.read(HEADER.size), status.st_size)
                self._map = mmap.mmap(file.fileno(), status.st_size, access=mmap.ACCESS_READ)
        except OSError as error:
            raise CameraError(f"shm:{path.name}: cannot be opened: {error}") from error
        self._identity = (status.st_dev, status.st_ino)
        self._barrier = threading.Lock()
        self._header = np.frombuffer(self._map, np.int64, HEADER_BYTES // 8)
        stride = _stride(width, height)
        starts = [HEADER_BYTES + k * stride for k in range(SLOTS)]
        self._fields = [np.frombuffer(self._map, np.int64, 4, start) for start in starts]
        size = width * height * CHANNELS
        self._pixels = [
            np.frombuffer(self._map, np.uint8, size, start + SLOT_HEADER_BYTES).reshape(
                height, width, CHANNELS
            )
            for start in starts
        ]

    def newest_id(self) -> int:
        """Newest frame; 0 = none yet."""
        newest_id = int(self._header[NEWEST])
        self._in_order()
        return newest_id

    def copy(self, frame_id: int) -> tuple[int, ImageArray] | None:
        """captured_ns and pixels of a frame; None if the writer was at its slot meanwhile."""
        fields = self._fields[frame_id % SLOTS]
        seq = int(fields[SEQ])
        self._in_order()
        if seq % 2 or fields[FRAME_ID] != frame_id:
            return None
        captured_ns = int(fields[CAPTURED_NS])
        rgb = self._pixels[frame_id % SLOTS].copy()
        self._in_order()
        if fields[SEQ] != seq or fields[FRAME_ID] != frame_id:
            return None
        rgb.flags.writeable = False
        return captured_ns, rgb

    def is_closed(self) -> bool:
        """Whether the writer has said that it ended."""
        return bool(self._header[STATE] == CLOSED)

    def is_same(self, status: os.stat_result) -> bool:
        """Whether this is the file that the status is of."""
        return (status.st_dev, status.st_ino) == self._identity

    def close(self) -> None:
        """Unmap; the views on the map have to go first."""
        self._fields, self._pixels = [], []
        self._header = np.array([0, 0, 0, 0, CLOSED], np.int64)
        self._map.close()

    def _in_order(self) -> None:
        """Memory barrier: the loads before it happen before those after it.

        Python has none by name; taking and freeing a lock is one on every platform (POSIX 4.12).
        """
        with self._barrier:
            pass


def _shm_path(name: str) -> Path:
    if not name or "/" in name or name.startswith("."):
        raise UserError(f"shm:{name}: want a name such as shm:fpv, without '/' or a leading '.'")
    folder = Path("/dev/shm")  # noqa: S108 - the system's place for shared memory
    return (folder if folder.is_dir() else Path(tempfile.gettempdir())) / name


def _stride(width: int, height: int) -> int:
    return -(-(SLOT_HEADER_BYTES + width * height * CHANNELS) // 64) * 64


def _checked_size(name: str, header: bytes, file_bytes: int) -> tuple[int, int]:
    """Width and height, if the header is one and the file as long as it says."""
    if len(header) < HEADER.size or not header.startswith(MAGIC):
        raise CameraError(f"shm:{name}: not a frame segment (docs/shm_camera.md): wrong magic")
    _, width, height, channels, slots = HEADER.unpack(header)
    if (channels, slots) != (CHANNELS, SLOTS):
        raise CameraError(
            f"shm:{name}: has {channels} channels and {slots} slots, want {CHANNELS} and {SLOTS}"
        )
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise CameraError(f"shm:{name}: impossible frame size {width}x{height}")
    want_bytes = HEADER_BYTES + SLOTS * _stride(width, height)
    if file_bytes != want_bytes:
        raise CameraError(
            f"shm:{name}: {width}x{height} frames take {want_bytes} bytes, it has {file_bytes}"
        )
    return width, height


def _absent(path: Path) -> str:
    others = [other.name for other in sorted(path.parent.iterdir()) if _is_segment(other)]
    return (
        f"shm:{path.name}: did not appear within {START_NS / NS_PER_S:g} s. Start its writer, "
        f"for example: python -m sitl --camera shm:{path.name} "
        f"(frame segments here now: {', '.join(others) or 'none'})"
    )


def _is_segment(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False
