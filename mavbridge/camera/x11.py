"""Titles and places of the windows on an X11 screen, through libxcb (which mss needs as well).

Replies are read as the bytes of the X11 protocol: a header of 32 bytes whose second word is the
number of 4-byte words after it. A request that fails, say for a window that has gone, has none.
"""

import ctypes
import ctypes.util
import struct
from collections.abc import Iterator
from typing import NamedTuple

from mavbridge.core.errors import CameraError

HEADER_BYTES = 32
LENGTH_AT = 4
MAP_STATE_AT = 26
VIEWABLE = 2
ANY_TYPE = 0
TITLE_WORDS = 256


class Region(NamedTuple):
    """A rectangle of the screen in pixels."""

    left: int
    top: int
    width: int
    height: int


class Window(NamedTuple):
    """A window that is on the screen and has a title."""

    id: int
    title: str


class X11Screen:
    """A connection to the display that DISPLAY names; used by one thread at a time."""

    def __init__(self) -> None:
        """Connect.

        Raises:
            CameraError: no libxcb, or no X server.
        """
        self._xcb = _load_xcb()
        self._free = ctypes.CDLL(None).free
        self._free.argtypes = [ctypes.c_void_p]
        self._connection: int | None = self._xcb.xcb_connect(None, None)
        if self._xcb.xcb_connection_has_error(self._connection):
            self.close()
            raise CameraError("no X11 display to look for windows on: is DISPLAY set?")
        setup = self._xcb.xcb_get_setup(self._connection)
        screen = ctypes.string_at(self._xcb.xcb_setup_roots_iterator(setup).data, 24)
        self._root: int
        self._root, self._width, self._height = struct.unpack("=I16xHH", screen)
        self._title_atoms = (self._atom(b"_NET_WM_NAME"), self._atom(b"WM_NAME"))

    def windows(self) -> list[Window]:
        """Windows with a title, bottom to top, a window before those inside it."""
        return [
            Window(window, title)
            for window in self._descendants(self._root)
            if (title := self._title(window)) and self._is_viewable(window)
        ]

    def region(self, window: int) -> Region | None:
        """Where the part of the window lies that is on the screen; None = gone or hidden."""
        geometry = self._reply("get_geometry", window)
        origin = self._reply("translate_coordinates", window, self._root, 0, 0)
        if geometry is None or origin is None or not self._is_viewable(window):
            return None
        width, height = struct.unpack_from("=HH", geometry, 16)
        left, top = struct.unpack_from("=hh", origin, 12)
        right, bottom = min(left + width, self._width), min(top + height, self._height)
        left, top = max(left, 0), max(top, 0)
        if right <= left or bottom <= top:
            return None
        return Region(left, top, right - left, bottom - top)

    def close(self) -> None:
        """Disconnect; may be called twice."""
        if self._connection is not None:
            self._xcb.xcb_disconnect(self._connection)
            self._connection = None

    def _descendants(self, window: int) -> Iterator[int]:
        tree = self._reply("query_tree", window)
        if tree is None:
            return
        (count,) = struct.unpack_from("=H", tree, 16)
        for child in struct.unpack_from(f"={count}I", tree, HEADER_BYTES):
            yield child
            yield from self._descendants(child)

    def _is_viewable(self, window: int) -> bool:
        attributes = self._reply("get_window_attributes", window)
        return attributes is not None and attributes[MAP_STATE_AT] == VIEWABLE

    def _title(self, window: int) -> str:
        for atom in self._title_atoms:
            reply = self._reply("get_property", 0, window, atom, ANY_TYPE, 0, TITLE_WORDS)
            if reply is None:
                continue
            (length,) = struct.unpack_from("=I", reply, 16)
            if length:
                return reply[HEADER_BYTES : HEADER_BYTES + length].decode(errors="replace")
        return ""

    def _atom(self, name: bytes) -> int:
        reply = self._reply("intern_atom", 0, len(name), name)
        return 0 if reply is None else int(struct.unpack_from("=I", reply, 8)[0])

    def _reply(self, request: str, *arguments: int | bytes) -> bytes | None:
        """Send a request, wait for its reply; None if the server answers with an error."""
        cookie = getattr(self._xcb, f"xcb_{request}")(self._connection, *arguments)
        wait = getattr(self._xcb, f"xcb_{request}_reply")
        pointer = wait(self._connection, cookie, None)
        if not pointer:
            return None
        (words,) = struct.unpack_from("=I", ctypes.string_at(pointer, HEADER_BYTES), LENGTH_AT)
        reply = ctypes.string_at(pointer, HEADER_BYTES + 4 * words)
        self._free(pointer)
        return reply


class _Cookie(ctypes.Structure):
    _fields_ = (("sequence", ctypes.c_uint),)


class _ScreenIterator(ctypes.Structure):
    _fields_ = (("data", ctypes.c_void_p), ("rem", ctypes.c_int), ("index", ctypes.c_int))


def _load_xcb() -> ctypes.CDLL:
    """libxcb with the signatures of the calls that are used here (xproto.h)."""
    path = ctypes.util.find_library("xcb")
    if path is None:
        raise CameraError("windows can be found by title on X11 only, and libxcb is not here")
    xcb = ctypes.CDLL(path)
    xcb.xcb_connect.argtypes = [ctypes.c_char_p, ctypes.POINTER(ctypes.c_int)]
    xcb.xcb_connect.restype = ctypes.c_void_p
    xcb.xcb_connection_has_error.argtypes = [ctypes.c_void_p]
    xcb.xcb_disconnect.argtypes = [ctypes.c_void_p]
    xcb.xcb_disconnect.restype = None
    xcb.xcb_get_setup.argtypes = [ctypes.c_void_p]
    xcb.xcb_get_setup.restype = ctypes.c_void_p
    xcb.xcb_setup_roots_iterator.argtypes = [ctypes.c_void_p]
    xcb.xcb_setup_roots_iterator.restype = _ScreenIterator
    u8, u16, u32, i16 = ctypes.c_uint8, ctypes.c_uint16, ctypes.c_uint32, ctypes.c_int16
    requests: dict[str, tuple[type, ...]] = {
        "query_tree": (u32,),
        "get_geometry": (u32,),
        "get_window_attributes": (u32,),
        "translate_coordinates": (u32, u32, i16, i16),
        "get_property": (u8, u32, u32, u32, u32, u32),
        "intern_atom": (u8, u16, ctypes.c_char_p),
    }
    for name, arguments in requests.items():
        send, wait = getattr(xcb, f"xcb_{name}"), getattr(xcb, f"xcb_{name}_reply")
        send.argtypes, send.restype = [ctypes.c_void_p, *arguments], _Cookie
        wait.argtypes = [ctypes.c_void_p, _Cookie, ctypes.c_void_p]
        wait.restype = ctypes.c_void_p
    return xcb
