"""``pipe:COMMAND``: frames from the standard output of a program, such as a CSI camera tool.

    pipe:COMMAND                         MJPEG or PNG
    pipe:WIDTHxHEIGHT:FORMAT:COMMAND     raw pictures; FORMAT by FFmpeg's name, such as rgb24

A grey PNG of 16 bits and the raw format gray16le are depth images.

The command is split by shell rules, and run without a shell.
"""

import os
import re
import select
import shlex
import shutil
import signal
import subprocess
from contextlib import suppress
from typing import NamedTuple

from mavbridge.camera.grabber import Image
from mavbridge.camera.pipe_frames import (
    MAX_SIDE_PX,
    RAW_FORMATS,
    DamageCount,
    FrameCutter,
    PictureCutter,
    RawCutter,
)
from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import CameraError, UserError
from mavbridge.core.processes import user_environment

FORM = "pipe:COMMAND (MJPEG or PNG) or pipe:WIDTHxHEIGHT:FORMAT:COMMAND (raw pictures)"
FIRST_NS, SILENT_NS = 10 * NS_PER_S, 2 * NS_PER_S
"""Longest wait for the first byte, and for each later one."""
END_S = 1.0
"""Time for the program to end by itself before it is killed, and then to end after the kill."""
_END_LOOKS = 100
"""Checks within END_S whether it has ended."""
_POLL_S = 0.1
_READ_BYTES = 1 << 16
"""Capacity of a pipe. A full pipe blocks the program, so no frame in it is old."""
_MOST_READS = 64
"""Limit of reads at a time, in case the program is faster than this computer."""
_MAX_ERROR_BYTES = 2000
_RAW = re.compile(r"(\d{1,5})x(\d{1,5}):([a-z0-9]+):(.*)", re.DOTALL)


class PipeCommand(NamedTuple):
    """Program and the format of its output."""

    words: tuple[str, ...]
    raw: tuple[int, int, str] | None
    """Width, height and format; None: MJPEG or PNG."""

    def cutter(self) -> FrameCutter:
        """Return a new cutter for its output."""
        if self.raw is None:
            return PictureCutter()
        width, height, name = self.raw
        return RawCutter(width, height, RAW_FORMATS[name])


def parse_pipe(text: str) -> PipeCommand:
    """Parse the text after ``pipe:``.

    Raises:
        UserError: it is malformed, or there is no such program.
    """
    spec, raw = f"--camera {f'pipe:{text}'!r}", None
    if (match := _RAW.fullmatch(text)) is not None:
        width, height, name, text = int(match[1]), int(match[2]), match[3], match[4]
        if name not in RAW_FORMATS:
            known = ", ".join(RAW_FORMATS)
            raise UserError(f"{spec}: {name!r} is no format of raw pictures; there are {known}")
        if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
            raise UserError(f"{spec}: no picture has {width}x{height} pixels")
        is_halved = RAW_FORMATS[name].bits in (12, 16) and not RAW_FORMATS[name].is_depth
        if is_halved and (width % 2 or height % 2):
            raise UserError(f"{spec}: pictures in {name} have an even width and height")
        raw = (width, height, name)
    try:
        words = tuple(shlex.split(text))
    except ValueError as error:
        raise UserError(f"{spec}: {error}") from error
    if not words:
        raise UserError(f"{spec} names no program; use {FORM}")
    if shutil.which(words[0]) is None:
        raise UserError(f"{spec}: there is no program {words[0]!r}; use {FORM}")
    return PipeCommand(words, raw)


class PipeSource:
    """`ImageSource` over a program; returns the newest whole frame.

    The program runs in a separate session, so that Ctrl-C ends the flight but not the camera.
    """

    def __init__(self, command: PipeCommand, *, clock: Clock) -> None:
        """Start the program. Raises CameraError on failure."""
        self._name = f"program {command.words[0]}"
        self._clock = clock
        self._cutter = command.cutter()
        self._errors = b""
        self._damage = DamageCount(self._name)
        self._silent_after_ns = clock.now_ns() + FIRST_NS
        try:
            self._process = subprocess.Popen(
                command.words,
                env=user_environment(),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
                start_new_session=True,
            )
        except OSError as error:
            raise CameraError(f"{self._name} cannot be started: {error.strerror}") from error
        out, err = self._process.stdout, self._process.stderr
        if out is None or err is None:
            raise AssertionError("both are pipes")
        self._out, self._err = out.fileno(), err.fileno()
        self._open = [self._out, self._err]

    def next_image(self) -> Image | None:
        """See `ImageSource`."""
        for number in range(_MOST_READS):  # a pipe with a whole frame may hold a newer one
            ready = select.select(self._open, [], [], 0.0 if number else _POLL_S)[0]
            if not ready:
                break
            if self._err in ready:
                self._read_error()
            if self._out in ready:
                self._read_frames()
        if (newest := self._cutter.take()) is None:
            if self._clock.now_ns() > self._silent_after_ns:
                raise CameraError(f"{self._name} is silent{self._last_error()}")
            return None
        frame, first_ns = newest
        rgb = self._cutter.decode(frame)
        self._damage.note(rgb)
        return None if rgb is None else Image(first_ns, rgb)

    def _read_frames(self) -> None:
        data = os.read(self._out, _READ_BYTES)
        now_ns = self._clock.now_ns()
        if not data:
            raise CameraError(self._end_of_stream())
        self._silent_after_ns = now_ns + SILENT_NS
        try:
            self._cutter.put(data, now_ns)
        except CameraError as error:
            raise CameraError(f"{self._name}: {error}{self._last_error()}") from error

    def _read_error(self) -> None:
        data = os.read(self._err, _READ_BYTES)
        if not data:
            self._open.remove(self._err)
        self._errors = (self._errors + data)[-_MAX_ERROR_BYTES:]

    def _last_error(self) -> str:
        lines = self._errors.decode(errors="replace").strip().splitlines()
        return f"; it said: {lines[-1].strip()}" if lines else ""

    def _end_of_stream(self) -> str:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(END_S)
        while self._err in self._open and select.select([self._err], [], [], 0)[0]:
            self._read_error()
        status = self._process.returncode
        how = "has closed its output" if status is None else f"ended with status {status}"
        return f"{self._name} {how}{self._cutter.rest()}{self._last_error()}"

    def close(self) -> None:
        """End the program and its children, and wait for it."""
        with suppress(ProcessLookupError, PermissionError):  # when no process of the group is left
            for number in (signal.SIGTERM, *[0] * _END_LOOKS, signal.SIGKILL):
                os.killpg(self._process.pid, number)
                look_ns = self._clock.now_ns() + round(END_S * NS_PER_S / _END_LOOKS)
                self._clock.sleep_until_ns(look_ns)
                self._process.poll()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(END_S)
        for stream in (self._process.stdout, self._process.stderr):
            if stream is not None:
                stream.close()
