"""The recorded camera: against the simulator's own, which shares no code with it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from helpers.panoramas import NOMINAL, attitude, nominal_lens, panorama, state_of
from helpers.recordings import make_meta
from mavbridge.commands.evaluate_imagination.lens import attitudes, body_rates, make_lens
from mavbridge.commands.evaluate_imagination.metrics import psnr_db
from mavbridge.core.records import ImageArray
from sitl.camera.fpv import FpvRenderer
from sitl.course.layout import make_course
from sitl.rotation import from_euler
from sitl.vehicle.conditions import Conditions

SIZE = 64
ODD = Conditions(
    horizontal_fov_rad=1.2, camera_tilt_rad=0.35, camera_roll_rad=0.06, camera_yaw_rad=-0.08
)
TOLD = {
    name: getattr(ODD, name)
    for name in ("horizontal_fov_rad", "camera_tilt_rad", "camera_roll_rad", "camera_yaw_rad")
}


def view(angles: tuple[float, float, float], conditions: Conditions) -> ImageArray:
    """Of the simulator's gates and ground."""
    renderer = FpvRenderer(make_course(3), SIZE, SIZE, conditions)
    return renderer.render((0.0, 0.0, -2.0), from_euler(*angles))


TURNS = [(0.2, 0.0, 0.0), (0.0, 0.15, 0.0), (0.0, 0.0, 0.2), (0.15, -0.1, 0.2)]


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("is_told", [False, True])
def test_the_warp_makes_what_the_simulator_shows_after_the_turn(
    turn: tuple[float, float, float], is_told: bool
) -> None:
    conditions = ODD if is_told else Conditions()
    lens = make_lens(make_meta(conditions=TOLD if is_told else {}), SIZE, NOMINAL)
    assert lens.is_recorded == is_told
    start = (0.05, -0.1, -0.1)
    end = tuple(a + b for a, b in zip(start, turn, strict=True))
    before, after = view(start, conditions), view(end, conditions)  # type: ignore[arg-type]
    made = lens.turned(before, attitude(*start), attitude(*end))
    inner = slice(16, -16)  # what has come in from outside is not known
    warped = psnr_db(made[inner, inner].copy(), after[inner, inner].copy())
    copied = psnr_db(before[inner, inner].copy(), after[inner, inner].copy())
    back = lens.turned(before, attitude(*end), attitude(*start))
    wrong = psnr_db(back[inner, inner].copy(), after[inner, inner].copy())
    assert warped > max(copied, wrong) + 3


def test_no_turn_changes_nothing_and_half_a_turn_is_all_border() -> None:
    lens = nominal_lens(SIZE)
    image = panorama(lens, attitude())
    assert psnr_db(lens.turned(image, attitude(), attitude()), image) > 60
    behind = lens.turned(image, attitude(), attitude(yaw_rad=math.pi))
    border = {tuple(pixel) for pixel in image[:, [0, -1]].reshape(-1, 3)}
    border |= {tuple(pixel) for pixel in image[[0, -1]].reshape(-1, 3)}
    assert {tuple(pixel) for pixel in behind[:, 0].reshape(-1, 3)} <= border


def test_an_oblong_camera_squeezed_into_a_square_has_two_focal_lengths() -> None:
    lens = make_lens(make_meta(source_width=640, source_height=480), SIZE, NOMINAL)
    assert lens.focal_px == pytest.approx((32.0, 32.0 * 640 / 480))
    edge = lens.rays()[SIZE // 2, -1]
    assert math.atan2(edge[0], edge[2]) == pytest.approx(math.radians(45), abs=0.02)


def test_the_assumed_lens_is_what_was_given() -> None:
    lens = make_lens(make_meta(), SIZE, replace(NOMINAL, tilt_up_rad=0.0))
    forward = lens.frd_from_camera @ [0.0, 0.0, 1.0]
    assert forward == pytest.approx([1.0, 0.0, 0.0])


def test_states_of_ros_are_the_same_attitude_and_rates() -> None:
    ned = state_of(0.1, 0.2, 0.3)
    ned[7:10] = (0.5, 0.6, 0.7)
    # world: east north up; body: forward left up.
    enu_from_ned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    enu_from_flu = enu_from_ned @ attitude(0.1, 0.2, 0.3) @ np.diag([1.0, -1.0, -1.0])
    enu = ned.copy()
    enu[3:7] = _quaternion(enu_from_flu)
    enu[7:10] = (0.5, -0.6, -0.7)
    assert attitudes(enu, "enu_flu") == pytest.approx(attitudes(ned, "ned_frd"), abs=1e-6)
    assert body_rates(enu, "enu_flu") == pytest.approx(body_rates(ned, "ned_frd"))


def _quaternion(matrix: np.ndarray) -> list[float]:
    w = math.sqrt(1 + np.trace(matrix)) / 2
    x, y, z = (
        (matrix[2, 1] - matrix[1, 2]) / (4 * w),
        (matrix[0, 2] - matrix[2, 0]) / (4 * w),
        (matrix[1, 0] - matrix[0, 1]) / (4 * w),
    )
    return [w, x, y, z]
