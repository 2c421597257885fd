"""Looks of a flight beyond `random_conditions`: those of demonstrations, and those held back.

No demonstration turns on anything that `held_out_conditions` or `unseen_conditions` changes.
"""

import math
from dataclasses import replace

import numpy as np

from sitl.vehicle.conditions import Conditions, Draw, Hsv, Rgb, direction_ned, random_conditions

PLAIN_SHARE, VARIED_SHARE = 1 / 3, 0.8
"""Shares of demonstrations with the look of ``random_conditions``; of the others in which each of
sky, ground, gates and the rest is another."""

SKIES: tuple[tuple[Hsv, Hsv], ...] = (
    (((0.50, 0.0, 0.8), (0.62, 0.3, 1.0)), ((0.55, 0.4, 0.6), (0.65, 0.9, 0.9))),  # clear
    (((0.50, 0.0, 0.7), (0.65, 0.1, 1.0)), ((0.50, 0.0, 0.6), (0.65, 0.15, 0.9))),  # overcast
    (((0.0, 0.3, 0.7), (0.13, 0.8, 1.0)), ((0.58, 0.2, 0.5), (0.85, 0.6, 0.75))),  # dusk
    (((0.0, 0.1, 0.65), (1.0, 0.6, 1.0)), ((0.0, 0.1, 0.55), (1.0, 0.7, 1.0))),  # any tint
)
"""Horizon and zenith."""
GROUNDS: tuple[Hsv, ...] = (
    ((0.18, 0.3, 0.3), (0.40, 0.7, 0.7)),  # grass
    ((0.04, 0.2, 0.35), (0.13, 0.65, 0.9)),  # soil, sand
    ((0.0, 0.0, 0.25), (1.0, 0.1, 0.7)),  # asphalt, concrete
    ((0.50, 0.0, 0.85), (0.65, 0.08, 1.0)),  # snow
    ((0.0, 0.1, 0.4), (1.0, 0.8, 0.95)),  # carpet, tiles
)
PAINTS: tuple[Hsv, ...] = (
    ((0.0, 0.6, 0.5), (1.0, 1.0, 1.0)),  # bright
    ((0.0, 0.6, 0.5), (1.0, 1.0, 1.0)),
    ((0.0, 0.3, 0.25), (1.0, 0.7, 1.0)),  # pale, dark
    ((0.0, 0.0, 0.85), (1.0, 0.06, 1.0)),  # white
    ((0.0, 0.0, 0.04), (1.0, 0.15, 0.2)),  # black
)


def training_conditions(seed: int) -> Conditions:
    """Return ``random_conditions``, in two flights of three with other colours and objects."""
    conditions = random_conditions(seed)
    draw = Draw(np.random.Generator(np.random.PCG64((seed, 11))))
    if draw.chance(PLAIN_SHARE):
        return conditions
    for vary in (_vary_sky, _vary_ground, _vary_gates, _vary_light_and_clutter):
        if draw.chance(VARIED_SHARE):
            conditions = vary(conditions, draw)
    return conditions


def held_out_conditions(seed: int) -> Conditions:
    """Return vehicle, wind and lens of ``random_conditions`` with a look that no demonstration has.

    One seed in five each: gates partly hidden by panels; gates in shadow over high-contrast ground;
    night with shining gates; a low sun in the lens; stray gates beside the path.
    """
    conditions = random_conditions(seed)
    draw = Draw(np.random.Generator(np.random.PCG64((seed, 7))))
    match seed % 5:
        case 0:
            return replace(conditions, hidden_gates=0.7)
        case 1:
            return replace(conditions, shaded_gates=0.6, ground_contrast=2.0 * draw.factor(1.3))
        case 2:
            return _make_night(conditions, draw)
        case 3:
            return _make_glare(conditions, draw)
    return replace(conditions, stray_gates=0.8)


def unseen_conditions(seed: int) -> Conditions:
    """Return ``random_conditions`` in dense fog (even seeds) or through a dirty lens (odd)."""
    conditions = random_conditions(seed)
    draw = Draw(np.random.Generator(np.random.PCG64((seed, 12))))
    if seed % 2:
        return replace(conditions, lens_drops=8.0 + round(draw.amount(8.0)))
    grey, sight_m = draw.colour(((0.0, 0.0, 0.55), (0.0, 0.0, 0.85))), draw.between(12.0, 25.0)
    return replace(
        conditions,
        sky_rgb=(grey,) * len(conditions.sky_rgb),
        far_ground_rgb=(grey,) * len(conditions.far_ground_rgb),
        ridge_rgb=grey,
        sky_tint=(1.0, 1.0, 1.0),
        ambient=1.0,
        haze_m=sight_m / 3,
        ground_fade_m=sight_m / 4,
    )


def _mixed(first: Rgb, second: Rgb, share: float) -> Rgb:
    """Return a colour that is ``share`` of the second."""
    red, green, blue = (round(a + share * (b - a)) for a, b in zip(first, second, strict=True))
    return (red, green, blue)


def _vary_sky(usual: Conditions, draw: Draw) -> Conditions:
    """Draw sky, hills and exposure: down to half of the usual brightness, but no night."""
    horizon, zenith = map(draw.colour, draw.one_of(SKIES))
    below, near, _ = usual.far_ground_rgb
    return replace(
        usual,
        sky_rgb=tuple(_mixed(horizon, zenith, share) for share in (0.0, 0.25, 0.7, 1.0)),
        far_ground_rgb=(below, near, _mixed(near, horizon, 0.5)),
        ridge_rgb=_mixed(draw.colour(draw.one_of(GROUNDS)), horizon, draw.between(0.3, 0.8)),
        exposure=draw.between(0.65, 1.25),
    )


def _vary_ground(usual: Conditions, draw: Draw) -> Conditions:
    """Draw two colours, of one kind of ground or two, and fields and lines."""
    kind, other = draw.one_of(GROUNDS), draw.one_of(GROUNDS)
    first, second = draw.colour(kind), draw.colour(draw.one_of((kind, other)))
    second = _mixed(first, second, draw.between(0.2, 1.0))
    near = _mixed(first, second, 0.5)
    width_m = draw.one_of((0.5, 1.0, 2.0, 4.0))
    stripes = ((0.0, 0.0), (0.0, 0.0), (width_m, width_m), (width_m, 0.0), (0.0, width_m))
    return replace(
        usual,
        ground_rgb=(first, second),
        ground_tint=draw.tint(1.1),
        far_ground_rgb=(near, near, _mixed(near, usual.sky_rgb[0], 0.5)),
        field_m=draw.one_of(stripes),
        grid_m=draw.one_of((0.0, 0.0, 1.0, 2.0, 4.0)),
        grid_rgb=draw.colour(draw.one_of(GROUNDS)),
    )


def _vary_gates(usual: Conditions, draw: Draw) -> Conditions:
    """Draw the make of the gates. Of two colours, they have the one that stands out more."""
    around = (*usual.sky_rgb, *usual.far_ground_rgb, *usual.ground_rgb)

    def paint() -> Rgb:
        drawn = [draw.colour(draw.one_of(PAINTS)) for _ in range(2)]
        return max(drawn, key=lambda rgb: min(math.dist(rgb, other) for other in around))

    first, second = paint(), paint()
    return replace(
        usual,
        gate_rgb=(first, first if draw.chance(0.3) else second),
        two_tone=float(draw.chance(0.3)),
        gate_back_rgb=draw.colour(((0.0, 0.0, 0.1), (1.0, 0.15, 0.6))),
        bar_factor=draw.between(0.7, 1.3),
        depth_factor=draw.between(0.6, 1.6),
        pip_rgb=draw.one_of((usual.pip_rgb, draw.colour(draw.one_of(PAINTS)))),
        pip_m=draw.between(0.12, 0.2) * draw.chance(0.65),
        leg_rgb=draw.colour(draw.one_of(GROUNDS)),
        leg_m=draw.between(0.04, 0.16) * draw.chance(0.6),
    )


def _vary_light_and_clutter(usual: Conditions, draw: Draw) -> Conditions:
    return replace(
        usual,
        sun_ned=direction_ned(draw.angle_rad(), math.radians(draw.between(5.0, 90.0))),
        ambient=draw.between(0.5, 1.0),
        clutter=draw.between(1.0, 5.0),
    )


def _make_night(usual: Conditions, draw: Draw) -> Conditions:
    sky, ground = 0.12 * draw.factor(1.5), 0.2 * draw.factor(1.5)
    return replace(
        usual,
        sky_tint=(sky, sky, 1.3 * sky),
        ground_tint=(ground, ground, ground),
        ambient=1.0,
        image_noise=10.0 + draw.amount(6.0),
    )


def _make_glare(usual: Conditions, draw: Draw) -> Conditions:
    """Put the sun ahead on the first leg, up to 60 degrees to either side."""
    azimuth_rad, elevation_rad = draw.offset(math.pi / 3), math.radians(4.0 + draw.amount(14.0))
    return replace(
        usual, glare=0.5 + draw.amount(0.5), sun_ned=direction_ned(azimuth_rad, elevation_rad)
    )
