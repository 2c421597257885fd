"""Scene of the viewer: vehicle, cameras, flown path, gates and the policy's planned path."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.course import CourseGate
from mavbridge.core.records import (
    CameraImage,
    ImageArray,
    Position,
    Solve,
    Tick,
    VehicleState,
    VisionTick,
)
from mavbridge.core.rotation import Quaternion, heading_rad
from mavbridge.core.vehicle import Action
from mavbridge.observe import viewer_layout as layout
from mavbridge.observe.images import as_rgb, jpeg
from mavbridge.observe.viewer_layout import ViewedFlight
from mavbridge.observe.viewer_plots import Columns
from policy.contract import StateFrame
from policy.motion.forward_motion import ForwardMotion, VehicleMotion
from policy.motion.rotation import conjugate, multiply, other_frame


def motion_of(state: VehicleState, frame: StateFrame) -> VehicleMotion:
    """Return the motion that a state in this frame describes, in NED and FRD."""
    row = tuple(state.values.tolist())
    if frame == "enu_flu":
        row = other_frame(row)
    vx, vy, vz, w, x, y, z, p, q, r, fx, fy, fz = row
    return VehicleMotion((w, x, y, z), (p, q, r), (vx, vy, vz), (fx, fy, fz))


MAX_IMAGE_WIDTH = 640
"""Wider images are scaled down, because the viewer does not show them any larger."""
POSE_NS = 30 * NS_PER_MS
"""Shortest time between two poses."""
FRUSTUM_M = 0.8
"""Distance at which the images hang. The angle of view of a camera is unknown: 90 degrees are
drawn, in the direction of the camera's name, else forward."""
CAMERA_AXES = {
    "down": rr.ViewCoordinates.URF,  # the upper edge of its image points forward
    "left": rr.ViewCoordinates.RBD,
    "right": rr.ViewCoordinates.LFD,
    "back": rr.ViewCoordinates.BLD,
}
"""By camera name, the meaning of the body's axes x, y, z (front, right, down)."""
_ARM_M = 0.25
_PATH_RADIUS = -1.5
"""In screen points, as a negative radius means."""


class SceneView:
    """Shows poses at tens of hertz, each image at its camera, and the flown path."""

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
        """Draw the static parts."""
        log = self._columns.stream.log
        log(layout.SCENE, rr.ViewCoordinates.FRD, static=True, strict=True)  # north, east, down
        log(f"{layout.VEHICLE}/body", _airframe(), static=True, strict=True)
        if self._gates:
            log(f"{layout.SCENE}/gates", _gates(self._gates), static=True, strict=True)

    def show_ticks(self, ticks: Sequence[Tick]) -> None:
        """Move the vehicle. Without a position it turns at its last one, or at the origin."""
        shown: list[Tick] = []
        for tick in ticks:
            if tick.woke_ns >= self._due_ns and tick.state is not None:
                self._due_ns = tick.woke_ns + POSE_NS
                shown.append(tick)
        if not shown:
            return
        motions = [motion_of(tick.state, self._frame) for tick in shown if tick.state is not None]
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
        """Continue the path from the last position of the batch before."""
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
            blob=[jpeg(image) for image in images], media_type=["image/jpeg"] * len(images)
        )
        self._columns.send(path, [vision.captured_ns for vision in visions], encoded)


def _turn_and_lean(ned_from_body_wxyz: Quaternion) -> tuple[Quaternion, Quaternion]:
    """Return the heading, and the lean in the turned axes; both xyzw, the viewer's order."""
    half_rad = heading_rad(ned_from_body_wxyz) / 2
    turn = (math.cos(half_rad), 0.0, 0.0, math.sin(half_rad))
    w, x, y, z = multiply(conjugate(turn), ned_from_body_wxyz)
    return (0.0, 0.0, turn[3], turn[0]), (x, y, z, w)


def _airframe() -> rr.LineStrips3D:
    """Return four arms and propellers in FRD metres; the front ones are red."""
    angle = np.linspace(0, 2 * math.pi, 17)
    circle = 0.6 * _ARM_M * np.stack([np.cos(angle), np.sin(angle), np.zeros(17)], axis=1)
    strips, colors = [], []
    for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        tip = np.array([x * _ARM_M, y * _ARM_M, 0.0])
        strips += [np.array([np.zeros(3), tip]), circle + tip]
        colors += [layout.RED if x > 0 else layout.GREY] * 2
    return rr.LineStrips3D(strips, colors=colors, radii=_PATH_RADIUS)


def _gates(gates: Sequence[CourseGate]) -> rr.LineStrips3D:
    """Return the openings, numbered in the order of flight."""
    strips = [gate.corners_ned_m[[0, 1, 2, 3, 0]] for gate in gates]
    labels = [str(number) for number in range(1, len(gates) + 1)]
    return rr.LineStrips3D(strips, colors=layout.PINK, radii=-2.0, labels=labels, show_labels=True)


def _fitting(image: CameraImage) -> ImageArray:
    """Return the image in RGB at its shown width."""
    rgb = as_rgb(image)
    height, width = rgb.shape[:2]
    if width <= MAX_IMAGE_WIDTH:
        return rgb
    size = (MAX_IMAGE_WIDTH, max(1, round(height * MAX_IMAGE_WIDTH / width)))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


PREDICTION_S = 0.01
"""Step of the prediction of a planned path."""


class PlanView:
    """Shows a subset of the chunks: the next one that finds a free lane."""

    def __init__(self, columns: Columns, flight: ViewedFlight) -> None:
        self._columns = columns
        self._frame = flight.contract.state_frame
        self._model = ForwardMotion(flight.contract)
        self._to_ned = flight.to_ned
        self._lanes = layout.plan_plots(flight.contract.action)
        self._next_ns = 0
        self._shown = 0

    def show(self, solve: Solve, position: Position | None) -> None:
        """Show this chunk if it is due; ``position`` is the vehicle's, in NED; None: unknown."""
        if self._to_ned is None or solve.first_ns < self._next_ns:
            return
        actions = self._to_ned(solve.actions[0])
        step_ns = solve.step_ns
        self._next_ns = solve.first_ns + (len(actions) + 1) * step_ns // layout.PLAN_LANES + 1
        lane = self._lanes[self._shown % len(self._lanes)]
        self._shown += 1
        stamps_ns = [solve.first_ns + number * step_ns for number in range(len(actions) + 1)]
        for axis, plot in enumerate(lane):
            values = [*(action[axis] for action in actions), math.nan]  # the gap ends this line
            self._columns.plot(plot, stamps_ns, [(value,) for value in values])
        if position is not None:
            strips = rr.LineStrips3D.columns(strips=[self._path(solve, actions) + position])
            self._columns.send(layout.PLANNED_PATH, [solve.computed_ns], strips)

    def _path(self, solve: Solve, actions: Sequence[Action]) -> NDArray[np.float64]:
        """Return the planned path [1 + horizon, 3] from the vehicle in NED metres."""
        motion, step_s = motion_of(solve.state, self._frame), solve.step_ns / NS_PER_S
        count = math.ceil(step_s / PREDICTION_S)
        path = [np.zeros(3)]
        for action in actions:
            place = path[-1]
            for _ in range(count):
                motion = self._model.after(motion, [action], step_s / count)
                place = place + np.array(motion.velocity_ned_mps) * (step_s / count)
            path.append(place)
        return np.array(path)
