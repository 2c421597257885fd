"""Surfaces and colours of the FPV view: gates, ridge, ground and sky. All constant per course."""

import math
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from sitl.course.layout import BAR_M, DEPTH_M, Course, Gate
from sitl.rotation import Vec3
from sitl.vehicle.conditions import NOMINAL, Conditions, Rgb

FloatArray: TypeAlias = NDArray[np.float64]
Image: TypeAlias = NDArray[np.uint8]

LEG_M = 0.09
PIP_M = 0.16
PIP_PITCH_M = 0.32

RIDGE_SEGMENTS = 120
RIDGE_ELEVATION_RAD = (math.radians(0.8), math.radians(6.5))

GROUND_TILE_M = 16.0
GROUND_TILE_PX = 512
GRID_M = 2.0

HAZE_RGB = (226, 210, 194)
RIDGE_RGB = (150, 152, 170)
SOIL_RGB = (112, 116, 74)
GRASS_RGB = (62, 96, 62)
GRID_RGB = (196, 200, 160)
LEG_RGB = (58, 60, 68)
PIP_RGB = (255, 248, 232)
BACK_RGB = (96, 98, 112)
"""A gate is grey from behind: it must not be flown from there."""
FRONT_RGB = NOMINAL.gate_rgb
"""Of even gates, of odd gates; the white squares on top count from one."""
BACKDROP_RGB = (
    (-1.0, (78, 98, 66)),
    (-0.30, (92, 108, 76)),
    (-0.05, (168, 166, 146)),
    (0.0, HAZE_RGB),
    (0.10, (204, 214, 224)),
    (0.40, (126, 172, 222)),
    (1.0, (52, 100, 182)),
)
"""How far a viewing ray of unit depth rises -> colour, interpolated between."""


class _Face(NamedTuple):
    """One quadrilateral in a gate's axes: ahead along the passage, right, down."""

    corners_m: tuple[Vec3, ...]
    normal: Vec3
    rgb: Rgb


@dataclass(frozen=True, slots=True, kw_only=True)
class Faces:
    """Flat quadrilaterals in world coordinates."""

    corners_ned_m: FloatArray
    """[N, 4, 3]"""
    normals_ned: FloatArray
    """[N, 3] unit, towards the side from which a face is seen; zero = it is seen from both."""
    rgb: FloatArray
    """[N, 3], lit by the sun."""
    gate: NDArray[np.intp]
    """[N] index of the gate that a face belongs to. Of the faces of one gate that are seen from a
    point, a later one is never hidden by an earlier one."""


def gate_faces(course: Course, conditions: Conditions = NOMINAL) -> Faces:
    """All surfaces of all gates."""
    sun_ned, ambient = np.array(conditions.sun_ned), conditions.ambient
    corners, normals, rgb, owners = [], [], [], []
    for gate in course.gates:
        ned_from_gate = _ned_from_gate(gate)
        for face in _gate_parts(gate, conditions.gate_rgb):
            normal_ned = ned_from_gate @ np.array(face.normal)
            light = ambient + (1 - ambient) * max(0.0, float(normal_ned @ sun_ned))
            corners.append(np.array(face.corners_m) @ ned_from_gate.T + gate.center_ned_m)
            normals.append(normal_ned)
            rgb.append(np.array(face.rgb) * light)
            owners.append(gate.index)
    return Faces(
        corners_ned_m=np.array(corners),
        normals_ned=np.array(normals),
        rgb=np.array(rgb),
        gate=np.array(owners, dtype=np.intp),
    )


def _ned_from_gate(gate: Gate) -> FloatArray:
    cos_yaw, sin_yaw = math.cos(gate.yaw_rad), math.sin(gate.yaw_rad)
    return np.array([[cos_yaw, -sin_yaw, 0.0], [sin_yaw, cos_yaw, 0.0], [0.0, 0.0, 1.0]])


def _gate_parts(gate: Gate, front_rgb: tuple[Rgb, Rgb]) -> list[_Face]:
    """Faces in drawing order.

    Walls inside the opening are hidden by any other part of the frame that is in the way, so they
    come first; an outer wall and a ring that are both seen never hide each other.
    """
    inner_m = gate.size_m / 2
    outer_m = inner_m + BAR_M
    paint = front_rgb[gate.index % len(front_rgb)]
    inside = _scaled(paint, 0.7)
    return [
        *_legs(gate, inner_m, outer_m),
        *(_wall(inner_m, quarter, inside, inward=True) for quarter in range(4)),
        *(_wall(outer_m, quarter, inside, inward=False) for quarter in range(4)),
        *(_ring(outer_m, inner_m, quarter, 1.0, BACK_RGB) for quarter in range(4)),
        *(_ring(outer_m, inner_m, quarter, -1.0, paint) for quarter in range(4)),
        *_pips(gate.index + 1, inner_m + BAR_M / 2),
    ]


def _legs(gate: Gate, inner_m: float, outer_m: float) -> list[_Face]:
    """Two flat posts down to the ground."""
    ground_m = -gate.center_ned_m[2]
    faces = []
    for middle_m in (-inner_m - BAR_M / 2, inner_m + BAR_M / 2):
        left_m, right_m = middle_m - LEG_M / 2, middle_m + LEG_M / 2
        corners = (
            (0.0, left_m, outer_m),
            (0.0, right_m, outer_m),
            (0.0, right_m, ground_m),
            (0.0, left_m, ground_m),
        )
        faces.append(_Face(corners, (0.0, 0.0, 0.0), LEG_RGB))
    return faces


def _wall(half_m: float, quarter: int, rgb: Rgb, *, inward: bool) -> _Face:
    """Top wall of a square tube along the passage, turned by quarters of a turn."""
    depth_m = DEPTH_M / 2
    corners = (
        (-depth_m, -half_m, -half_m),
        (-depth_m, half_m, -half_m),
        (depth_m, half_m, -half_m),
        (depth_m, -half_m, -half_m),
    )
    normal = (0.0, 0.0, 1.0 if inward else -1.0)
    return _Face(tuple(_turned(c, quarter) for c in corners), _turned(normal, quarter), rgb)


def _ring(outer_m: float, inner_m: float, quarter: int, side: float, rgb: Rgb) -> _Face:
    """Top quarter of the front (side -1) or back (+1) of the frame, turned by quarters."""
    ahead_m = side * DEPTH_M / 2
    corners = (
        (ahead_m, -outer_m, -outer_m),
        (ahead_m, outer_m, -outer_m),
        (ahead_m, inner_m, -inner_m),
        (ahead_m, -inner_m, -inner_m),
    )
    return _Face(tuple(_turned(c, quarter) for c in corners), (side, 0.0, 0.0), rgb)


def _pips(count: int, height_m: float) -> list[_Face]:
    """White squares on the front of the top bar: the gate's number, counted from one."""
    ahead_m = -DEPTH_M / 2
    half_m = PIP_M / 2
    faces = []
    for k in range(count):
        right_m = (k - (count - 1) / 2) * PIP_PITCH_M
        corners = tuple(
            (ahead_m, right_m + dr * half_m, -height_m + dd * half_m)
            for dr, dd in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        )
        faces.append(_Face(corners, (-1.0, 0.0, 0.0), PIP_RGB))
    return faces


def _turned(point: Vec3, quarter: int) -> Vec3:
    """Turned about the passage by quarters of a turn."""
    ahead, right, down = point
    for _ in range(quarter):
        right, down = -down, right
    return (ahead, right, down)


def _scaled(rgb: Rgb, factor: float) -> Rgb:
    red, green, blue = (round(value * factor) for value in rgb)
    return (red, green, blue)


def ridge_directions(seed: int) -> FloatArray:
    """Hills on the horizon as quadrilaterals of directions, [N, 4, 3] NED: they show rotation."""
    random = np.random.Generator(np.random.PCG64(seed))
    azimuth_rad = np.linspace(-math.pi, math.pi, RIDGE_SEGMENTS + 1)
    waves = np.arange(2, 16)
    phase_rad = random.uniform(0, math.tau, waves.size)
    heights = (np.cos(np.outer(azimuth_rad, waves) + phase_rad) / waves).sum(axis=1)
    heights = (heights - heights.min()) / np.ptp(heights)
    low_rad, high_rad = RIDGE_ELEVATION_RAD
    up = np.tan(low_rad + heights * (high_rad - low_rad))
    foot = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad), np.zeros_like(up)], axis=1)
    crest = foot - np.outer(up, [0.0, 0.0, 1.0])
    return np.stack([foot[:-1], foot[1:], crest[1:], crest[:-1]], axis=1)


def tinted(rgb: Rgb, tint: Vec3) -> FloatArray:
    """[3] the colour in another light, of 255."""
    return np.asarray(np.clip(np.array(rgb) * np.array(tint), 0, 255))


def backdrop_colours(conditions: Conditions = NOMINAL) -> Image:
    """Sky above and far ground below, [256, 1, 3] uint8 RGB.

    Entry k is for a ray of unit depth that rises by k / 127.5 - 1.
    """
    up = np.linspace(-1.0, 1.0, 256)
    stops, rgb = zip(*BACKDROP_RGB, strict=True)
    channels = [np.interp(up, stops, [c[k] for c in rgb]) for k in range(3)]
    colours = (np.stack(channels, axis=1) * conditions.sky_tint).round().reshape(256, 1, 3)
    return np.asarray(np.clip(colours, 0, 255), dtype=np.uint8)


def ground_tile(conditions: Conditions = NOMINAL) -> Image:
    """A square of ground that repeats seamlessly, [GROUND_TILE_PX, GROUND_TILE_PX, 3] RGB.

    Mottled grass and soil under a 2 m grid: texture for optic flow, lines for scale. Axis 0 is
    east, axis 1 is north.
    """
    random = np.random.Generator(np.random.PCG64(conditions.ground_seed))
    patches = _periodic_noise(random, smooth_m=1.2)[..., None]
    speckle = _periodic_noise(random, smooth_m=0.06)[..., None]
    mix = np.clip(0.5 + 0.35 * patches, 0, 1)
    ground = mix * np.array(SOIL_RGB) + (1 - mix) * np.array(GRASS_RGB)
    lit = ground * (1 + 0.13 * speckle) * conditions.ground_tint
    tile = np.asarray(np.clip(lit, 0, 255), dtype=np.uint8)
    grid_rgb = tinted(GRID_RGB, conditions.ground_tint).tolist()
    pitch_px = round(GRID_M * GROUND_TILE_PX / GROUND_TILE_M)
    for at_px in range(pitch_px // 2, GROUND_TILE_PX, pitch_px):
        cv2.line(tile, (at_px, 0), (at_px, GROUND_TILE_PX), grid_rgb, thickness=3)
        cv2.line(tile, (0, at_px), (GROUND_TILE_PX, at_px), grid_rgb, thickness=3)
    return tile


def _periodic_noise(random: np.random.Generator, *, smooth_m: float) -> FloatArray:
    """Zero mean, unit variance, Gaussian-smoothed in the frequency domain, hence without a seam."""
    frequency_per_m = np.fft.fftfreq(GROUND_TILE_PX, GROUND_TILE_M / GROUND_TILE_PX)
    low_pass = np.exp(-2 * (math.pi * smooth_m * frequency_per_m) ** 2)
    white = random.standard_normal((GROUND_TILE_PX, GROUND_TILE_PX))
    noise = np.fft.ifft2(np.fft.fft2(white) * np.outer(low_pass, low_pass)).real
    return np.asarray((noise - noise.mean()) / noise.std())
