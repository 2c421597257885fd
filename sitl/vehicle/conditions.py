"""Differences between flights: airframe, firmware settings, wind, noise, light, lens.

The defaults are exactly the nominal vehicle and view. `random_conditions` draws others, so that a
policy generalises beyond this vehicle (Tobin et al., "Domain Randomization", 2017);
`sitl.vehicle.looks` also changes colours, objects and weather.
"""

import cmath
import colorsys
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TypeAlias, TypeVar

import numpy as np

from sitl.vehicle.rotation import Vec3

T = TypeVar("T")
Rgb: TypeAlias = tuple[int, int, int]
Hsv: TypeAlias = tuple[Vec3, Vec3]  # least and most hue, saturation and value, each in 0..1


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditions:
    """Conditions of one flight; factors of 1 and offsets of 0 change nothing.

    The fields from ``angle_max_cdeg`` to ``rate_gain_factor`` become firmware parameters, with
    ArduPilot's names and units (`sitl.ardupilot.params`). PX4 scales its parameters by the same
    factors (`sitl.px4.params`); its dead zones and expo do not vary.
    """

    seed: int = 0  # of gusts, sensor noise and image noise

    mass_factor: float = 1.0  # scales mass and inertia
    thrust_factor: float = 1.0  # scales full thrust: battery, propellers, air
    drag_factor: float = 1.0  # scales rotor and body drag
    min_rotor_drag_nspm: float = 0.0  # linear; an airframe with more keeps its own
    motor_lag_factor: float = 1.0
    wind_ned_mps: Vec3 = (0.0, 0.0, 0.0)  # mean velocity of the air
    gust_rms_mps: float = 0.0  # per horizontal axis; the vertical gust is half as strong
    gust_time_s: float = 1.5

    angle_max_cdeg: float = 3000.0
    pilot_yaw_rate_degps: float = 202.5
    pilot_yaw_expo: float = 0.0
    pilot_speed_up_cmps: float = 250.0
    pilot_speed_down_cmps: float = 0.0  # 0: equal to up
    pilot_accel_z_cmps2: float = 250.0
    throttle_dead_zone_permille: float = 100.0  # of the stick, to each side of the middle
    rc_dead_zones_us: tuple[float, ...] = (20.0, 20.0, 30.0, 20.0)  # roll, pitch, throttle, yaw
    input_time_s: float = 0.15  # time constant of the target lean behind the stick
    angle_gains_per_s: Vec3 = (6.0, 6.0, 3.0)  # roll, pitch, yaw
    lean_rate_max_degps: float = 220.0  # 0: no limit
    lean_accel_max_cdegps2: float = 110_000.0  # 0: no limit
    rate_gain_factor: float = 1.0  # gain from body rates to torque, roll and pitch

    stream_slowdown_ms: int = 0  # added to every interval, as with a full radio buffer
    stream_jitter_ms: float = 0.0  # largest random delay of a message
    stream_phase_spread: float = 0.0  # largest early start of a stream, as a share of its interval

    velocity_noise_mps: float = 0.0  # noise values: standard deviation per sample and axis
    rate_noise_radps: float = 0.0
    specific_force_noise_mps2: float = 0.0

    camera_tilt_rad: float = math.radians(10.0)  # upwards; racing quadrotors fly nose down
    camera_roll_rad: float = 0.0  # about the optical axis, right side down
    camera_yaw_rad: float = 0.0  # to the right
    camera_offset_body_m: Vec3 = (0.0, 0.0, 0.0)  # position of the camera in FRD body axes
    horizontal_fov_rad: float = math.radians(90.0)

    gate_rgb: tuple[Rgb, Rgb] = ((255, 126, 22), (222, 34, 48))  # even gates, odd gates
    gate_back_rgb: Rgb = (96, 98, 112)  # grey: the side that must not be entered
    pip_rgb: Rgb = (255, 248, 232)  # of the squares that count a gate's number
    pip_m: float = 0.16  # side of these squares; 0: none
    leg_rgb: Rgb = (58, 60, 68)
    leg_m: float = 0.09  # width of the two posts that reach down to the ground; 0: none
    bar_factor: float = 1.0  # on the drawn width of the bars around an opening
    depth_factor: float = 1.0  # on the drawn depth of a gate
    two_tone: float = 0.0  # 1: the upright bars of a gate have the other gates' colour
    sky_rgb: tuple[Rgb, ...] = ((226, 210, 194), (204, 214, 224), (126, 172, 222), (52, 100, 182))
    """From the horizon, whose colour is also that of haze, to the zenith."""
    far_ground_rgb: tuple[Rgb, ...] = ((78, 98, 66), (92, 108, 76), (168, 166, 146))
    """From straight down to the horizon."""
    ridge_rgb: Rgb = (150, 152, 170)
    haze_m: float = 90.0  # distance at which an object has lost 63 % of its contrast
    ground_fade_m: float = 14.0
    """Distance at which the ground has lost 3/4 of its contrast; farther texture would alias."""
    ground_rgb: tuple[Rgb, Rgb] = ((112, 116, 74), (62, 96, 62))  # soil, grass
    field_m: tuple[float, float] = (0.0, 0.0)
    """Width of alternating fields from west to east and from south to north, a divisor of 8; 0: no
    change in this direction."""
    grid_rgb: Rgb = (196, 200, 160)
    grid_m: float = 2.0  # pitch of the lines on the ground, a divisor of 16; 0: none
    clutter: float = 0.0  # objects for each gate, clear of the path
    lens_drops: float = 0.0  # on the lens

    ground_tint: Vec3 = (1.0, 1.0, 1.0)  # factors on red, green and blue
    sky_tint: Vec3 = (1.0, 1.0, 1.0)  # factors on red, green, blue; also tints haze and far ground
    ground_seed: int = 0  # seed of the pattern of grass and soil
    sun_ned: Vec3 = (-0.45, 0.35, -0.82)  # direction to the sun, unit length
    ambient: float = 0.78  # brightness of a surface turned away from the sun

    hidden_gates: float = 0.0  # share of gates with a panel before them, beside the path
    shaded_gates: float = 0.0  # share of gates in shadow
    stray_gates: float = 0.0  # share of gates with a stray gate beside them
    ground_contrast: float = 1.0  # factor on the ground's pattern
    glare: float = 0.0  # of the sun in the lens, as a share of white

    exposure_time_s: float = 0.0  # per row; turning smears the image
    readout_time_s: float = 0.0  # from first to last row; 0: a global shutter
    exposure: float = 1.0  # factor on all colours before saturation
    white_balance: Vec3 = (1.0, 1.0, 1.0)
    blur_px: float = 0.0  # standard deviation, in pixels of an image 224 pixels wide
    image_noise: float = 0.0  # standard deviation per channel, in levels of 0..255

    @property
    def frame_time_s(self) -> float:
        """Time from the first light of a frame to its last; the stamp is the middle."""
        return self.exposure_time_s + self.readout_time_s

    def numbers(self) -> dict[str, float]:
        """Return all numbers by name, for ``meta.json``; ``name_k`` is entry k of a vector."""
        flat: dict[str, float] = {}
        for name, value in asdict(self).items():
            for index, number in np.ndenumerate(value):
                flat["_".join((name, *map(str, index)))] = float(number)
        return flat


NOMINAL = Conditions()


def random_conditions(seed: int) -> Conditions:
    """Draw the conditions of this seed; they are the same on every machine."""
    conditions = replace(NOMINAL, seed=seed)
    draw = Draw(np.random.Generator(np.random.PCG64(seed)))
    for vary in _VARIATIONS:
        conditions = vary(conditions, draw)
    return conditions


class Draw:
    """Uniform draws around a nominal value."""

    def __init__(self, random: np.random.Generator) -> None:
        self.random = random

    def offset(self, half: float) -> float:
        return float(self.random.uniform(-half, half))

    def factor(self, most: float) -> float:
        """Return a factor within 1 / most .. most, as likely above 1 as below."""
        return math.exp(self.offset(math.log(most)))

    def amount(self, most: float) -> float:
        return self.between(0.0, most)

    def between(self, least: float, most: float) -> float:
        return float(self.random.uniform(least, most))

    def chance(self, share: float) -> bool:
        return bool(self.random.random() < share)

    def one_of(self, options: Sequence[T]) -> T:
        return options[int(self.random.integers(len(options)))]

    def colour(self, ranges: Hsv) -> Rgb:
        return _rgb_of(*self.random.uniform(*ranges).tolist())

    def tint(self, most: float) -> Vec3:
        """Return one factor each for red, green and blue."""
        return (self.factor(most), self.factor(most), self.factor(most))

    def light(self, most_tint: float, most_brightness: float) -> Vec3:
        red, green, blue = self.tint(most_tint)
        brightness = self.factor(most_brightness)
        return (brightness * red, brightness * green, brightness * blue)

    def angle_rad(self) -> float:
        """Return any direction."""
        return self.offset(math.pi)

    def shade(self, rgb: Rgb) -> Rgb:
        """Return a similar colour: hue within 20 degrees, paler or darker."""
        hue, saturation, value = colorsys.rgb_to_hsv(*(part / 255 for part in rgb))
        return _rgb_of(
            (hue + self.offset(20.0) / 360.0) % 1.0,
            max(0.3, saturation - self.amount(0.35)),
            max(0.3, value - self.amount(0.3)),
        )


def _rgb_of(hue: float, saturation: float, value: float) -> Rgb:
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, value)
    return (round(255 * red), round(255 * green), round(255 * blue))


def direction_ned(azimuth_rad: float, elevation_rad: float) -> Vec3:
    return (
        math.cos(elevation_rad) * math.cos(azimuth_rad),
        math.cos(elevation_rad) * math.sin(azimuth_rad),
        -math.sin(elevation_rad),
    )


def _vary_physics(nominal: Conditions, draw: Draw) -> Conditions:
    body = replace(
        nominal,
        mass_factor=draw.factor(1.12),
        thrust_factor=draw.factor(1.1),
        drag_factor=draw.factor(1.5),
    )
    wind_mps = cmath.rect(draw.amount(4.0), draw.angle_rad())
    return replace(
        body,
        wind_ned_mps=(wind_mps.real, wind_mps.imag, draw.offset(0.3)),
        gust_rms_mps=draw.amount(1.2),
        gust_time_s=1.5 * draw.factor(2.0),
        velocity_noise_mps=draw.amount(0.05),
        rate_noise_radps=draw.amount(0.01),
        specific_force_noise_mps2=draw.amount(0.3),
    )


def _vary_lens(nominal: Conditions, draw: Draw) -> Conditions:
    return replace(
        nominal,
        camera_tilt_rad=nominal.camera_tilt_rad + draw.offset(math.radians(6.0)),
        camera_roll_rad=draw.offset(math.radians(2.0)),
        camera_yaw_rad=draw.offset(math.radians(2.0)),
        camera_offset_body_m=(draw.offset(0.08), draw.offset(0.02), draw.offset(0.04)),
        horizontal_fov_rad=nominal.horizontal_fov_rad + draw.offset(math.radians(8.0)),
    )


def _vary_scene(nominal: Conditions, draw: Draw) -> Conditions:
    azimuth_rad = draw.angle_rad()
    elevation_rad = math.radians(draw.between(15.0, 80.0))
    first, second = nominal.gate_rgb
    return replace(
        nominal,
        gate_rgb=(draw.shade(first), draw.shade(second)),
        ground_tint=draw.light(1.25, 1.3),
        sky_tint=draw.light(1.1, 1.15),
        ground_seed=int(draw.random.integers(1 << 16)),
        sun_ned=direction_ned(azimuth_rad, elevation_rad),
        ambient=min(0.95, max(0.4, nominal.ambient + draw.offset(0.15))),
        exposure=draw.factor(1.3),
        white_balance=draw.tint(1.08),
        blur_px=draw.amount(0.9),
        image_noise=draw.amount(8.0),
    )


def _vary_firmware(nominal: Conditions, draw: Draw) -> Conditions:
    """Draw firmware settings: whole numbers for integer parameters, three decimals for floats."""
    lean_gain_factor = draw.factor(1.35)
    roll_gain, pitch_gain, yaw_gain = nominal.angle_gains_per_s
    return replace(
        nominal,
        angle_max_cdeg=round(nominal.angle_max_cdeg + draw.amount(1500.0)),
        pilot_yaw_rate_degps=round(nominal.pilot_yaw_rate_degps * draw.factor(1.4), 3),
        pilot_yaw_expo=round(min(0.6, draw.amount(0.3)), 3),
        pilot_speed_up_cmps=round(nominal.pilot_speed_up_cmps * draw.factor(1.4)),
        pilot_speed_down_cmps=round(nominal.pilot_speed_up_cmps * draw.factor(1.4)),
        pilot_accel_z_cmps2=round(nominal.pilot_accel_z_cmps2 * draw.factor(1.4)),
        throttle_dead_zone_permille=round(nominal.throttle_dead_zone_permille * draw.factor(1.4)),
        # 0..30 us covers common values of RCn_DZ.
        rc_dead_zones_us=tuple(float(round(draw.amount(30.0))) for _ in nominal.rc_dead_zones_us),
        input_time_s=round(nominal.input_time_s * draw.factor(1.6), 3),
        angle_gains_per_s=(
            round(roll_gain * lean_gain_factor, 3),
            round(pitch_gain * lean_gain_factor, 3),
            round(yaw_gain * draw.factor(1.35), 3),
        ),
        lean_rate_max_degps=round(nominal.lean_rate_max_degps * draw.factor(1.4)),
        lean_accel_max_cdegps2=round(nominal.lean_accel_max_cdegps2 * draw.factor(1.4)),
    )


def _vary_streams(nominal: Conditions, draw: Draw) -> Conditions:
    """Draw stream timing; half of the links send every message at the requested rate."""
    is_slow = draw.chance(0.5)
    slowdown_ms = round(draw.amount(23.0))
    return replace(
        nominal,
        stream_slowdown_ms=slowdown_ms if is_slow else 0,
        stream_jitter_ms=draw.amount(5.0),
        stream_phase_spread=min(1.0, draw.amount(1.0)),
    )


def _vary_airframe_and_shutter(nominal: Conditions, draw: Draw) -> Conditions:
    """Draw drag from a racing frame's to that of PX4's SIH, 1 N per m/s; half of the frames keep
    the lower drag. Exposure and read-out reach those of a common 30 Hz rolling shutter camera."""
    is_heavy = draw.chance(0.5)
    heavy_nspm = 0.15 * math.exp(draw.amount(math.log(1.0 / 0.15)))
    return replace(
        nominal,
        min_rotor_drag_nspm=heavy_nspm if is_heavy else 0.0,
        motor_lag_factor=draw.factor(1.5),
        rate_gain_factor=round(draw.factor(1.35), 3),
        exposure_time_s=draw.amount(0.012),
        readout_time_s=draw.amount(0.025),
        ground_contrast=draw.factor(1.5),
    )


_VARIATIONS = (
    _vary_physics,
    _vary_lens,
    _vary_scene,
    _vary_firmware,
    _vary_streams,
    _vary_airframe_and_shutter,
)
"""Order of the draws, which is part of the seed's meaning."""
