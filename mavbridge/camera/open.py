"""Opens the camera that ``--camera`` describes."""

from functools import partial
from importlib.util import find_spec
from pathlib import Path

from mavbridge.camera.capture import open_device, open_stream
from mavbridge.camera.grabber import Grabber
from mavbridge.camera.shared_memory import SharedMemoryCamera
from mavbridge.camera.video_file import VideoFileCamera
from mavbridge.core.clock import Clock
from mavbridge.core.errors import UserError
from mavbridge.core.ports import Camera

STREAM_SCHEMES = ("rtsp://", "udp://", "tcp://", "http://", "https://")
SCREEN_PACKAGES = ("mss", "Xlib")
"""The extra "screen"."""
FORMS = (
    "a device (0, /dev/video0), a stream (rtsp://, udp://, tcp://, http://, https://), "
    "a video file, shm:NAME or screen:WINDOW TITLE (screen: alone = the whole screen)"
)


def check_camera(spec: str) -> None:
    """Refuse a source that cannot be opened, as far as that can be told without opening it.

    Raises:
        UserError: ``spec`` has no known form, names no file, or needs a package that is missing.
    """
    kind = spec.partition(":")[0]
    if kind == "screen":
        missing = [name for name in SCREEN_PACKAGES if find_spec(name) is None]
        if missing:
            raise UserError(
                f"--camera screen: needs the package {missing[0]}: pip install 'mavbridge[screen]'"
            )
        return
    is_known = kind == "shm" or spec.startswith((*STREAM_SCHEMES, "/dev/video")) or spec.isdecimal()
    if not is_known and not Path(spec).is_file():
        raise UserError(f"--camera {spec!r}: no such file, and not a known source; use {FORMS}")


def open_camera(spec: str, *, image_size: int, clock: Clock) -> Camera:
    """Open the source that ``spec`` names; raises as ``check_camera``, or CameraError.

    ``image_size`` is the side of the policy's square image in pixels: a device is asked for a mode
    that covers it. All other sources deliver their own size.
    """
    check_camera(spec)
    kind, _, rest = spec.partition(":")
    if kind == "shm":
        return SharedMemoryCamera(rest, clock=clock)
    if kind == "screen":
        from mavbridge.camera.screen import ScreenCamera

        return ScreenCamera(rest, clock=clock)
    if spec.startswith(STREAM_SCHEMES):
        return Grabber(partial(open_stream, spec, clock=clock), clock=clock)
    if spec.isdecimal() or spec.startswith("/dev/video"):
        device = int(spec) if spec.isdecimal() else Path(spec)
        opener = partial(open_device, device, image_size=image_size, clock=clock)
        return Grabber(opener, clock=clock)
    return VideoFileCamera(Path(spec), clock=clock)
