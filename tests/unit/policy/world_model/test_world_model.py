"""The world model without training: its two roles, its shapes, and what makes it repeatable."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from helpers.training_runs import SMALL_WORLD
from policy.contract import QUATERNION
from policy.errors import PolicyError
from policy.nets.diffusion import NoiseSchedule
from policy.nets.world_model.dynamics import Future
from policy.nets.world_model.model import Imagined, WorldModel
from policy.nets.world_model.motion import MOTION_DIM

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def model() -> WorldModel:
    """Not to be changed by a test."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return WorldModel(SMALL_WORLD).eval()


def images(count: int, seed: int = 0) -> Tensor:
    drawn = torch.randint(0, 256, (count, 32, 32, 3), generator=torch.Generator().manual_seed(seed))
    return drawn.to(torch.uint8)


def context(batch: int) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(1)
    states = torch.randn(batch, 2, 13, generator=random)
    states[..., QUATERNION] = torch.nn.functional.normalize(states[..., QUATERNION], dim=-1)
    return torch.randn(batch, 2, 4, 4, 4, generator=random), states


def actions(batch: int) -> Tensor:
    return torch.rand(batch, 4, 4, generator=torch.Generator().manual_seed(2)) * 2 - 1


def simulate(model: WorldModel, given: Tensor, *, seed: int = 0) -> Imagined:
    return model.sample(*context(len(given)), given, ddim_steps=3, noise_seed=seed)


def test_decision_makes_sticks(model: WorldModel) -> None:
    made = model.sample(*context(2), None, ddim_steps=2, noise_seed=0)
    assert made.actions.shape == (2, 4, 4)
    assert made.actions.abs().max() <= 1
    assert made.actions.std() > 0
    torch.testing.assert_close(made.states[..., QUATERNION].norm(dim=-1), torch.ones(2, 4))


def test_a_seed_repeats_itself_and_another_does_not(model: WorldModel) -> None:
    given = actions(1)
    torch.manual_seed(5)
    first = simulate(model, given, seed=7)
    torch.manual_seed(6)  # the process's own random stream plays no part
    assert torch.equal(first.latents, simulate(model, given, seed=7).latents)
    assert not torch.equal(first.latents, simulate(model, given, seed=8).latents)


def test_a_stick_changes_what_comes_after_it_and_nothing_before(model: WorldModel) -> None:
    given = actions(1)
    other = given.clone()
    other[:, 2] += 0.5
    plain, changed = simulate(model, given), simulate(model, other)
    assert torch.equal(plain.latents[:, :2], changed.latents[:, :2])
    assert torch.equal(plain.states[:, :2], changed.states[:, :2])
    for index in (2, 3):
        assert not torch.equal(plain.latents[:, index], changed.latents[:, index])
        assert not torch.equal(plain.states[:, index], changed.states[:, index])


def test_frames_are_coded_as_if_they_were_alone(model: WorldModel) -> None:
    frames = images(7)
    latents = model.encode(frames)
    assert torch.equal(latents[2:4], model.encode(frames[2:4]))
    shown = model.decode(latents)
    assert (shown.shape, shown.dtype) == (frames.shape, torch.uint8)
    assert torch.equal(shown[5:6], model.decode(latents[5:6]))
    strided = torch.stack([latents, latents], dim=-1)[..., 0]  # other strides, same numbers
    assert torch.equal(shown, model.decode(strided))
    assert model.decode(latents[:0]).shape == (0, 32, 32, 3)
    assert model.encode(frames[:0]).shape == (0, 4, 4, 4)


def test_gradient_reaches_every_weight() -> None:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = WorldModel(SMALL_WORLD)
    pixels = torch.randn(2, 3, 32, 32)
    mean, log_variance = model.autoencoder.posterior(pixels)
    loss = model.autoencoder.reconstruct(mean).square().mean() + log_variance.square().mean()
    latents, states = context(2)
    noisy = Future(
        latents=torch.randn(2, 4, 4, 4, 4),
        motion=torch.randn(2, 4, MOTION_DIM),
        actions=torch.randn(2, 4, 4),
    )
    known = torch.tensor([True, False])
    source = model.source_frame(latents[:, -1], states[:, -1])
    known_context = model.predict_motion(source, latents, states, noisy.actions, known)
    made = model.denoise(noisy, torch.tensor([3, 99]), known_context)
    assert torch.equal(made.actions[0], noisy.actions[0])
    loss = loss + sum(part.square().mean() for part in vars(made).values())
    poses = model.poses(states[:, -1], torch.ones(2, 4, MOTION_DIM))
    loss = loss + model.warp(source, poses)[0].square().mean()
    loss.backward()
    for name, weight in model.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.abs().sum() > 0, name


def test_unknown_sticks_do_not_change_the_warp(model: WorldModel) -> None:
    latents, states = context(2)
    source = model.source_frame(latents[:, -1], states[:, -1])
    known, unknown = torch.ones(2, dtype=torch.bool), torch.zeros(2, dtype=torch.bool)

    def warped(knows: Tensor, given: Tensor) -> Tensor:
        return model.predict_motion(source, latents, states, given, knows).warped

    given, other = actions(2), -actions(2)
    assert torch.equal(warped(unknown, given), warped(unknown, other))
    assert not torch.equal(warped(known, given), warped(known, other))


class CellCoder(nn.Module):
    """In place of an autoencoder: each latent is the colour of its cell."""

    def posterior(self, images: Tensor) -> tuple[Tensor, Tensor]:
        return functional.avg_pool2d(images, 8), images

    def reconstruct(self, latents: Tensor) -> Tensor:
        return functional.interpolate(latents, scale_factor=8)

    def normalise(self, latents: Tensor) -> Tensor:
        return latents

    denormalise = normalise


class KnownYaw(nn.Module):
    """In place of a motion predictor: knows the yaw of each frame, of unit scale as it is given."""

    def __init__(self, yaw_rad: Tensor) -> None:
        super().__init__()
        self._yaw_rad = yaw_rad

    def forward(self, features: Tensor, actions: Tensor, knows_actions: Tensor) -> Tensor:
        motion = torch.zeros(len(features), len(self._yaw_rad), MOTION_DIM)
        motion[..., 3], motion[..., 4] = self._yaw_rad.cos() - 1, self._yaw_rad.sin()
        motion[..., 6], motion[..., 7] = -self._yaw_rad.sin(), self._yaw_rad.cos() - 1
        return motion


def test_a_network_with_zero_output_shows_the_warped_last_frame() -> None:
    config = replace(SMALL_WORLD, image_size=64, latent_channels=3, camera_tilt_rad=0.0)
    model = WorldModel(config).eval()
    # By the first yaw, a column of cells comes to where its left neighbour was, in the middle.
    yaw_rad = torch.tensor([0.0, 1.0, -1.0, 3.0]) * torch.tensor(8 / 32).atan()
    model.autoencoder, model.motion_predictor = CellCoder(), KnownYaw(yaw_rad)  # type: ignore[assignment]
    model.motion_std.fill_(1.0)
    for out in (model.dynamics.out_patch, model.dynamics.out_vehicle):
        out.weight.data.zero_()
    latents = torch.zeros(1, 2, 3, 8, 8)
    latents[:, 1, 0, :, 4] = 1.0  # right of the middle
    states = torch.zeros(1, 2, 13)
    states[..., QUATERNION.start] = 1.0
    made = model.sample(latents, states, actions(1), ddim_steps=2, noise_seed=0).latents[0, :, 0]
    torch.testing.assert_close(made[0], latents[0, 1, 0], atol=1e-4, rtol=0)
    assert (made[1, 3:5].argmax(dim=-1) == 3).all()
    assert (made[2, 3:5].argmax(dim=-1) == 5).all()
    source = model.source_frame(latents[:, -1], states[:, -1])
    known = torch.ones(1, dtype=torch.bool)
    in_view = model.predict_motion(source, latents, states, actions(1), known).in_view[0, :, 0]
    assert (in_view[0] == 1).all()
    assert (in_view[3, :, -1] == 0).all()  # has come in from the right
    assert (in_view[3, 3:5, 0] == 1).all()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"image_size": 40}, "multiple of 16"),
        ({"schedule": NoiseSchedule(prediction="epsilon")}, "predict the sample"),
    ],
)
def test_shapes_that_cannot_be_built_are_refused(changes, says):
    with pytest.raises(PolicyError, match=says):
        replace(SMALL_WORLD, **changes)
