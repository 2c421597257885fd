"""Surfaces and colours of the FPV view: gates, ridge, ground and sky; constant for a course."""

import cmath
import math
from dataclasses import dataclass, replace
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sitl.camera.clutter import Part, clutter
from sitl.course import BAR_M, DEPTH_M, Course, Gate
from sitl.vehicle.conditions import NOMINAL, Conditions, Rgb
from sitl.vehicle.rotation import Vec3, wrap_pi

FloatArray: TypeAlias = NDArray[np.float64]
Image: TypeAlias = NDArray[np.uint8]

PIP_PITCH_M = 0.32  # white squares on the front of the top bar count the gate's number from one
INSIDE_BRIGHTNESS = 0.7
SHADE_BRIGHTNESS = 0.4
PANEL_AHEAD_M = (2.0, 4.5)  # distance of a panel before the gate that it partly hides
PANEL_ASIDE_M = (1.3, 1.9)
"""Distance of the panel's middle from the passage's axis, to either side. No path passes through a
panel, and panels have no collision."""
PANEL_WIDTH_M = 1.2
STRAY_AHEAD_M = (-3.0, 3.0)
"""Distance of a stray gate beyond the gate that it stands beside."""
STRAY_ASIDE_M = (5.0, 8.0)  # from that gate's middle, to either side; it has no collision
STRAY_TURN_RAD = math.radians(120.0)
"""Largest turn of a stray gate's passage relative to that gate's, to either side."""
STRAY_CLEARANCE_M = 4.5
"""Smallest distance of a stray gate from all gates of the course, or it is left out."""
BOTH_SIDES: Vec3 = (0.0, 0.0, 0.0)
_QUARTER_TURN = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Turns rows of forward, right and down about the passage: right becomes down."""

RIDGE_SEGMENTS = 120
RIDGE_ELEVATION_RAD = (math.radians(0.8), math.radians(6.5))

GROUND_TILE_M = 16.0
GROUND_TILE_PX = 512

PANEL_RGB = (74, 72, 66)
BACKDROP_RISES = (-1.0, -0.30, -0.05, 0.0, 0.10, 0.40, 1.0)
"""Rise of a viewing ray of unit depth for each colour of far ground, then sky; interpolated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Faces:
    """Flat quadrilaterals in world coordinates."""

    corners_ned_m: FloatArray  # [N, 4, 3]
    normals_ned: FloatArray
    """[N, 3] unit vectors towards the visible side; zero = visible from both sides."""
    rgb: FloatArray  # [N, 3], lit by the sun
    owner: NDArray[np.intp]
    """[N] row in ``centers_ned_m`` of the object that a face belongs to. Of one object's visible
    faces, a later one is never hidden by an earlier one."""
    centers_ned_m: FloatArray
    """[M, 3] of the course's gates, the stray gates, then the panels and other objects."""


def course_faces(course: Course, conditions: Conditions = NOMINAL) -> Faces:
    """Build all surfaces of the course's gates, stray gates, panels and clutter.

    A stray gate has the shading of the course's gate with the same number.
    """
    random = np.random.Generator(np.random.PCG64((conditions.seed, 6)))
    is_shaded = random.random(len(course.gates)) < conditions.shaded_gates
    is_hidden = random.random(len(course.gates)) < conditions.hidden_gates
    gates = [*course.gates, *_stray_gates(course, conditions)]
    centers: list[ArrayLike] = [gate.center_ned_m for gate in gates]
    shown: list[tuple[int, Part]] = []  # each with its row in ``centers``
    for owner, gate in enumerate(gates):
        brightness = SHADE_BRIGHTNESS if is_shaded[gate.index] else 1.0
        parts = (_placed(part, gate) for part in _gate_parts(gate, conditions))
        shown += [(owner, _lit(part, conditions, brightness)) for part in parts]
    hidden = [gate for gate in course.gates if is_hidden[gate.index]]
    objects = [_placed(_panel(gate, conditions, random), gate) for gate in hidden]
    objects += [_lit(part, conditions) for part in clutter(course, conditions)]
    for part in objects:
        shown.append((len(centers), part))
        centers.append(part.corners_m.mean(axis=(0, 1)))
    return Faces(
        corners_ned_m=np.concatenate([part.corners_m for _, part in shown]),
        normals_ned=np.concatenate([part.normals for _, part in shown]),
        rgb=np.concatenate([part.rgb for _, part in shown]),
        owner=np.repeat([row for row, _ in shown], [len(part.normals) for _, part in shown]),
        centers_ned_m=np.array(centers),
    )


def _placed(part: Part, gate: Gate) -> Part:
    """Return a part in NED that is given in the gate's axes: forward, right, down."""
    cos_yaw, sin_yaw = math.cos(gate.yaw_rad), math.sin(gate.yaw_rad)
    ned_from_gate = np.array([[cos_yaw, -sin_yaw, 0], [sin_yaw, cos_yaw, 0], [0, 0, 1]])
    corners_m = part.corners_m @ ned_from_gate.T + gate.center_ned_m
    return Part(corners_m, part.normals @ ned_from_gate.T, part.rgb)


def _lit(part: Part, conditions: Conditions, brightness: float = 1.0) -> Part:
    """Return the part with the colours that the sun gives to each of its faces."""
    sun = np.maximum(0.0, part.normals @ np.array(conditions.sun_ned))
    light = (conditions.ambient + (1 - conditions.ambient) * sun) * brightness
    return part._replace(rgb=np.array(part.rgb) * light[:, None])


def _panel(gate: Gate, conditions: Conditions, random: np.random.Generator) -> Part:
    """Return a panel before the gate, beside the passage; the sun does not light it."""
    ahead_m, aside_m = -random.uniform(*PANEL_AHEAD_M), random.uniform(*PANEL_ASIDE_M)
    aside_m *= random.choice((-1.0, 1.0))
    down_m = (-gate.size_m, -gate.center_ned_m[2])
    rgb = tinted(PANEL_RGB, conditions.ground_tint)
    return _upright(ahead_m, aside_m, PANEL_WIDTH_M, down_m, BOTH_SIDES, rgb[None])


def _stray_gates(course: Course, conditions: Conditions) -> list[Gate]:
    """Return gates outside the course, with numbers and colours of gates on it."""
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


def _gate_parts(gate: Gate, look: Conditions) -> list[Part]:
    """Return the parts in drawing order: posts, inner walls, outer walls, back, front, number.

    The walls inside the opening come first, since any other part of the frame may hide them. Two
    visible faces among the outer walls and rings never hide each other.
    """
    inner_m = gate.size_m / 2
    bar_m, half_m = BAR_M * look.bar_factor, DEPTH_M / 2 * look.depth_factor
    outer_m, middle_m = inner_m + bar_m, inner_m + bar_m / 2
    own = gate.index % 2
    paints = np.array(look.gate_rgb, dtype=float)[[own, 1 - own if look.two_tone else own]]
    inside = (paints * INSIDE_BRIGHTNESS).round()
    to_ground_m = (outer_m, -gate.center_ned_m[2])
    number_m = (-middle_m - look.pip_m / 2, -middle_m + look.pip_m / 2)
    pips = [(k - gate.index / 2) * PIP_PITCH_M for k in range(gate.index + 1) if look.pip_m]
    backs = np.array([look.gate_back_rgb] * 2, dtype=float)
    back, front = (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)
    return [
        *(
            _upright(0.0, m, look.leg_m, to_ground_m, BOTH_SIDES, look.leg_rgb)
            for m in (-middle_m, middle_m)
            if look.leg_m
        ),
        _ring((-half_m, inner_m), (half_m, inner_m), (0.0, 0.0, 1.0), inside),
        _ring((-half_m, outer_m), (half_m, outer_m), (0.0, 0.0, -1.0), inside),
        _ring((half_m, outer_m), (half_m, inner_m), back, backs),
        _ring((-half_m, outer_m), (-half_m, inner_m), front, paints),
        *(_upright(-half_m, m, look.pip_m, number_m, front, look.pip_rgb) for m in pips),
    ]


def _upright(
    forward_m: float,
    middle_m: float,
    width_m: float,
    down_m: tuple[float, float],
    normal: Vec3,
    rgb: Rgb | FloatArray,
) -> Part:
    """Return a rectangle across the passage."""
    corners = ((0, -1), (0, 1), (1, 1), (1, -1))
    corners_m = [(forward_m, middle_m + side * width_m / 2, down_m[k]) for k, side in corners]
    return Part(np.array([corners_m]), np.array([normal]), rgb)


def _ring(
    one: tuple[float, float], other: tuple[float, float], top_normal: Vec3, paints: FloatArray
) -> Part:
    """Return the four faces between two squares around the passage's axis, the top one first.

    A square is given by its place along the passage and half its side. ``paints`` [2, 3] is the
    colour of top and bottom, then that of the sides.
    """
    (one_m, one_half_m), (other_m, other_half_m) = one, other
    top_m = np.array(
        [
            (one_m, -one_half_m, -one_half_m),
            (one_m, one_half_m, -one_half_m),
            (other_m, other_half_m, -other_half_m),
            (other_m, -other_half_m, -other_half_m),
        ]
    )
    turns = np.stack([np.linalg.matrix_power(_QUARTER_TURN, k) for k in range(4)])
    return Part(top_m @ turns, np.array(top_normal) @ turns, np.tile(paints, (2, 1)))


def ridge_directions(seed: int) -> FloatArray:
    """Return hills on the horizon, to show rotation: quadrilaterals of NED directions, [N, 4,
    3]."""
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
    """Return the colour table of sky and far ground, [256, 1, 3] uint8 RGB.

    Entry k is for a ray of unit depth that rises by k / 127.5 - 1.
    """
    up = np.linspace(-1.0, 1.0, 256)
    rgb = (*conditions.far_ground_rgb, *conditions.sky_rgb)
    channels = [np.interp(up, BACKDROP_RISES, [c[k] for c in rgb]) for k in range(3)]
    colours = (np.stack(channels, axis=1) * conditions.sky_tint).round().reshape(256, 1, 3)
    return np.asarray(np.clip(colours, 0, 255), dtype=np.uint8)


def ground_tile(conditions: Conditions = NOMINAL) -> Image:
    """Return a square of ground that repeats seamlessly, [GROUND_TILE_PX, GROUND_TILE_PX, 3] RGB.

    Mottled grass and soil (for optic flow), in fields if any, under a grid (for scale). Axis 0 is
    east, 1 north.
    """
    random = np.random.Generator(np.random.PCG64(conditions.ground_seed))
    patches = _periodic_noise(random, smooth_m=1.2)[..., None]
    speckle = _periodic_noise(random, smooth_m=0.06)[..., None]
    contrast = conditions.ground_contrast
    mix = np.clip(0.5 + 0.35 * contrast * patches + _fields(conditions.field_m), 0, 1)
    first, second = map(np.array, conditions.ground_rgb)
    ground = mix * first + (1 - mix) * second
    lit = ground * (1 + 0.13 * contrast * speckle) * conditions.ground_tint
    tile = np.asarray(np.clip(lit, 0, 255), dtype=np.uint8)
    if not conditions.grid_m:
        return tile
    grid_rgb = tinted(conditions.grid_rgb, conditions.ground_tint).tolist()
    pitch_px = round(conditions.grid_m * GROUND_TILE_PX / GROUND_TILE_M)
    for at_px in range(pitch_px // 2, GROUND_TILE_PX, pitch_px):
        cv2.line(tile, (at_px, 0), (at_px, GROUND_TILE_PX), grid_rgb, thickness=3)
        cv2.line(tile, (0, at_px), (GROUND_TILE_PX, at_px), grid_rgb, thickness=3)
    return tile


def _fields(field_m: tuple[float, float]) -> FloatArray:
    """Return what sets each pixel's field off, [GROUND_TILE_PX, GROUND_TILE_PX, 1]: -0.7 or 0.7; 0
    without fields."""
    at_m = np.arange(GROUND_TILE_PX) * (GROUND_TILE_M / GROUND_TILE_PX)
    east, north = (np.where(at_m % (2 * m) < m, 1.0, -1.0) if m else 0 * at_m + 1 for m in field_m)
    return np.outer(east, north)[..., None] * (0.7 if any(field_m) else 0.0)


def _periodic_noise(random: np.random.Generator, *, smooth_m: float) -> FloatArray:
    """Return noise of zero mean and unit variance, smoothed by a Gaussian in the frequency domain
    so that it has no seam."""
    frequency_per_m = np.fft.fftfreq(GROUND_TILE_PX, GROUND_TILE_M / GROUND_TILE_PX)
    low_pass = np.exp(-2 * (math.pi * smooth_m * frequency_per_m) ** 2)
    white = random.standard_normal((GROUND_TILE_PX, GROUND_TILE_PX))
    noise = np.fft.ifft2(np.fft.fft2(white) * np.outer(low_pass, low_pass)).real
    return np.asarray((noise - noise.mean()) / noise.std())
