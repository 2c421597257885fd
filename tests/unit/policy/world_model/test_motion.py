"""States as changes since now, and where pixels go when the vehicle turns and flies."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.factories import about_z
from policy.contract import QUATERNION, VELOCITY, Contract, StateFrame
from policy.motion import rotation
from policy.nets.world_model.config import WorldModelConfig
from policy.nets.world_model.motion import (
    FrameWarp,
    Poses,
    SourceFrame,
    context_features,
    motion_since,
    poses_after,
    state_after,
    vertical_in_body,
)

pytestmark = pytest.mark.usefixtures("one_thread")

SIZE, CELLS = 64, 8
FRD_FROM_FLU = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
TILT_RAD = math.radians(10.0)


def make_warp(*, tilt_rad: float = TILT_RAD, state_frame: StateFrame = "ned_frd") -> FrameWarp:
    config = WorldModelConfig(
        latent_channels=1,
        image_size=SIZE,
        horizontal_fov_rad=math.radians(90.0),
        camera_tilt_rad=tilt_rad,
        contract=Contract(state_frame=state_frame),
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return FrameWarp(config)


def poses(rotation: Tensor, position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Poses:
    """One moment of one flight."""
    return Poses(
        rotation=rotation.float().reshape(1, 1, 3, 3),
        position_m=torch.tensor(position_m).reshape(1, 1, 3),
        progress=torch.ones(1, 1),
    )


def seen(pixels: Tensor, inverse_depth: float = -3.0) -> SourceFrame:
    """The same inverse_depth everywhere, before softplus."""
    level = torch.tensor([inverse_depth, 0.0]).view(1, 2, 1, 1).expand(len(pixels), 2, 16, 16)
    return SourceFrame(pixels=pixels, inverse_depth=level)


def rotation_about(axis: int, angle_rad: float) -> Tensor:
    """From FRD axes after a turn about one of them to those before it."""
    turn = torch.eye(3)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turn[first, first] = turn[second, second] = math.cos(angle_rad)
    turn[first, second], turn[second, first] = -math.sin(angle_rad), math.sin(angle_rad)
    return turn


def spot(across_px: float, down_px: float) -> Tensor:
    """A frame [1, 3, SIZE, SIZE] with a soft spot so far from its middle."""
    at = torch.arange(SIZE) - (SIZE - 1) / 2
    y, x = torch.meshgrid(at, at, indexing="ij")
    bright = (-((x - across_px) ** 2 + (y - down_px) ** 2) / 18.0).exp()
    return (2.0 * bright - 1.0).expand(1, 3, SIZE, SIZE)


def place_of(frame: Tensor) -> tuple[float, float]:
    """Of its spot, pixels right and down of the middle."""
    bright = (frame[0, 0, 0] + 1.0) / 2.0
    at = torch.arange(SIZE) - (SIZE - 1) / 2
    total = bright.sum()
    return float((bright.sum(0) * at).sum() / total), float((bright.sum(1) * at).sum() / total)


@pytest.mark.parametrize("state_frame", ["ned_frd", "enu_flu"])
def test_a_turn_moves_what_is_far_by_its_angle(state_frame: StateFrame) -> None:
    angle = math.atan(8 / (SIZE / 2))  # eight pixels beside the middle
    level = make_warp(tilt_rad=0.0, state_frame=state_frame)
    rolled = 10.0 * math.cos(angle), -10.0 * math.sin(angle)
    for axis, start, expected in (
        (2, (0.0, 0.0), (-8.0, 0.0)),
        (1, (0.0, 0.0), (0.0, 8.0)),
        (0, (10.0, 0.0), rolled),
    ):
        turn = rotation_about(axis, angle)
        if state_frame == "enu_flu":
            turn = FRD_FROM_FLU @ turn @ FRD_FROM_FLU
        made, in_view = level.warp(seen(spot(*start)), poses(turn))
        assert place_of(made) == pytest.approx(expected, abs=0.5)
        assert not in_view.all()
    tilted = make_warp(state_frame=state_frame)
    made, _ = tilted.warp(seen(spot(5.0, 5.0)), poses(torch.eye(3)))
    assert place_of(made) == pytest.approx((5.0, 5.0), abs=0.1)


def test_objects_ahead_grow_on_approach() -> None:
    distance_m, flown_m = 10.0, 4.0
    wall = math.log(math.expm1(1.0 / (distance_m - flown_m)))  # softplus makes that of it
    for state_frame in ("ned_frd", "enu_flu"):
        level = make_warp(tilt_rad=0.0, state_frame=state_frame)
        forward = poses(torch.eye(3), (flown_m, 0.0, 0.0))
        made, in_view = level.warp(seen(spot(9.0, -6.0), wall), forward)
        growth = distance_m / (distance_m - flown_m)
        assert place_of(made) == pytest.approx((9.0 * growth, -6.0 * growth), abs=0.3)
        assert in_view.all()
        down = poses(torch.eye(3), (0.0, 0.0, 1.0 if state_frame == "ned_frd" else -1.0))
        made, in_view = level.warp(seen(spot(0.0, 0.0), wall), down)
        assert place_of(made) == pytest.approx((0.0, -32.0 / (distance_m - flown_m)), abs=0.3)
        assert not in_view.all()


def test_the_translation_is_the_integral_of_the_velocity_in_the_axes_of_now() -> None:
    now = torch.zeros(1, 13)
    now[0, 3] = now[0, 6] = 0.5**0.5  # facing east
    now[0, 1] = 2.0
    then = now[:, None].repeat(1, 3, 1)
    then[0, :, 1] = torch.tensor([4.0, 6.0, 8.0])
    after = poses_after(now, motion_since(now[:, None], then), 0.5)
    torch.testing.assert_close(after.rotation, torch.eye(3).expand(1, 3, 3, 3), atol=1e-6, rtol=0)
    expected = torch.tensor([[1.5, 4.0, 7.5], [0.0] * 3, [0.0] * 3]).T[None]
    torch.testing.assert_close(after.position_m, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("state_frame", ["ned_frd", "enu_flu"])
def test_the_attitude_tells_where_the_ground_is(state_frame: StateFrame) -> None:
    warp = make_warp(state_frame=state_frame)
    seen_inputs: list[Tensor] = []
    warp.inverse_depth[0].register_forward_pre_hook(lambda _, given: seen_inputs.append(given[0]))
    state = torch.zeros(2, 13)
    state[0, 3] = 1.0  # level
    state[1, 4] = 1.0  # upside down
    warp.source(
        torch.zeros(2, 3, SIZE, SIZE), torch.zeros(2, 1, CELLS, CELLS), vertical_in_body(state)
    )
    level, inverted = seen_inputs[0][:, 1]
    # At a tilt of 10 degrees the horizon is 5.6 pixels below the middle.
    assert (level[:4] == 0).all()
    assert (level[5:] > 0).all()
    assert (level.diff(dim=0) >= 0).all()
    assert (inverted[:4] > 0).all()
    assert (inverted[5:] == 0).all()


def random_states(count: int, seed: int = 0) -> Tensor:
    """Any attitude, also upside down; w >= 0."""
    random = np.random.default_rng(seed)
    states = random.normal(size=(count, 13))
    quaternion = states[:, QUATERNION] / np.linalg.norm(states[:, QUATERNION], axis=1)[:, None]
    states[:, QUATERNION] = np.where(quaternion[:, :1] < 0, -quaternion, quaternion)
    return torch.from_numpy(states.astype(np.float32))


def turned(states: Tensor, by: np.ndarray) -> Tensor:
    """The same flight with the world turned by a quaternion; bodies stay as they are."""
    out = states.numpy().astype(np.float64)
    out[:, QUATERNION] = rotation.multiply(by, out[:, QUATERNION])
    out[:, VELOCITY] = rotation.rotate(np.broadcast_to(by, (len(out), 4)), out[:, VELOCITY])
    return torch.from_numpy(out.astype(np.float32))


def test_a_motion_leads_back_to_the_state() -> None:
    now, then = random_states(500), random_states(500, seed=1)
    again = state_after(now, motion_since(now, then))
    torch.testing.assert_close(again, then, atol=2e-5, rtol=0)


def test_features_do_not_depend_on_the_heading() -> None:
    by = about_z(np.array([1.1]))[0]
    past, then = random_states(2), random_states(7, seed=1)
    past_turned, then_turned = turned(past, by), turned(then, by)
    torch.testing.assert_close(
        context_features(past_turned[None], Contract()),
        context_features(past[None], Contract()),
        atol=1e-5,
        rtol=0,
    )
    motion = motion_since(past[1], then)
    torch.testing.assert_close(motion_since(past_turned[1], then_turned), motion, atol=1e-5, rtol=0)
