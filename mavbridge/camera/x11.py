"""Titles and positions of the windows on an X11 screen."""

from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

from Xlib import X
from Xlib.display import Display
from Xlib.error import ConnectionClosedError, DisplayError, XError
from Xlib.xobject.drawable import Window as XlibWindow

from mavbridge.core.errors import CameraError


class Region(NamedTuple):
    """A rectangle of the screen in pixels."""

    left: int
    top: int
    width: int
    height: int


class Window(NamedTuple):
    """A visible window with a title."""

    id: int
    title: str


class X11Screen:
    """A connection to the display that DISPLAY names; used by one thread at a time."""

    def __init__(self) -> None:
        """Connect; raises CameraError if there is no X server."""
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
        """Visible windows with a title, bottom to top, a window before those inside it."""
        return list(self._titled(self._root))

    def _titled(self, parent: XlibWindow) -> Iterator[Window]:
        try:
            children = parent.query_tree().children
        except XError:
            return  # closed meanwhile
        for child in children:
            try:
                titles = (child.get_full_text_property(atom) for atom in self._title_atoms)
                title = next(filter(None, titles), "")
                if title and child.get_attributes().map_state == X.IsViewable:
                    yield Window(child.id, title)
            except XError:
                continue
            yield from self._titled(child)

    def region(self, window_id: int) -> Region | None:
        """The part of the window that is on the screen; None if it is closed or hidden."""
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
        return Region(left, top, right - left, bottom - top)

    def close(self) -> None:
        """Disconnect; may be called twice."""
        with suppress(ConnectionClosedError):
            self._display.close()
