import pytest
import torch
import torch.nn.functional as F

from policy.contract import Contract
from policy.errors import PolicyError
from policy.nets.action_head import DiffusionHead
from policy.nets.diffusion import NoiseSchedule
from policy.nets.names import Size
from policy.nets.unet1d import Conv, UNet1d


@pytest.fixture(scope="module")
def unet() -> UNet1d:
    torch.manual_seed(0)
    return UNet1d(horizon=16, condition_dim=32, widths=(16, 24, 32)).eval()


@pytest.mark.parametrize(("taps", "stride", "length"), [(1, 1, 4), (3, 1, 5), (3, 2, 8), (5, 1, 4)])
def test_conv_is_a_convolution(taps: int, stride: int, length: int) -> None:
    conv = Conv(6, 8, taps, stride=stride)
    x = torch.randn(2, length, 6)
    weight = conv.linear.weight.reshape(8, taps, 6).permute(0, 2, 1)
    expected = F.conv1d(
        x.transpose(1, 2), weight, conv.linear.bias, stride=stride, padding=taps // 2
    )
    torch.testing.assert_close(conv(x), expected.transpose(1, 2))


@torch.inference_mode()
def test_every_level_listens_to_time_and_condition(unet: UNet1d) -> None:
    noisy, condition = torch.randn(1, 16, 4), torch.randn(1, 32)
    base_film = unet.film_of_condition(condition)
    base = unet(noisy, base_film)
    for start in range(0, unet.film_dim, 16):
        film = base_film.clone()
        film[:, start : start + 16] += 1.0
        assert not torch.allclose(unet(noisy, film), base)
    early, late = unet.film_of_timestep(torch.tensor([0, 99]))
    assert not torch.allclose(early, late)


def test_refuses_a_horizon_that_cannot_be_halved() -> None:
    with pytest.raises(PolicyError, match="multiple of 4"):
        UNet1d(horizon=10, condition_dim=32, widths=(16, 24, 32))


@pytest.mark.parametrize(
    ("size", "low", "high"),
    [("small", 2.5e6, 3.5e6), ("medium", 10e6, 15e6), ("large", 36e6, 44e6)],
)
def test_head_sizes(size: Size, low: float, high: float) -> None:
    head = DiffusionHead(size, Contract(), NoiseSchedule())
    assert low < sum(p.numel() for p in head.parameters()) < high


@torch.inference_mode()
def test_hoisted_film_gives_what_denoising_step_by_step_gives() -> None:
    torch.manual_seed(0)
    head = DiffusionHead("small", Contract(), NoiseSchedule(prediction="epsilon")).eval()
    condition = torch.randn(2, 256)
    noisy = head.initial_noise.expand(2, -1, -1)
    for step in head.schedule.ddim_steps(4):
        output = head.denoise(noisy, torch.full((2,), step.timestep), condition)
        noisy = head.schedule.ddim_update(step, noisy, output)
    torch.testing.assert_close(head.sample(condition, 4), noisy, atol=1e-4, rtol=1e-3)
