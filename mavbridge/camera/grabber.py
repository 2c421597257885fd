"""Timeouts of live sources, and the thread that keeps a blocking source drained."""

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import CameraError
from mavbridge.core.records import CameraImage, Frame

REOPENED_NS = 10 * NS_PER_S
"""Limit for the first frame of a reopened source: exposure control, negotiation."""
STALL_NS = 2 * NS_PER_S
"""Limit for all other frames."""
MAX_FIRST_AGE_NS = NS_PER_S
"""Age up to which a stamp shows that its source stamps on our clock."""
REOPEN_DELAYS_S = (0.5, 1.0, 2.0, 4.0)
JOIN_S = 3.0

_log = logging.getLogger(__name__)


def wait_until_due(clock: Clock, due_ns: int, timeout_ns: int) -> bool:
    """Sleep until ``due_ns``, at most for the timeout. Return True if ``due_ns`` was reached."""
    deadline_ns = clock.now_ns() + timeout_ns
    clock.sleep_until_ns(min(due_ns, deadline_ns))
    return due_ns <= deadline_ns


class Image(NamedTuple):
    """Image of one frame, with its arrival."""

    arrived_ns: int
    rgb: CameraImage
    """Owned by the receiver."""
    stamp_ns: int = 0
    """Stamp of the source, by an unknown clock; 0 if there is none."""


@dataclass(slots=True)
class ExposureClock:
    """Clock of one open source's stamps: ours from the first plausible stamp on.

    Later stamps are then exposures at any age, so that an old image cannot pass for a new one.
    """

    is_ours: bool = False
    latency_ns: int = 0
    """Time from exposure to arrival, as given by the user."""

    def exposure_ns(self, stamp_ns: int, arrived_ns: int) -> int:
        """Return the stamp if the source stamps on our clock, else the arrival less the latency.

        A stamp within the latency is no exposure: drivers may stamp the start of the transfer.
        """
        is_stamp = stamp_ns > 0
        is_recent = 0 <= arrived_ns - stamp_ns <= MAX_FIRST_AGE_NS
        self.is_ours = self.is_ours or (is_stamp and is_recent)
        latest_ns = arrived_ns - self.latency_ns
        is_exposure = is_stamp and not latest_ns < stamp_ns <= arrived_ns
        return stamp_ns if self.is_ours and is_exposure else latest_ns


class ImageSource(Protocol):
    """Open blocking source, used only by the grabber's thread."""

    def next_image(self) -> Image | None:
        """Wait for the next frame, for seconds at most; None: not yet.

        Raises CameraError if there will be none.
        """

    def close(self) -> None:
        """Free the device or connection."""


class Grabber:
    """`Camera` over a blocking source, which its thread opens, reads and closes.

    Before the first frame, opening is retried until ``close``. A source that fails later is
    reopened, up to ``len(reopen_delays_s)`` times in a row; meanwhile ``read`` returns None.
    ``read`` raises if all these attempts delivered no frame, if the source is open but silent for
    STALL_NS (REOPENED_NS after it was reopened), or if the thread failed by anything but a
    CameraError.
    """

    def __init__(
        self,
        open_source: Callable[[], ImageSource],
        *,
        clock: Clock,
        latency_ns: int = 0,
        reopen_delays_s: Sequence[float] = REOPEN_DELAYS_S,
    ) -> None:
        """Start the thread, which opens the source; ``latency_ns``: see ``ExposureClock``."""
        self._open_source = open_source
        self._clock = clock
        self._latency_ns = latency_ns
        self._reopen_delays_s = reopen_delays_s
        self._changed = threading.Condition()
        self._stopping = threading.Event()
        self._newest: Frame | None = None
        self._frame_count = 0
        self.dropped_frames = 0
        """Number of frames replaced by a newer one before they were read."""
        self._failure: CameraError | None = None
        self.waiting_reason = "it is being opened"
        """Known reason why there is no frame yet."""
        self._silent_after_ns: int | None = None
        self._thread = threading.Thread(target=self._run, name="mavbridge-camera", daemon=True)
        self._thread.start()

    def read(self, timeout_ns: int) -> Frame | None:
        """See `mavbridge.core.records.Camera`."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._newest is not None or self._failure is not None, timeout_ns / NS_PER_S
            )
            frame, self._newest = self._newest, None
            if frame is not None:
                return frame
            if self._failure is not None:
                raise CameraError(str(self._failure)) from self._failure.__cause__
            if self._silent_after_ns is not None and self._clock.now_ns() > self._silent_after_ns:
                raise CameraError("the camera is open but has stopped delivering frames")
            return None

    def close(self) -> None:
        """Stop the thread. A source that blocks longer than JOIN_S is left to the daemon thread."""
        self._stopping.set()
        self._thread.join(JOIN_S)

    def _run(self) -> None:
        try:
            failure = self._serve()
        except Exception as error:  # noqa: BLE001 - ours or a driver's: raised again by read
            failure = CameraError(f"the camera's thread has failed: {error!r}")
            failure.__cause__ = error
        with self._changed:
            self._failure = failure
            self._changed.notify_all()

    def _serve(self) -> CameraError:
        """Open and drain the source until told to stop or until all attempts have failed."""
        delays_s = iter(self._reopen_delays_s)
        while True:
            frames_before = self._frame_count
            try:
                reason = self._drain(self._open())
            except CameraError as error:
                reason = str(error)
            if self._frame_count == 0 or self._frame_count > frames_before:
                delays_s = iter(self._reopen_delays_s)
            self.waiting_reason = reason
            delay_s = next(delays_s, None)
            if delay_s is None:
                attempts = len(self._reopen_delays_s)
                return CameraError(f"{reason}; {attempts} attempts to reopen it have failed")
            if self._frame_count > frames_before and not self._stopping.is_set():
                # A reader sees only that no frame comes.
                _log.warning("%s; the camera is opened again", reason)
            if self._stopping.wait(delay_s):
                return CameraError("the camera has been closed")

    def _open(self) -> ImageSource:
        source = self._open_source()
        self.waiting_reason = "it is open, and has delivered no frame yet"
        if self._frame_count > 0:
            self._silent_after_ns = self._clock.now_ns() + REOPENED_NS
        return source

    def _drain(self, source: ImageSource) -> str:
        """Receive frames until the source ends. Return the reason for the end."""
        stamps = ExposureClock(latency_ns=self._latency_ns)
        try:
            while not self._stopping.is_set():
                if (image := source.next_image()) is None:
                    continue
                captured_ns = stamps.exposure_ns(image.stamp_ns, image.arrived_ns)
                image.rgb.flags.writeable = False
                with self._changed:
                    self._frame_count += 1
                    self.dropped_frames += self._newest is not None
                    self._newest = Frame(
                        frame_id=self._frame_count,
                        captured_ns=captured_ns,
                        rgb=image.rgb,
                        is_stamped=stamps.is_ours,
                    )
                    self._silent_after_ns = self._clock.now_ns() + STALL_NS
                    self._changed.notify_all()
        except CameraError as error:
            return str(error)
        finally:
            with self._changed:  # ``read`` looks at it twice
                self._silent_after_ns = None
            source.close()
        return "closed"
