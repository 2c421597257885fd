"""A window, or the whole screen, as a camera: for simulators that offer no other video."""

from collections.abc import Sequence

import cv2
import mss
import numpy as np
from mss.exception import ScreenShotError

from mavbridge.camera.deadlines import wait_until_due
from mavbridge.camera.x11 import Region, Window, X11Screen
from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import CameraError, MavbridgeError, UserError
from mavbridge.core.records import Frame

INTERVAL_NS = NS_PER_S // 60
"""Screens change no faster, and a capture takes milliseconds."""


class ScreenCamera:
    """Captures the area of the screen that a window covers, including whatever overlaps it.

    Captures in ``read``, so a frame is as old as the capture takes, and none is ever dropped. The
    window may be moved and resized.
    """

    dropped_frames = 0

    def __init__(self, title: str, *, clock: Clock) -> None:
        """Find the window; an empty title stands for the whole screen.

        Raises:
            UserError: no window has this title, or several do.
            CameraError: there is no screen.
        """
        self._clock = clock
        self._title = title
        self._windows: X11Screen | None = None
        try:
            self._screen = mss.MSS()
        except ScreenShotError as error:
            raise CameraError(f"there is no screen to capture: {error}; is DISPLAY set?") from error
        if title:
            try:
                self._windows = X11Screen()
                self._window = choose_window(self._windows.windows(), title)
            except MavbridgeError:
                self.close()
                raise
        self._frame_count = 0
        self._due_ns = clock.now_ns()

    def read(self, timeout_ns: int) -> Frame | None:
        """See `mavbridge.core.ports.Camera`; at most 60 frames a second."""
        if not wait_until_due(self._clock, self._due_ns, timeout_ns):
            return None
        captured_ns = self._clock.now_ns()
        if self._windows is None:
            everything = self._screen.monitors[0]
            region = Region(**{side: everything[side] for side in Region._fields})
        elif (found := self._windows.region(self._window.id)) is not None:
            region = found
        else:
            raise CameraError(
                f"the window {self._title!r} has been closed, hidden or moved off the screen"
            )
        try:
            bgra = np.asarray(self._screen.grab(region._asdict()))
        except ScreenShotError as error:
            raise CameraError(f"the screen cannot be captured: {error}") from error
        rgb = np.asarray(cv2.cvtColor(bgra, cv2.COLOR_BGRA2RGB), dtype=np.uint8)
        rgb.flags.writeable = False
        self._frame_count += 1
        self._due_ns = captured_ns + INTERVAL_NS
        return Frame(frame_id=self._frame_count, captured_ns=captured_ns, rgb=rgb)

    def close(self) -> None:
        """Disconnect from the display."""
        self._screen.close()
        if self._windows is not None:
            self._windows.close()


def choose_window(windows: Sequence[Window], title: str) -> Window:
    """The window with this title, or else the only one whose title contains it in any case.

    Window managers may give a frame the title of the window inside it, so of equal titles the last
    is chosen: the innermost, topmost one. Raises UserError if there is none, or are several.
    """
    exact = [window for window in windows if window.title == title]
    similar = [window for window in windows if title.casefold() in window.title.casefold()]
    matches = exact or similar
    if len({window.title for window in matches}) == 1:
        return matches[-1]
    problem = "several windows have" if matches else "no window has"
    titles = sorted({window.title for window in matches or windows})
    listing = ", ".join(map(repr, titles)) or "none with a title"
    raise UserError(f"--camera screen: {problem} {title!r} in the title; there are: {listing}")
