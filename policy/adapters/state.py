"""The state as policies of other people's take it: other numbers made of the contract's.

    vx_body_mps, vy_body_mps, vz_body_mps    velocity in the axes of the body
    vertical_x, vertical_y, vertical_z       the world's third axis in the axes of the body
    roll_rad, pitch_rad, yaw_rad             Euler angles of the attitude, turned in the order
                                             yaw, pitch, roll; signs by the contract's frame

The first six are the same on every heading, so a network that takes them has no rotations to learn.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from policy.contract import QUATERNION, STATE_NAMES
from policy.preprocess import egocentric_columns
from policy.rotation import matrix_columns

EGOCENTRIC_NAMES = (
    *("vx_body_mps", "vy_body_mps", "vz_body_mps"),
    *("vertical_x", "vertical_y", "vertical_z"),
)
EULER_NAMES = ("roll_rad", "pitch_rad", "yaw_rad")
DERIVED_NAMES = (*EGOCENTRIC_NAMES, *EULER_NAMES)
BODY_STATE_NAMES = (*EGOCENTRIC_NAMES, *STATE_NAMES[QUATERNION.stop :])
"""A state without a heading: velocity, vertical axis, rates and specific force of the body."""


def state_values(
    columns: Sequence[Any],
    names: Sequence[str],
    wanted: Sequence[str],
    arctan2: Callable[[Any, Any], Any] = np.arctan2,
) -> list[Any]:
    """The ``wanted`` numbers of a state whose ``columns`` are called ``names``.

    ``names`` begin with ``STATE_NAMES``; columns are floats or arrays of any kind, torch's too, and
    ``arctan2`` is that of their library.
    """
    known = dict(zip(names, columns, strict=True))
    base = [known[name] for name in STATE_NAMES]
    if set(wanted) & set(EGOCENTRIC_NAMES):
        known |= dict(zip(EGOCENTRIC_NAMES, egocentric_columns(base), strict=False))
    if set(wanted) & set(EULER_NAMES):
        forward, side, up = matrix_columns(*base[QUATERNION])
        level = (forward[0] * forward[0] + forward[1] * forward[1]) ** 0.5
        known["roll_rad"] = arctan2(side[2], up[2])
        known["pitch_rad"] = arctan2(-forward[2], level)
        known["yaw_rad"] = arctan2(forward[1], forward[0])
    return [known[name] for name in wanted]
