"""Window or whole screen as a camera, for simulators without another video output."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

import cv2
import mss
import numpy as np
from mss.exception import ScreenShotError
from Xlib import X
from Xlib.display import Display
from Xlib.error import ConnectionClosedError, DisplayError, XError
from Xlib.xobject.drawable import Window as XlibWindow

from mavbridge.camera.grabber import wait_until_due
from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import CameraError, MavbridgeError, UserError
from mavbridge.core.records import Frame

INTERVAL_NS = NS_PER_S // 60
"""Shortest capture interval: screens change no faster, and a capture takes milliseconds."""


class Window(NamedTuple):
    """Visible window with a title."""

    id: int
    title: str


class X11Screen:
    """Connection to the display named by DISPLAY; used by one thread at a time."""

    def __init__(self) -> None:
        """Connect. Raises CameraError if there is no X server."""
        try:
            self._display = Display()
        except (DisplayError, OSError) as error:
            raise CameraError(
                f"cannot search for windows without an X11 display: {error}; is DISPLAY set?"
            ) from error
        self._screen = self._display.screen()
        self._root = self._screen.root
        self._title_atoms = [*map(self._display.intern_atom, ("_NET_WM_NAME", "WM_NAME"))]

    def windows(self) -> list[Window]:
        """Return visible windows with a title, bottom to top, each before the windows inside it."""
        return list(self._titled(self._root))

    def _titled(self, parent: XlibWindow) -> Iterator[Window]:
        try:
            children = parent.query_tree().children
        except XError:
            return  # closed in the meantime
        for child in children:
            try:
                titles = (child.get_full_text_property(atom) for atom in self._title_atoms)
                title = next(filter(None, titles), "")
                if title and child.get_attributes().map_state == X.IsViewable:
                    yield Window(child.id, title)
            except XError:
                continue
            yield from self._titled(child)

    def region(self, window_id: int) -> dict[str, int] | None:
        """Return the on-screen part of the window for mss; None if it is closed or hidden."""
        window = self._display.create_resource_object("window", window_id)
        try:
            size = window.get_geometry()
            origin = self._root.translate_coords(window, 0, 0)
            is_viewable = window.get_attributes().map_state == X.IsViewable
        except XError:
            return None
        except ConnectionClosedError as error:
            raise CameraError(f"the X server has closed the connection: {error}") from error
        left, top = max(origin.x, 0), max(origin.y, 0)
        right = min(origin.x + size.width, self._screen.width_in_pixels)
        bottom = min(origin.y + size.height, self._screen.height_in_pixels)
        if not is_viewable or right <= left or bottom <= top:
            return None
        return {"left": left, "top": top, "width": right - left, "height": bottom - top}

    def close(self) -> None:
        """Disconnect; may be called twice."""
        with suppress(ConnectionClosedError):
            self._display.close()


class ScreenCamera:
    """Camera that captures the screen area of a window, overlapping windows included.

    It captures in ``read``: a frame is as old as the capture takes, and no frame is ever dropped.
    The window may be moved and resized.
    """

    dropped_frames = 0

    def __init__(self, title: str, *, clock: Clock, latency_ns: int = 0) -> None:
        """Find the window; an empty title selects the whole screen.

        ``latency_ns``: time from the exposure of a picture until it is shown.

        Raises:
            UserError: no window has this title, or several do.
            CameraError: there is no screen.
        """
        self._clock = clock
        self._title = title
        self._latency_ns = latency_ns
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
        """See `mavbridge.core.records.Camera`; at most 60 frames per second."""
        if not wait_until_due(self._clock, self._due_ns, timeout_ns):
            return None
        captured_ns = self._clock.now_ns()
        region: dict[str, int] | None = self._screen.monitors[0]  # everything
        if self._windows is not None:
            region = self._windows.region(self._window.id)
        if region is None:
            raise CameraError(
                f"the window {self._title!r} has been closed, hidden or moved off the screen"
            )
        try:
            bgra = np.asarray(self._screen.grab(region))
        except ScreenShotError as error:
            raise CameraError(f"the screen cannot be captured: {error}") from error
        rgb = np.asarray(cv2.cvtColor(bgra, cv2.COLOR_BGRA2RGB), dtype=np.uint8)
        rgb.flags.writeable = False
        self._frame_count += 1
        self._due_ns = captured_ns + INTERVAL_NS
        exposed_ns = captured_ns - self._latency_ns
        return Frame(frame_id=self._frame_count, captured_ns=exposed_ns, rgb=rgb)

    def close(self) -> None:
        """Disconnect from the display."""
        self._screen.close()
        if self._windows is not None:
            self._windows.close()


def choose_window(windows: Sequence[Window], title: str) -> Window:
    """Return the window with this title, else the only one whose title contains it in any case.

    Window managers may give a frame the title of the window inside it. Among equal titles the last
    window is chosen: the innermost, topmost one. Raises UserError for no or several matches.
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
