"""Reader of frames in shared memory; format: docs/formats.md."""

import mmap
import os
import struct
import tempfile
import threading
from contextlib import suppress
from pathlib import Path

import numpy as np

from mavbridge.camera.grabber import STALL_NS
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import CameraError, UserError
from mavbridge.core.records import CameraImage, Frame
from policy.files import open_regular

MAGIC = b"MBSHM\0\0\1"
HEADER = struct.Struct("<8sIIII")
"""Magic, width, height, channels, slots."""
HEADER_BYTES = 64
SLOT_HEADER_BYTES = 32
PIXELS: dict[int, tuple[str, tuple[int, ...]]] = {3: ("u1", (3,)), 1: ("<u2", ())}
"""Type and axes of a pixel by the number of channels: RGB, and depth."""
SLOTS = 4
MAX_SIDE_PX = 16384
CLOSED = 2
NEWEST, STATE = 3, 4
"""Indices of header fields, in units of 8 bytes."""

POLL_NS = NS_PER_MS
REOPEN_NS = 200 * NS_PER_MS
"""Interval at which a reader without frames checks for a new file under the name."""
MAX_RETRIES = 8
"""Consecutive copies that the writer may overtake before the reader waits for the next poll."""


class SharedMemoryCamera:
    """Camera on a shared memory segment. It polls, because the writer cannot wake a reader.

    The segment may appear later. When another writer takes over the name, the reader follows. After
    the first frame, ``read`` raises CameraError if none has come for STALL_NS.

    The file is mapped directly and read-only: `multiprocessing.shared_memory` would map it
    writable, and before Python 3.13 its resource tracker removes the file when the reader ends.
    """

    def __init__(self, name: str, *, clock: Clock) -> None:
        """Map the segment if it exists already.

        Raises:
            UserError: not a valid name.
            CameraError: it is not in the format.
        """
        if not name or "/" in name or name.startswith("."):
            raise UserError(f"shm:{name}: use a name such as shm:fpv, without '/' or a leading '.'")
        folder = Path("/dev/shm")  # noqa: S108 - the system's place for shared memory
        self._path = (folder if folder.is_dir() else Path(tempfile.gettempdir())) / name
        self._clock = clock
        self.dropped_frames = 0
        self._first_id = 0
        self._seen_id = 0
        self._stamp_age_ns = 0
        self._reopen_ns = clock.now_ns() + REOPEN_NS
        self._dead_ns: int | None = None
        """Time at which the writer counts as dead; None before the first frame."""
        self._segment: _Segment | None = None
        self._follow_name()

    @property
    def waiting_reason(self) -> str:
        """Known reason why there is no frame yet."""
        return _absent(self._path) if self._segment is None else self._failure(self._segment)

    def read(self, timeout_ns: int) -> Frame | None:
        """See `mavbridge.core.records.Camera`."""
        deadline_ns = self._clock.now_ns() + timeout_ns
        while (frame := self._take()) is None:
            now_ns = self._clock.now_ns()
            if now_ns >= self._reopen_ns:
                self._reopen_ns = now_ns + REOPEN_NS
                self._follow_name()
            if self._dead_ns is not None and now_ns >= self._dead_ns:
                raise CameraError(self.waiting_reason)
            if now_ns >= deadline_ns:
                return None
            self._clock.sleep_until_ns(min(now_ns + POLL_NS, deadline_ns))
        now_ns = self._clock.now_ns()
        self._reopen_ns, self._dead_ns = now_ns + REOPEN_NS, now_ns + STALL_NS
        return frame

    def close(self) -> None:
        """Unmap the file; it belongs to the writer and stays."""
        self._segment = None

    def _take(self) -> Frame | None:
        """Return the newest frame if it is new, complete and recent, else None."""
        segment = self._segment
        if segment is None:
            return None
        for _ in range(MAX_RETRIES):
            newest_id = segment.newest_id()
            if newest_id <= self._seen_id:
                return None
            if (copied := segment.copy(newest_id)) is not None:
                break
        else:
            return None
        captured_ns, rgb = copied
        skipped = newest_id - self._seen_id - 1
        self._seen_id = newest_id
        self._stamp_age_ns = self._clock.now_ns() - captured_ns
        # A stamp from the future does not mean a dead writer; in flight the vision loop reports it.
        is_ahead = self._stamp_age_ns < -STALL_NS and self._dead_ns is None
        if is_ahead or self._stamp_age_ns > STALL_NS:
            return None
        self.dropped_frames += skipped
        frame_id = self._first_id + newest_id
        return Frame(frame_id=frame_id, captured_ns=captured_ns, rgb=rgb, is_stamped=True)

    def _follow_name(self) -> None:
        """Map the file under the name if it has changed. Frame ids keep increasing."""
        try:
            status = self._path.stat()
        except FileNotFoundError:
            return
        if self._segment is not None and os.path.samestat(status, self._segment.status):
            return
        self._segment = _Segment(self._path)
        self._first_id += self._seen_id
        self._seen_id = max(0, self._segment.newest_id() - 1)

    def _failure(self, segment: "_Segment") -> str:
        name = f"shm:{self._path.name}"
        if segment.is_closed():
            return f"{name}: the writer has closed it and no other has replaced it: start it again"
        if abs(self._stamp_age_ns) > STALL_NS:
            when = "ago" if self._stamp_age_ns > 0 else "in the future"
            return (
                f"{name}: the newest frame is stamped {abs(self._stamp_age_ns) / NS_PER_S:.1f} s "
                f"{when}: its writer has died, or does not stamp on CLOCK_MONOTONIC"
            )
        if self._dead_ns is None:
            return f"{name}: no frame in it yet"
        return f"{name}: no new frame for {STALL_NS / NS_PER_S:g} s: is its writer still running?"


class _Segment:
    """One mapped file."""

    def __init__(self, path: Path) -> None:
        self._name = path.name
        try:
            with open_regular(path) as file:
                self.status = os.fstat(file.fileno())
                size_bytes = self.status.st_size
                slot = _checked_slot(path.name, file.read(HEADER.size), size_bytes)
                self._map = mmap.mmap(file.fileno(), size_bytes, access=mmap.ACCESS_READ)
        except OSError as error:
            raise CameraError(f"shm:{path.name}: cannot be opened: {error}") from error
        self._header = np.frombuffer(self._map, np.int64, HEADER_BYTES // 8)
        self._slots = np.frombuffer(self._map, slot, SLOTS, HEADER_BYTES)

    def newest_id(self) -> int:
        """Return the newest frame's id; 0 = none yet. Raises CameraError if the file has shrunk."""
        if self._map.size() < len(self._map):
            # Reading beyond the end of the file would end the process (SIGBUS).
            raise CameraError(f"shm:{self._name}: its file has shrunk: start its writer again")
        newest_id = int(self._header[NEWEST])
        memory_barrier()
        return newest_id

    def copy(self, frame_id: int) -> tuple[int, CameraImage] | None:
        """Return captured_ns and pixels of a frame; None if the writer has reused its slot."""
        slot = self._slots[frame_id % SLOTS : frame_id % SLOTS + 1]
        seq = int(slot["seq"][0])
        memory_barrier()
        if seq % 2 or slot["frame_id"][0] != frame_id:
            return None
        captured_ns = int(slot["captured_ns"][0])
        rgb: CameraImage = slot["rgb"][0].copy()
        memory_barrier()
        if slot["seq"][0] != seq or slot["frame_id"][0] != frame_id:
            return None
        rgb.flags.writeable = False
        return captured_ns, rgb

    def is_closed(self) -> bool:
        """True if the writer has ended."""
        return bool(self._header[STATE] == CLOSED)


def memory_barrier() -> None:
    """Order earlier loads before later ones.

    Python has no memory barrier; taking and releasing a lock is one on every platform (POSIX 4.12).
    """
    with threading.Lock():
        pass


def _checked_slot(name: str, header: bytes, file_bytes: int) -> np.dtype[np.void]:
    """Return the layout of a slot from the header, checked against the length of the file."""
    if len(header) < HEADER.size or not header.startswith(MAGIC):
        raise CameraError(f"shm:{name}: not a frame segment (docs/formats.md): wrong magic")
    _, width, height, channels, slots = HEADER.unpack(header)
    if channels not in PIXELS or slots != SLOTS:
        raise CameraError(
            f"shm:{name}: has {channels} channels and {slots} slots, must have 3 (RGB) or 1 "
            f"(depth) and {SLOTS}"
        )
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise CameraError(f"shm:{name}: impossible frame size {width}x{height}")
    kind, axes = PIXELS[channels]
    pixels = np.dtype((kind, (height, width, *axes)))
    slot_bytes = -(-(SLOT_HEADER_BYTES + pixels.itemsize) // 64) * 64
    if file_bytes != HEADER_BYTES + SLOTS * slot_bytes:
        raise CameraError(
            f"shm:{name}: {width}x{height} frames take {HEADER_BYTES + SLOTS * slot_bytes} bytes, "
            f"it has {file_bytes}"
        )
    return np.dtype(
        {
            "names": ["seq", "frame_id", "captured_ns", "rgb"],
            "formats": ["<i8", "<i8", "<i8", pixels],
            "offsets": [0, 8, 16, SLOT_HEADER_BYTES],
            "itemsize": slot_bytes,
        }
    )


def _absent(path: Path) -> str:
    others = []
    for other in sorted(path.parent.iterdir()):
        with suppress(OSError), open_regular(other) as file:
            if file.read(len(MAGIC)) == MAGIC:
                others.append(other.name)
    return (
        f"shm:{path.name}: there is none. Start its writer, for example: "
        f"python -m sitl --connect udpout:127.0.0.1:14550 --camera shm:{path.name} "
        f"(frame segments here now: {', '.join(others) or 'none'})"
    )
