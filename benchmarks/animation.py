"""Animate a recorded flight: camera, chase view and sent actions, side by side.

python -m benchmarks.animation FLIGHT --gates gates.json --out docs/images/flight.webp
"""

import argparse
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from mavbridge.core.course import CourseGate, read_gates
from mavbridge.core.vehicle import ACTION_CLASSES
from mavbridge.recording.flight_folder import RecordedFlight, open_flight
from policy.contract import QUATERNION, VELOCITY
from policy.motion.rotation import matrix_columns

Array = npt.NDArray[Any]

HEIGHT, CAMERA, SCENE = 400, 400, 500
PLOT = 130
"""Pixels: of the picture, the camera's square, the scene's width and the plot's height."""
START_S, SECONDS, FPS, QUALITY = 2.0, 10.0, 15.0, 55
TRACE_S = 3.0
"""Length of the plot [s]."""
BACK_M, UP_M, FOCAL = 5.0, 2.2, 330.0
"""Chase camera: distance behind and above the vehicle [m], and focal length [pixels]."""
NEAR_M, FAR_M = 0.5, 60.0
SKY, GROUND, GRID = (48, 38, 32), (58, 52, 46), (84, 76, 68)
GATE, PATH, BODY = (0, 159, 230), (233, 180, 86), (245, 245, 245)
COLOURS = ((0, 159, 230), (233, 180, 86), (115, 158, 0), (167, 121, 204))
"""BGR of the four actions, distinguishable for colour-blind readers (Okabe and Ito)."""


class FilmedFlight:
    """Columns of a recorded flight as arrays, over the time in which the policy flew."""

    def __init__(self, flight: RecordedFlight) -> None:
        rows = [row for row in flight.ticks.to_pylist() if row["phase"] == "flying"]
        rows = [row for row in rows if row["state"] and row["sent"] and row["position_ned_m"]]
        self.time_s = np.array([row["sent_ns"] for row in rows]) / 1e9
        self.position = np.array([row["position_ned_m"] for row in rows])
        state = np.array([row["state"] for row in rows])
        self.speed = np.linalg.norm(state[:, VELOCITY], axis=1)
        forward, right, _ = matrix_columns(*state[:, QUATERNION].T)
        self.heading = np.unwrap(np.arctan2(forward[1], forward[0]))
        self.right = np.stack(right, axis=1)
        self.sent = np.array([row["sent"] for row in rows])
        self.names = ACTION_CLASSES[flight.meta.contract.action]._fields


class View:
    """Pinhole camera behind the vehicle, looking along its heading."""

    def __init__(self, position: Array, heading: float) -> None:
        forward = np.array([np.cos(heading), np.sin(heading), 0.12])
        self._forward = forward / np.linalg.norm(forward)
        self._right = np.array([-np.sin(heading), np.cos(heading), 0.0])
        self._down = np.cross(self._forward, self._right)
        self._origin = position - BACK_M * np.array([*forward[:2], 0.0]) - [0.0, 0.0, UP_M]

    def line(self, picture: Array, ends: Array, colour: tuple[int, ...], width: int) -> None:
        """Draw a line between two points of the world, clipped at the near plane."""
        points = (ends - self._origin) @ np.stack([self._right, self._down, self._forward]).T
        if (points[:, 2] < NEAR_M).all():
            return
        near = points[:, 2].argmin()
        if points[near, 2] < NEAR_M:
            far = points[1 - near]
            share = (NEAR_M - far[2]) / (points[near, 2] - far[2])
            points[near] = far + share * (points[near] - far)
        middle = np.array([SCENE / 2, (HEIGHT - PLOT) * 0.42])
        pixels = points[:, :2] / points[:, 2:] * FOCAL + middle
        first, last = (tuple(int(each) for each in point.clip(-9999, 9999)) for point in pixels)
        cv2.line(picture, first, last, colour, width, cv2.LINE_AA)


def _scene(flight: FilmedFlight, index: int, gates: Sequence[CourseGate]) -> Array:
    """Draw the chase view with ground, gates, flown path and vehicle."""
    height = HEIGHT - PLOT
    picture = np.full((height, SCENE, 3), SKY, np.uint8)
    position = flight.position[index]
    view = View(position, float(flight.heading[max(0, index - 12) : index + 1].mean()))
    picture[int(height * 0.42 - 0.12 * FOCAL) :] = GROUND
    for offset in np.arange(-40, 41, 4.0):
        for axis in (0, 1):
            ends = np.zeros((2, 3))
            ends[:, axis] = np.round(position[axis] / 4) * 4 + offset
            ends[:, 1 - axis] = position[1 - axis] + np.array([-FAR_M, FAR_M])
            view.line(picture, ends, GRID, 1)
    for gate in gates:
        distance = np.linalg.norm(np.array(gate.center_ned_m) - position)
        if distance < FAR_M:
            corners = gate.corners_ned_m
            for first, last in zip(corners, np.roll(corners, 1, axis=0), strict=True):
                view.line(picture, np.stack([first, last]), GATE, max(1, int(26 / (distance + 4))))
    trail = flight.position[max(0, index - 400) : index + 1 : 4]
    for first, last in pairwise(trail):
        view.line(picture, np.stack([first, last]), PATH, 2)
    right = 0.35 * flight.right[index]
    view.line(picture, np.stack([position - right, position + right]), BODY, 4)
    _write(picture, f"{flight.speed[index]:.1f} m/s", (12, 24), 0.6)
    return picture


def _plot(flight: FilmedFlight, index: int) -> Array:
    """Draw the last seconds of the four actions, one band each."""
    picture = np.full((PLOT, SCENE, 3), (28, 24, 20), np.uint8)
    now = flight.time_s[index]
    shown = flight.time_s[: index + 1] > now - TRACE_S
    x = SCENE - 10 - (now - flight.time_s[: index + 1][shown]) * (SCENE - 120) / TRACE_S
    scale = np.abs(flight.sent).max(axis=0).clip(1e-3)
    for row, (name, colour) in enumerate(zip(flight.names, COLOURS, strict=True)):
        middle = int((row + 0.5) * PLOT / 4)
        cv2.line(picture, (100, middle), (SCENE - 10, middle), GRID, 1)
        y = middle - flight.sent[: index + 1, row][shown] / scale[row] * (PLOT / 8 - 2)
        points = np.stack([x, y], axis=1).round().astype(np.int32)
        cv2.polylines(picture, [points], False, colour, 2, cv2.LINE_AA)
        _write(picture, name, (10, middle + 4), 0.42, colour)
    return picture


def _write(
    picture: Array, text: str, at: tuple[int, int], size: float, colour: tuple[int, ...] = BODY
) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def frames(recorded: RecordedFlight, gates: Sequence[CourseGate]) -> Iterator[Array]:
    """Yield BGR pictures at a fixed rate, from ``START_S`` after the policy's first action."""
    flight = FilmedFlight(recorded)
    due = flight.time_s[0] + START_S
    end = due + SECONDS
    for row, image in zip(recorded.frame_rows(), recorded.rgb_images(), strict=True):
        captured = row.captured_ns / 1e9
        if captured < due or captured > end:
            continue
        due += 1 / FPS
        index = max(0, int(np.searchsorted(flight.time_s, captured, "right")) - 1)
        camera = cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), (CAMERA, CAMERA))
        _write(camera, "camera", (12, 24), 0.6)
        right = np.concatenate([_scene(flight, index, gates), _plot(flight, index)])
        yield np.concatenate([camera, right], axis=1)


def main() -> None:
    """Write the animation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flight", type=Path)
    parser.add_argument("--gates", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    animation = cv2.Animation()
    animation.frames = list(frames(open_flight(options.flight), read_gates(options.gates)))
    animation.durations = [round(1000 / FPS)] * len(animation.frames)
    quality = [cv2.IMWRITE_WEBP_QUALITY, QUALITY]
    if not cv2.imwriteanimation(str(options.out), animation, quality):
        raise SystemExit(f"cannot write {options.out}")


if __name__ == "__main__":
    main()
