"""The viewer's scene: the vehicle with its cameras, the path that it has flown, the gates."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import rerun as rr

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.course import CourseGate
from mavbridge.core.records import CameraImage, ImageArray, Position, Tick, VisionTick
from mavbridge.core.rotation import Quaternion, heading_rad
from mavbridge.observe.viewer import layout
from mavbridge.observe.viewer.columns import Columns
from mavbridge.observe.viewer.layout import ViewedFlight
from mavbridge.observe.viewer.motion import Motion

JPEG_QUALITY = 85
MAX_IMAGE_WIDTH = 640
"""Wider images are scaled down, since the viewer does not show them any larger."""
POSE_NS = 30 * NS_PER_MS
"""Least time between two poses."""
FRUSTUM_M = 0.8
"""Distance at which the images hang. Nobody tells a camera's angle of view: 90 degrees are drawn,
along the direction that its name says, else forward."""
CAMERA_AXES = {
    "down": rr.ViewCoordinates.URF,  # the upper edge of its image lies ahead
    "left": rr.ViewCoordinates.RBD,
    "right": rr.ViewCoordinates.LFD,
    "back": rr.ViewCoordinates.BLD,
}
"""Meaning, for a camera of this name, of the body's axes x, y, z (front, right, down)."""
_ARM_M = 0.25
_PATH_RADIUS = -1.5
"""In points of the screen, which is what a negative radius means."""


class SceneView:
    """Shows poses at tens of hertz, each image where its camera is, and the path behind them."""

    def __init__(self, columns: Columns, flight: ViewedFlight) -> None:
        self._columns = columns
        self._frame = flight.contract.state_frame
        self._gates = flight.gates
        self._cameras = tuple(
            zip(
                layout.camera_paths(flight.contract.cameras),
                (CAMERA_AXES.get(name, rr.ViewCoordinates.FRD) for name in flight.contract.cameras),
                strict=True,
            )
        )
        self._has_pinhole = [False] * len(self._cameras)
        self._due_ns = 0
        self._last_place: Position | None = None

    def open(self) -> None:
        """Draw what does not move."""
        log = self._columns.stream.log
        log(layout.SCENE, rr.ViewCoordinates.FRD, static=True, strict=True)  # north, east, down
        log(f"{layout.VEHICLE}/body", _airframe(), static=True, strict=True)
        if self._gates:
            log(f"{layout.SCENE}/gates", _gates(self._gates), static=True, strict=True)

    def show_ticks(self, ticks: Sequence[Tick]) -> None:
        """Move the vehicle; without a position it turns where it was last, or at the origin."""
        shown: list[Tick] = []
        for tick in ticks:
            if tick.woke_ns >= self._due_ns and tick.state is not None:
                self._due_ns = tick.woke_ns + POSE_NS
                shown.append(tick)
        if not shown:
            return
        motions = [Motion.of(tick.state, self._frame) for tick in shown if tick.state is not None]
        stamps_ns = [tick.woke_ns for tick in shown]
        self._show_path(shown)
        places, last = [], self._last_place or layout.ORIGIN
        for tick in shown:
            last = tick.position_ned_m or last
            places.append(last)
        turns, leans = zip(*(_turn_and_lean(m.ned_from_body_wxyz) for m in motions), strict=True)
        chase = rr.Transform3D.columns(translation=places, quaternion=turns)
        self._columns.send(layout.CHASE, stamps_ns, chase)
        self._columns.send(layout.VEHICLE, stamps_ns, rr.Transform3D.columns(quaternion=leans))
        velocities = [motion.velocity_ned_mps for motion in motions]
        speeds = [(math.hypot(north, east), -down) for north, east, down in velocities]
        self._columns.plot(layout.SPEED, stamps_ns, speeds)
        heights = [math.nan if t.position_ned_m is None else -t.position_ned_m.down for t in shown]
        self._columns.plot(layout.HEIGHT, stamps_ns, [(height,) for height in heights])

    def _show_path(self, ticks: Sequence[Tick]) -> None:
        """Go on with the path from the last place of the batch before."""
        places = [tick.position_ned_m for tick in ticks if tick.position_ned_m is not None]
        strip = places if self._last_place is None else [self._last_place, *places]
        if places:
            self._last_place = places[-1]
        if len(strip) > 1:
            is_ours = ticks[-1].trace is not None
            strips = rr.LineStrips3D.columns(
                strips=[strip],
                colors=[layout.BLUE if is_ours else layout.GREY],
                radii=[_PATH_RADIUS],
            )
            self._columns.send(layout.PATH, [ticks[-1].woke_ns], strips)

    def show_images(self, visions: Sequence[VisionTick]) -> None:
        """Show the images of one camera at their exposure."""
        camera = visions[0].camera
        path, axes = self._cameras[camera]
        images = [_fitting(vision.rgb) for vision in visions]
        if not self._has_pinhole[camera]:
            self._has_pinhole[camera] = True
            height, width = images[0].shape[:2]
            pinhole = rr.Pinhole(
                width=width,
                height=height,
                focal_length=width / 2,
                camera_xyz=axes,
                image_plane_distance=FRUSTUM_M,
                color=layout.GREY,
            )
            self._columns.stream.log(path, pinhole, static=True, strict=True)
        encoded = rr.EncodedImage.columns(
            blob=[_jpeg(image) for image in images], media_type=["image/jpeg"] * len(images)
        )
        self._columns.send(path, [vision.captured_ns for vision in visions], encoded)


def _turn_and_lean(ned_from_body_wxyz: Quaternion) -> tuple[Quaternion, Quaternion]:
    """The heading, and the lean in the axes that it turns; both xyzw, as the viewer has it."""
    w, x, y, z = ned_from_body_wxyz
    half_rad = heading_rad(ned_from_body_wxyz) / 2
    c, s = math.cos(half_rad), math.sin(half_rad)
    lean = (c * x + s * y, c * y - s * x, c * z - s * w, c * w + s * z)
    return (0.0, 0.0, s, c), lean


def _airframe() -> rr.LineStrips3D:
    """Four arms and propellers in FRD metres; the front ones are red."""
    angle = np.linspace(0, 2 * math.pi, 17)
    circle = 0.6 * _ARM_M * np.stack([np.cos(angle), np.sin(angle), np.zeros(17)], axis=1)
    strips, colors = [], []
    for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        tip = np.array([x * _ARM_M, y * _ARM_M, 0.0])
        strips += [np.array([np.zeros(3), tip]), circle + tip]
        colors += [layout.RED if x > 0 else layout.GREY] * 2
    return rr.LineStrips3D(strips, colors=colors, radii=_PATH_RADIUS)


def _gates(gates: Sequence[CourseGate]) -> rr.LineStrips3D:
    """The openings, numbered in the order in which they are flown."""
    strips = []
    for gate in gates:
        half_m = gate.size_m / 2
        right = half_m * np.array([-math.sin(gate.yaw_rad), math.cos(gate.yaw_rad), 0.0])
        down = np.array([0.0, 0.0, half_m])
        corners = [-right - down, right - down, right + down, -right + down, -right - down]
        strips.append(np.array(gate.center_ned_m) + np.array(corners))
    labels = [str(number) for number in range(1, len(gates) + 1)]
    return rr.LineStrips3D(
        strips,
        colors=layout.PINK,
        radii=-2.0,
        labels=labels,
        show_labels=True,
    )


def _fitting(image: CameraImage) -> ImageArray:
    """The image in RGB, as wide as is shown; depth darker the farther, with unknown black."""
    rgb = np.asarray(image, np.uint8) if image.ndim == 3 else _shaded(image)
    height, width = rgb.shape[:2]
    if width <= MAX_IMAGE_WIDTH:
        return rgb
    size = (MAX_IMAGE_WIDTH, max(1, round(height * MAX_IMAGE_WIDTH / width)))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _shaded(depth: CameraImage) -> ImageArray:
    shares = 1.0 - depth.astype(np.float32) / max(int(depth.max()), 1)
    grey = np.where(depth > 0, 55 + 200 * shares, 0).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def _jpeg(rgb: ImageArray) -> bytes:
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return encoded.tobytes()
