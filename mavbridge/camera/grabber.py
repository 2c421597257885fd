"""A thread that keeps a blocking source drained, so that whoever reads gets the newest frame."""

import threading
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import CameraError
from mavbridge.core.records import Frame, ImageArray

STALL_NS = 2 * NS_PER_S
FIRST_FRAME_NS = 10 * NS_PER_S
"""Patience with a source that has just been opened: exposure control, stream negotiation."""
REOPEN_DELAYS_S = (0.5, 1.0, 2.0, 4.0)
"""Waits before the attempts to open a lost source again: four, then it is dead."""
JOIN_S = 3.0


class Image(NamedTuple):
    """What a source delivers."""

    captured_ns: int
    rgb: ImageArray
    """[H, W, 3] uint8 RGB, owned by the receiver."""


class Source(Protocol):
    """A blocking source; opened by its constructor, used by the grabber's thread alone."""

    def next_image(self) -> Image:
        """Block until the next frame.

        Raises:
            CameraError: none will come.
        """
        ...

    def close(self) -> None:
        """Free the device or connection."""
        ...


class Grabber:
    """`Camera` over a blocking source.

    A source that fails is opened again, up to ``len(reopen_delays_s)`` times in a row; meanwhile
    ``read`` returns None. It is dead when none of these attempts gave a frame, or when it is open
    and silent for STALL_NS (FIRST_FRAME_NS before its first frame).
    """

    def __init__(
        self,
        open_source: Callable[[], Source],
        *,
        clock: Clock,
        reopen_delays_s: Sequence[float] = REOPEN_DELAYS_S,
    ) -> None:
        """Open the source and start the thread.

        Raises:
            CameraError: it cannot be opened.
        """
        self._open_source = open_source
        self._clock = clock
        self._reopen_delays_s = reopen_delays_s
        self._changed = threading.Condition()
        self._stopping = threading.Event()
        self._newest: Frame | None = None
        self._frame_count = 0
        self._dropped_frames = 0
        self._death: str | None = None
        source = open_source()
        self._silent_after_ns: int | None = clock.now_ns() + FIRST_FRAME_NS
        self._thread = threading.Thread(
            target=self._run, args=(source,), name="mavbridge-camera", daemon=True
        )
        self._thread.start()

    @property
    def dropped_frames(self) -> int:
        """Frames that came and were replaced before anybody read them."""
        with self._changed:
            return self._dropped_frames

    def read(self, timeout_ns: int) -> Frame | None:
        """See `mavbridge.core.ports.Camera`."""
        with self._changed:
            self._changed.wait_for(self._has_news, timeout_ns / NS_PER_S)
            frame, self._newest = self._newest, None
            if frame is not None:
                return frame
            if self._death is not None:
                raise CameraError(self._death)
            if self._silent_after_ns is not None and self._clock.now_ns() > self._silent_after_ns:
                raise CameraError("the camera is open but has stopped delivering frames")
            return None

    def close(self) -> None:
        """Stop the thread; a source that blocks longer than JOIN_S is left to the daemon thread."""
        self._stopping.set()
        self._thread.join(JOIN_S)

    def _has_news(self) -> bool:
        return self._newest is not None or self._death is not None

    def _run(self, source: Source) -> None:
        delays_s = iter(self._reopen_delays_s)
        reason = self._drain(source)
        while not self._stopping.is_set():
            delay_s = next(delays_s, None)
            if delay_s is None:
                self._die(f"{reason}; tried again {len(self._reopen_delays_s)} times, in vain")
                return
            if self._stopping.wait(delay_s):
                return
            frames_before = self._frame_count
            reason = self._open_and_drain()
            if self._frame_count > frames_before:
                delays_s = iter(self._reopen_delays_s)

    def _open_and_drain(self) -> str:
        """Returns why it ended."""
        try:
            source = self._open_source()
        except CameraError as error:
            return str(error)
        self._expect_frames_before(self._clock.now_ns() + FIRST_FRAME_NS)
        return self._drain(source)

    def _drain(self, source: Source) -> str:
        """Offer frame after frame; returns why it ended."""
        try:
            while not self._stopping.is_set():
                self._offer(source.next_image())
        except CameraError as error:
            return str(error)
        finally:
            self._expect_frames_before(None)
            source.close()
        return "closed"

    def _offer(self, image: Image) -> None:
        image.rgb.flags.writeable = False
        with self._changed:
            self._frame_count += 1
            self._dropped_frames += self._newest is not None
            self._newest = Frame(
                frame_id=self._frame_count, captured_ns=image.captured_ns, rgb=image.rgb
            )
            self._silent_after_ns = self._clock.now_ns() + STALL_NS
            self._changed.notify_all()

    def _expect_frames_before(self, silent_after_ns: int | None) -> None:
        with self._changed:
            self._silent_after_ns = silent_after_ns

    def _die(self, reason: str) -> None:
        with self._changed:
            self._death = reason
            self._changed.notify_all()
