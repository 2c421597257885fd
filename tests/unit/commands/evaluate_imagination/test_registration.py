"""Turns recovered from pixels: the right size, the right sign, and not from flying forward."""

import numpy as np
import pytest

from helpers.panoramas import attitude, nominal_lens, panorama
from mavbridge.commands.evaluate_imagination.registration import turn_between
from mavbridge.core.records import ImageArray
from sitl.camera.fpv import FpvRenderer
from sitl.course.layout import make_course
from sitl.rotation import from_euler


@pytest.mark.parametrize("size", [32, 64])
@pytest.mark.parametrize(
    "turn",
    [(0.0, 0.0, 0.1), (0.0, 0.0, -0.1), (0.0, 0.06, 0.0), (0.08, 0.0, 0.0), (-0.03, 0.02, 0.05)],
)
def test_a_pan_is_recovered(size: int, turn: tuple[float, float, float]) -> None:
    lens = nominal_lens(size)
    before, after = panorama(lens, attitude()), panorama(lens, attitude(*turn))
    found = turn_between(before, after, lens, attitude())
    assert found == pytest.approx(turn, abs=0.006)


def test_it_is_told_in_body_axes_not_in_the_worlds() -> None:
    lens, rolled = nominal_lens(64), attitude(roll_rad=0.5)
    turned = rolled @ attitude(yaw_rad=0.08)
    found = turn_between(panorama(lens, rolled), panorama(lens, turned), lens, rolled)
    assert found == pytest.approx([0.0, 0.0, 0.08], abs=0.006)


def test_nothing_is_recovered_where_nothing_is_seen() -> None:
    grey = np.full((64, 64, 3), 90, np.uint8)
    assert np.abs(turn_between(grey, grey, nominal_lens(64), attitude())).max() == 0.0


def test_flying_forward_over_the_ground_is_no_turn() -> None:
    renderer = FpvRenderer(make_course(3), 64, 64)

    def view(ahead_m: float, roll_rad: float = 0.0, pitch_rad: float = 0.0) -> ImageArray:
        # Facing away from the gates: ground, hills and sky.
        turn = from_euler(roll_rad, pitch_rad, np.pi)
        return renderer.render((-20.0 - ahead_m, 0.0, -2.0), turn)

    lens, start = nominal_lens(64), attitude(yaw_rad=np.pi)
    straight = turn_between(view(0.0), view(0.5), lens, start)
    assert straight == pytest.approx([0.0, 0.0, 0.0], abs=0.01)
    turning = turn_between(view(0.0), view(0.5, 0.06, -0.05), lens, start)
    assert turning[:2] == pytest.approx([0.06, -0.05], abs=0.01)
