"""Surfaces and colours of the FPV view: gates, ridge, ground and sky; constant for a course."""

import cmath
import math
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from sitl.course import BAR_M, DEPTH_M, Course, Gate
from sitl.rotation import Vec3, wrap_pi
from sitl.vehicle.conditions import NOMINAL, Conditions, Rgb

FloatArray: TypeAlias = NDArray[np.float64]
Image: TypeAlias = NDArray[np.uint8]

LEG_M = 0.09  # width of the two posts that reach down to the ground
PIP_M = 0.16
PIP_PITCH_M = 0.32  # white squares on the front of the top bar: the gate's number, counted from one
INSIDE_BRIGHTNESS = 0.7
SHADE_BRIGHTNESS = 0.4
PANEL_AHEAD_M = (2.0, 4.5)  # distance before the gate of a panel that hides a part of it
PANEL_ASIDE_M = (1.3, 1.9)
"""From the way to its middle, to either side. Nothing flies through one, and nothing can hit it."""
PANEL_WIDTH_M = 1.2
STRAY_AHEAD_M = (-3.0, 3.0)
"""Distance of a gate that is out of order beyond the one that it stands beside."""
STRAY_ASIDE_M = (5.0, 8.0)  # from the middle of that gate, to either side. It cannot be hit.
STRAY_TURN_RAD = math.radians(120.0)
"""Largest turn of its passage against the other's, to either side."""
STRAY_CLEARANCE_M = 4.5
"""From the middle of every gate of the course; where there is less, none stands."""
BOTH_SIDES: Vec3 = (0.0, 0.0, 0.0)

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
PANEL_RGB = (74, 72, 66)
PIP_RGB = (255, 248, 232)
BACK_RGB = (96, 98, 112)  # a gate is grey from behind: it must not be passed from there
BACKDROP_RGB = (
    (-1.0, (78, 98, 66)),
    (-0.30, (92, 108, 76)),
    (-0.05, (168, 166, 146)),
    (0.0, HAZE_RGB),
    (0.10, (204, 214, 224)),
    (0.40, (126, 172, 222)),
    (1.0, (52, 100, 182)),
)
"""Rise of a viewing ray of unit depth, and its colour; interpolated between."""


class _Face(NamedTuple):
    """One quadrilateral in gate axes: forward through the gate, right, down."""

    corners_m: tuple[Vec3, ...]
    normal: Vec3  # towards the side from which it is seen; zero = it is seen from both
    rgb: Rgb


@dataclass(frozen=True, slots=True, kw_only=True)
class Faces:
    """Flat quadrilaterals in world coordinates."""

    corners_ned_m: FloatArray  # [N, 4, 3]
    normals_ned: FloatArray
    """[N, 3] unit, towards the side from which a face is seen; zero = it is seen from both."""
    rgb: FloatArray  # [N, 3], lit by the sun
    owner: NDArray[np.intp]
    """[N] row in ``centers_ned_m`` of what a face belongs to. Of the faces of one that are seen
    from a point, a later one is never hidden by an earlier one."""
    centers_ned_m: FloatArray
    """[M, 3] of the course's gates, of those out of order, then of the panels."""


def course_faces(course: Course, conditions: Conditions = NOMINAL) -> Faces:
    """Build all surfaces of all gates, in order or not, and of the panels that hide some.

    A gate out of order is shaded as the one whose number it has.
    """
    sun_ned, ambient = np.array(conditions.sun_ned), conditions.ambient
    random = np.random.Generator(np.random.PCG64((conditions.seed, 6)))
    is_shaded = random.random(len(course.gates)) < conditions.shaded_gates
    is_hidden = random.random(len(course.gates)) < conditions.hidden_gates
    gates = [*course.gates, *_stray_gates(course, conditions)]
    corners, normals, rgb, owners = [], [], [], []
    centers = [gate.center_ned_m for gate in gates]
    for owner, gate in enumerate(gates):
        cos_yaw, sin_yaw = math.cos(gate.yaw_rad), math.sin(gate.yaw_rad)
        ned_from_gate = np.array([[cos_yaw, -sin_yaw, 0], [sin_yaw, cos_yaw, 0], [0, 0, 1]])
        for face in _faces_of(gate, conditions.gate_rgb):
            normal_ned = ned_from_gate @ np.array(face.normal)
            light = ambient + (1 - ambient) * max(0.0, float(normal_ned @ sun_ned))
            light *= SHADE_BRIGHTNESS if is_shaded[gate.index] else 1.0
            corners.append(np.array(face.corners_m) @ ned_from_gate.T + gate.center_ned_m)
            normals.append(normal_ned)
            rgb.append(np.array(face.rgb) * light)
            owners.append(owner)
        if is_hidden[gate.index] and owner < len(course.gates):
            ahead_m, aside_m = -random.uniform(*PANEL_AHEAD_M), random.uniform(*PANEL_ASIDE_M)
            aside_m *= random.choice((-1.0, 1.0))
            down_m = (-gate.size_m, -gate.center_ned_m[2])
            panel_m = np.array(_upright(ahead_m, aside_m, PANEL_WIDTH_M, down_m))
            corners.append(panel_m @ ned_from_gate.T + gate.center_ned_m)
            normals.append(np.array(BOTH_SIDES))
            rgb.append(tinted(PANEL_RGB, conditions.ground_tint))
            owners.append(len(centers))
            centers.append(tuple(corners[-1].mean(axis=0).tolist()))
    return Faces(
        corners_ned_m=np.array(corners),
        normals_ned=np.array(normals),
        rgb=np.array(rgb),
        owner=np.array(owners, dtype=np.intp),
        centers_ned_m=np.array(centers),
    )


def _stray_gates(course: Course, conditions: Conditions) -> list[Gate]:
    """Gates that do not belong to the course, with numbers and colours of some that do."""
    random = np.random.Generator(np.random.PCG64((conditions.seed, 8)))
    strays = []
    for gate in course.gates:
        is_there = random.random() < conditions.stray_gates
        ahead_m, aside_m = random.uniform(*STRAY_AHEAD_M), random.uniform(*STRAY_ASIDE_M)
        offset_m = complex(ahead_m, aside_m * random.choice((-1.0, 1.0)))
        turn_rad = random.uniform(-STRAY_TURN_RAD, STRAY_TURN_RAD)
        north_m, east_m, down_m = gate.center_ned_m
        at_m = complex(north_m, east_m) + offset_m * cmath.rect(1.0, gate.yaw_rad)
        room_m = min(abs(at_m - complex(*other.center_ned_m[:2])) for other in course.gates)
        if is_there and room_m >= STRAY_CLEARANCE_M:
            stray = replace(
                gate,
                center_ned_m=(at_m.real, at_m.imag, down_m),
                yaw_rad=wrap_pi(gate.yaw_rad + turn_rad),
                index=int(random.integers(len(course.gates))),
            )
            strays.append(stray)
    return strays


def _faces_of(gate: Gate, front_rgb: tuple[Rgb, Rgb]) -> list[_Face]:
    """Faces in drawing order: posts, walls inside the opening, outer walls, back, front, number.

    Walls inside the opening are hidden by any other part of the frame that is in the way, so they
    come first; an outer wall and a ring that are both seen never hide each other.
    """
    inner_m = gate.size_m / 2
    outer_m = inner_m + BAR_M
    middle_m = inner_m + BAR_M / 2
    front_m, back_m = -DEPTH_M / 2, DEPTH_M / 2
    paint = front_rgb[gate.index % len(front_rgb)]
    red, green, blue = (round(value * INSIDE_BRIGHTNESS) for value in paint)
    inside = (red, green, blue)
    to_ground_m = (outer_m, -gate.center_ned_m[2])
    number_m = (-middle_m - PIP_M / 2, -middle_m + PIP_M / 2)
    pips = [(k - gate.index / 2) * PIP_PITCH_M for k in range(gate.index + 1)]
    return [
        *(
            _Face(_upright(0.0, m, LEG_M, to_ground_m), BOTH_SIDES, LEG_RGB)
            for m in (-middle_m, middle_m)
        ),
        *_tube(inner_m, (0.0, 0.0, 1.0), inside),
        *_tube(outer_m, (0.0, 0.0, -1.0), inside),
        *_ring(outer_m, inner_m, back_m, (1.0, 0.0, 0.0), BACK_RGB),
        *_ring(outer_m, inner_m, front_m, (-1.0, 0.0, 0.0), paint),
        *(_Face(_upright(front_m, m, PIP_M, number_m), (-1.0, 0.0, 0.0), PIP_RGB) for m in pips),
    ]


def _upright(
    forward_m: float, middle_m: float, width_m: float, down_m: tuple[float, float]
) -> tuple[Vec3, ...]:
    """Corners of a rectangle across the passage."""
    left_m, right_m = middle_m - width_m / 2, middle_m + width_m / 2
    top_m, bottom_m = down_m
    return (
        (forward_m, left_m, top_m),
        (forward_m, right_m, top_m),
        (forward_m, right_m, bottom_m),
        (forward_m, left_m, bottom_m),
    )


def _tube(half_m: float, top_normal: Vec3, rgb: Rgb) -> list[_Face]:
    """Walls of a square tube along the passage; its top wall has this normal."""
    depth_m = DEPTH_M / 2
    top = (
        (-depth_m, -half_m, -half_m),
        (-depth_m, half_m, -half_m),
        (depth_m, half_m, -half_m),
        (depth_m, -half_m, -half_m),
    )
    return _quarter_turns(_Face(top, top_normal, rgb))


def _ring(outer_m: float, inner_m: float, forward_m: float, normal: Vec3, rgb: Rgb) -> list[_Face]:
    """Front or back of the frame around the opening, in four parts."""
    top = (
        (forward_m, -outer_m, -outer_m),
        (forward_m, outer_m, -outer_m),
        (forward_m, inner_m, -inner_m),
        (forward_m, -inner_m, -inner_m),
    )
    return _quarter_turns(_Face(top, normal, rgb))


def _quarter_turns(top: _Face) -> list[_Face]:
    """The face, then turned about the passage by one, two and three quarters of a turn."""
    faces = [top]
    for _ in range(3):
        corners_m, normal, rgb = faces[-1]
        faces.append(_Face(tuple(map(_quarter_turn, corners_m)), _quarter_turn(normal), rgb))
    return faces


def _quarter_turn(vector: Vec3) -> Vec3:
    forward, right, down = vector
    return (forward, -down, right)


def ridge_directions(seed: int) -> FloatArray:
    """Hills on the horizon, which show rotation: quadrilaterals of NED directions, [N, 4, 3]."""
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
    return np.asarray(np.clip(np.array(rgb) * np.array(tint), 0, 255))


def backdrop_colours(conditions: Conditions = NOMINAL) -> Image:
    """Colour table of sky and far ground, [256, 1, 3] uint8 RGB.

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
    contrast = conditions.ground_contrast
    mix = np.clip(0.5 + 0.35 * contrast * patches, 0, 1)
    ground = mix * np.array(SOIL_RGB) + (1 - mix) * np.array(GRASS_RGB)
    lit = ground * (1 + 0.13 * contrast * speckle) * conditions.ground_tint
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
