"""Opening of the camera named by ``--camera``."""

import logging
import stat
import sys
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from mavbridge.camera.capture import VideoFileCamera, open_device, open_stream, present_devices
from mavbridge.camera.grabber import Grabber, ImageSource, wait_until_due
from mavbridge.camera.jpeg_udp import JpegUdpSource, parse_jpeg_udp
from mavbridge.camera.pipe import PipeSource, parse_pipe
from mavbridge.camera.shared_memory import SharedMemoryCamera
from mavbridge.config.flight import CameraConfig
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import CameraError, UserError
from mavbridge.core.provenance import without_secrets
from mavbridge.core.records import Camera, CameraImage, Frame
from policy.contract import Contract
from policy.errors import require_packages

_log = logging.getLogger(__name__)
STREAM_SCHEMES = ("rtsp://", "rtp://", "udp://", "tcp://", "http://", "https://")
SCREEN_PACKAGES = ("mss", "Xlib")
"""Modules of the extra "screen"."""
NO_CAMERA = "none"
BLANK_NS = NS_PER_S // 30
"""Period of the black frames for ``none``."""
FORMS = (
    "a device (0, /dev/video0, /dev/v4l/by-id/NAME), a stream (rtsp://, rtp://, udp://, tcp://, "
    "http://, https://, an .sdp file), "
    "a video file, shm:NAME, screen:WINDOW TITLE (screen: alone = the whole screen), pipe:COMMAND "
    "(MJPEG from a program), jpeg-udp:[HOST:]PORT (a simulator's chunks of JPEG), or none for a "
    "policy that looks at no image"
)


def check_camera(spec: str, *, latency_ms: float = 0.0) -> None:
    """Raise UserError if a source cannot be opened, as far as known without opening it.

    Raises:
        UserError: ``spec`` has no known form, names no file, needs a package that is missing,
            or stamps its frames itself and ``latency_ms`` is not 0.
    """
    kind, _, rest = spec.partition(":")
    mode = _file_mode(spec)
    is_file = stat.S_ISREG(mode) and not _is_stream(spec)
    if latency_ms != 0.0 and (is_file or kind == "shm"):
        raise UserError(
            f"--camera-latency {latency_ms:g} cannot be used with {spec}: its frames come with "
            "stamps of their own; mend those, or leave the flag out"
        )
    if kind == "pipe":
        parse_pipe(rest)
    elif kind == "jpeg-udp":
        parse_jpeg_udp(rest)
    elif kind == "screen":
        require_packages("--camera screen:", *SCREEN_PACKAGES)
    elif not (
        is_file or kind == "shm" or spec == NO_CAMERA or _is_stream(spec) or _is_device(spec)
    ):
        if stat.S_ISFIFO(mode):
            raise UserError(f"--camera {spec!r} is a named pipe: its MJPEG is 'pipe:cat {spec}'")
        lack = "a folder" if spec and stat.S_ISDIR(mode) else "no such file"
        raise UserError(f"--camera {spec!r}: {lack}, and not a known source; use {FORMS}")


def require_present(spec: str) -> None:
    """Raise CameraError if a local camera is not plugged in; cheap, for use before slow loading.

    Raises:
        CameraError: there is no such device.
    """
    device = Path(f"/dev/video{spec}" if spec.isdecimal() else spec)
    if sys.platform == "linux" and _is_device(spec) and not device.exists():
        raise CameraError(f"camera {spec} is not there: {present_devices()}")


def _is_device(spec: str) -> bool:
    """True for a number, a device or a link to one, and anything under /dev but regular files.

    udev's names are links to devices; a dangling link is an unplugged camera.
    """
    mode = _file_mode(spec)
    is_udevs = spec.startswith("/dev/") and not stat.S_ISREG(mode)
    return spec.isdecimal() or is_udevs or stat.S_ISCHR(mode)


def _file_mode(spec: str) -> int:
    """Return the kind of a file, as ``os.stat`` has it; 0 if there is none of this name."""
    try:
        return Path(spec).stat().st_mode
    except PermissionError:
        raise
    except (OSError, ValueError):
        return 0


def _is_stream(spec: str) -> bool:
    return spec.startswith(STREAM_SCHEMES) or (
        spec.lower().endswith(".sdp") and stat.S_ISREG(_file_mode(spec))
    )


def open_cameras(
    config: CameraConfig,
    contract: Contract,
    *,
    image_size: tuple[int, int],
    clock: Clock,
    report: Callable[[str], None],
    stack: ExitStack,
) -> list[Camera]:
    """Open the cameras of a flight, in the contract's order; see ``open_camera``. ``stack`` closes
    them."""
    cameras: list[Camera] = []
    for source in config.sources_of(contract.cameras):
        camera = open_camera(
            source,
            image_size=image_size,
            clock=clock,
            timeout_s=config.camera_timeout,
            latency_ms=config.camera_latency,
            report=report,
            is_depth=contract.is_depth,
        )
        stack.callback(camera.close)
        _log.debug("camera %s is open", without_secrets(source))
        cameras.append(camera)
    return cameras


def open_camera(
    spec: str,
    *,
    image_size: tuple[int, int],
    clock: Clock,
    timeout_s: float = 10.0,
    latency_ms: float = 0.0,
    report: Callable[[str], None] = lambda _: None,
    is_depth: bool | None = None,
) -> Camera:
    """Open the source named by ``spec``, and wait for its first frame, which is dropped.

    Files and screens need no wait: a file plays from the first ``read`` on.

    Args:
        spec: one of FORMS.
        image_size: least height and width [pixels]. A device is asked for a mode that covers
            them; all other sources deliver their own size.
        clock: time of the waits, and of the stamps made here.
        timeout_s: longest wait for the first frame; meanwhile a device or stream that cannot be
            opened is retried, and shared memory may appear.
        latency_ms: time from exposure to arrival; see `ExposureClock`.
        report: gets a line of a countdown for every second of the wait.
        is_depth: True: the policy takes depth; False: RGB; None: either.

    Raises:
        UserError: as ``check_camera``, or the images are of the other kind.
        CameraError: no frame came in time, or the source cannot be used.
    """
    check_camera(spec, latency_ms=latency_ms)
    # OpenCV would print its own complaint about a camera before, and instead of, ours.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    latency_ns = round(latency_ms * NS_PER_MS)
    camera = _open(spec, image_size, clock=clock, latency_ns=latency_ns, is_depth=is_depth)
    first: CameraImage | None = None
    try:
        if isinstance(camera, VideoFileCamera) and camera.upcoming is not None:
            first = camera.upcoming.rgb
        if isinstance(camera, Grabber | SharedMemoryCamera):
            frame = _wait_for_first_frame(camera, clock=clock, timeout_s=timeout_s, report=report)
            first = frame.rgb
        if spec != NO_CAMERA:
            _require_kind(spec, first, is_depth)
    except BaseException:
        camera.close()
        raise
    return camera


def _wait_for_first_frame(
    camera: Grabber | SharedMemoryCamera,
    *,
    clock: Clock,
    timeout_s: float,
    report: Callable[[str], None],
) -> Frame:
    """Return the first frame. Every second until then, ``report`` gets a line of a countdown.

    The line contains the reason for the wait when it changes. Raises CameraError if no frame comes
    in time, or as ``read`` does.
    """
    deadline_ns = clock.now_ns() + round(timeout_s * NS_PER_S)
    told: str | None = None
    while (left_ns := deadline_ns - clock.now_ns()) > 0:
        if (frame := camera.read(left_ns % NS_PER_S or NS_PER_S)) is not None:
            return frame
        left_s = round((deadline_ns - clock.now_ns()) / NS_PER_S)
        if left_s > 0:
            reason = camera.waiting_reason
            report(
                f"waiting for the camera: {left_s} s left{'' if told == reason else f' ({reason})'}"
            )
            told = reason
    raise CameraError(
        f"the camera has delivered no frame within {timeout_s:g} s (link.camera_timeout): "
        f"{camera.waiting_reason}"
    )


def _require_kind(spec: str, first: CameraImage | None, is_depth: bool | None) -> None:
    """Raise UserError for depth instead of RGB, or the reverse; without ``first``, assume RGB."""
    shape = (0, 0, 3) if first is None else first.shape
    if is_depth is None or is_depth == (len(shape) == 2):
        return
    size = "" if first is None else f" of {shape[1]}x{shape[0]}"
    found, wanted = (f"RGB images{size}", "depth") if is_depth else (f"depth{size}", "RGB images")
    advice = (
        "16-bit depth, such as pipe:640x480:gray16le:COMMAND" if is_depth else "a colour camera"
    )
    raise UserError(
        f"--camera {without_secrets(spec)} delivers {found}, and the policy's contract takes "
        f"{wanted} (image_channels): name {advice}, or mend the contract"
    )


def _open(
    spec: str, size: tuple[int, int], *, clock: Clock, latency_ns: int, is_depth: bool | None
) -> Camera:
    kind, _, rest = spec.partition(":")
    if kind == "shm":
        return SharedMemoryCamera(rest, clock=clock)
    if spec == NO_CAMERA:
        return BlankCamera(image_size=size, clock=clock, is_depth=bool(is_depth))
    if kind == "screen":
        from mavbridge.camera.screen import ScreenCamera

        return ScreenCamera(rest, clock=clock, latency_ns=latency_ns)
    opener: Callable[[], ImageSource]
    if kind == "pipe":
        opener = partial(PipeSource, parse_pipe(rest), clock=clock)
    elif kind == "jpeg-udp":
        opener = partial(JpegUdpSource, *parse_jpeg_udp(rest), clock=clock)
    elif _is_stream(spec):
        opener = partial(open_stream, spec, clock=clock)
    elif _is_device(spec):
        device = int(spec) if spec.isdecimal() else Path(spec)
        opener = partial(open_device, device, image_size=size, clock=clock)
    else:
        return VideoFileCamera(Path(spec), clock=clock)
    return Grabber(opener, clock=clock, latency_ns=latency_ns)


class BlankCamera:
    """Camera that delivers a black frame at each point of a time grid, and drops unread ones."""

    def __init__(
        self, *, image_size: tuple[int, int], clock: Clock, is_depth: bool = False
    ) -> None:
        self._clock = clock
        shape = (*image_size, *(() if is_depth else (3,)))
        self._rgb: CameraImage = np.zeros(shape, np.uint16 if is_depth else np.uint8)
        self._rgb.flags.writeable = False
        self._due_ns = clock.now_ns()
        self._frame_id = 0
        self.dropped_frames = 0

    def read(self, timeout_ns: int) -> Frame | None:
        """See `mavbridge.core.records.Camera`."""
        if not wait_until_due(self._clock, self._due_ns, timeout_ns):
            return None
        late = (self._clock.now_ns() - self._due_ns) // BLANK_NS
        captured_ns = self._due_ns + late * BLANK_NS
        self.dropped_frames += late
        self._frame_id += 1 + late
        self._due_ns = captured_ns + BLANK_NS
        return Frame(frame_id=self._frame_id, captured_ns=captured_ns, rgb=self._rgb)

    def close(self) -> None:
        """No-op."""
