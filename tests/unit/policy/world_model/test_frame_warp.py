"""Where pixels go when the vehicle turns and flies."""

import math

import cv2
import pytest
import torch
from torch import Tensor

from helpers.panoramas import FRD_FROM_FLU, attitude, nominal_lens, panorama, state_of
from policy.contract import Contract, StateFrame
from policy.data.samples import state_signs
from policy.world_model.autoencoder import to_bytes, to_unit
from policy.world_model.config import WorldModelConfig
from policy.world_model.frame_warp import FrameWarp, Poses, SourceFrame
from policy.world_model.relative_state import motion_since, poses_after, vertical_in_body

pytestmark = pytest.mark.usefixtures("one_thread")

SIZE, CELLS = 64, 8
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
@pytest.mark.parametrize("angles", [(0.3, 0.0, 0.0), (0.1, -0.1, 0.4), (0.0, 0.0, 3.0)])
def test_a_turn_shows_what_the_lens_of_the_evaluation_shows(angles, state_frame):
    lens, before, after = nominal_lens(SIZE), attitude(0.05, -0.1, 0.7), attitude(*angles)
    after = before @ after
    image = panorama(lens, before)
    rotation = before.T @ after
    if state_frame == "enu_flu":
        rotation = FRD_FROM_FLU @ rotation @ FRD_FROM_FLU
    made, in_view = make_warp(state_frame=state_frame).warp(
        seen(to_unit(torch.from_numpy(image[None]))), poses(torch.from_numpy(rotation))
    )
    wanted = lens.turned(image, before, after)
    assert cv2.PSNR(to_bytes(made[:, 0])[0].numpy(), wanted) > 40
    rays = lens.rays() @ (lens.frd_from_camera.T @ before.T @ after @ lens.frd_from_camera).T
    _, inside = lens.look_up(image, rays)
    # The lens counts up to the middles of the outermost pixels, the view up to their edges.
    assert (in_view[0, 0].numpy() >= inside).all()
    assert abs(in_view.float().mean() - inside.mean()) < 0.05


def test_what_is_ahead_grows_as_it_is_approached() -> None:
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
    now = torch.from_numpy(state_of(0.0, 0.0, math.pi / 2))[None]  # facing east
    now[:, :3] = torch.tensor([0.0, 2.0, 0.0])
    then = now[:, None].repeat(1, 3, 1)
    then[0, :, 1] = torch.tensor([4.0, 6.0, 8.0])
    rotation, position_m = poses_after(now, motion_since(now[:, None], then), 0.5)
    torch.testing.assert_close(rotation, torch.eye(3).expand(1, 3, 3, 3), atol=1e-6, rtol=0)
    expected = torch.tensor([[1.5, 4.0, 7.5], [0.0] * 3, [0.0] * 3]).T[None]
    torch.testing.assert_close(position_m, expected, atol=1e-5, rtol=0)


def test_a_mirrored_flight_sees_the_mirrored_frames() -> None:
    signs = torch.from_numpy(state_signs(13))
    before = torch.from_numpy(state_of(0.1, -0.1, 0.5))[None]
    after = torch.from_numpy(state_of(-0.2, 0.05, 0.9))[None, None]
    before[:, :3] = torch.tensor([3.0, 1.0, 0.4])
    after[..., :3] = torch.tensor([2.0, 2.0, -0.4])
    random = torch.Generator().manual_seed(0)
    pixels = torch.rand(1, 3, SIZE, SIZE, generator=random)
    inverse_depth = torch.randn(1, 2, 16, 16, generator=random)
    warp = make_warp()

    def warped(pixels: Tensor, inverse_depth: Tensor, before: Tensor, after: Tensor) -> Tensor:
        rotation, position_m = poses_after(before, motion_since(before[:, None], after), 0.1)
        at = Poses(rotation=rotation, position_m=position_m, progress=torch.full((1, 1), 0.5))
        frames, in_view = warp.warp(SourceFrame(pixels=pixels, inverse_depth=inverse_depth), at)
        return torch.cat([frames[0, 0], in_view[0].float()])

    plain = warped(pixels, inverse_depth, before, after)
    mirrored = warped(pixels.flip(-1), inverse_depth.flip(-1), before * signs, after * signs)
    torch.testing.assert_close(mirrored.flip(-1)[:3], plain[:3], atol=1e-3, rtol=0)
    assert (mirrored.flip(-1)[3] != plain[3]).float().mean() < 0.01  # at the very border
    assert not torch.allclose(plain[:3], pixels[0], atol=0.1)


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
