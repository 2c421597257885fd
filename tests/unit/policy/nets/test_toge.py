import pytest
import torch
from torch import Tensor

from policy.checkpoints.policy_file import BuiltinPolicy
from policy.contract import Contract
from policy.errors import ContractError, PolicyError
from policy.nets.action_head import DiffusionHead
from policy.nets.diffusion import NoiseSchedule
from policy.nets.names import Size
from policy.nets.resnet_unet import ResnetUnet, ResnetUnetConfig
from policy.nets.toge import Toge, TogeConfig
from policy.protocol import DualRatePolicy, SingleRatePolicy


def sample(batch: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """Image, state, history for ``small_toge``."""
    generator = torch.Generator().manual_seed(2)
    image = torch.randn(batch, 3, 32, 32, generator=generator)
    state = torch.randn(batch, 13, generator=generator)
    return image, state, torch.rand(batch, 4, 4, generator=generator) * 2 - 1


@torch.inference_mode()
@pytest.mark.parametrize("steps", [1, 4, 10])
@pytest.mark.parametrize("with_history", [True, False])
def test_both_paths_agree_bit_for_bit(small_toge: Toge, steps: int, with_history: bool) -> None:
    image, state, history = sample()
    past = history if with_history else None
    direct = small_toge.predict(image, state, past, steps)
    cached = small_toge.predict_fast(small_toge.encode_visual(image), state, past, steps)
    assert torch.equal(direct, cached)
    centred = small_toge.predict(image, state, history * 0, steps)
    assert torch.equal(direct, centred) != with_history, "nothing sent yet reads as centred sticks"
    assert direct.shape == (1, 16, 4)
    assert direct.abs().max() <= 1.0


def test_state_is_scaled_by_the_documented_constants(small_toge: Toge) -> None:
    # Heading east (yaw 90 degrees) and level: 5 m/s to the north is 5 m/s to the left.
    r = 0.5**0.5
    state = torch.tensor([[5.0, 0, -10, r, 0, 0, r, 3, 0, -1.5, 0, 0, -9.80665]])
    expected = torch.tensor([[0.0, -1, -2, 0, 0, 1, 1, 0, -0.5, 0, 0, -1]])
    torch.testing.assert_close(small_toge.state_encoder.normalise(state), expected)


@torch.inference_mode()
def test_a_seed_fixes_the_noise_of_a_flight() -> None:
    torch.manual_seed(0)
    config = TogeConfig(
        backbone="resnet18",
        contract=Contract(image_height=32, image_width=32),
        schedule=NoiseSchedule(prediction="epsilon"),
    )
    policy = Toge(config).eval()
    chunks = []
    for seed in (7, 7, 8):
        policy.seed_noise(seed)
        chunks.append(policy.predict(*sample(), 3))
    assert torch.equal(chunks[0], chunks[1])
    assert not torch.equal(chunks[0], chunks[2])
    assert torch.equal(policy.predict(*sample(), 3), chunks[2])
    assert not any("noise" in name for name in policy.state_dict())


@torch.inference_mode()
def test_refuses_wrong_shapes_and_names_them(small_toge: Toge) -> None:
    image, state, history = sample()
    with pytest.raises(PolicyError, match=r"image must be \[B, 3, 32, 32\]"):
        small_toge.encode_visual(image[..., :31])
    feature = small_toge.encode_visual(image)
    with pytest.raises(PolicyError, match=r"feature must be \[B, 256\]"):
        small_toge.predict_fast(feature[:, :-1], state, history)
    with pytest.raises(PolicyError, match=r"state must be \[B, 13\]"):
        small_toge.predict_fast(feature, state[0], history)
    with pytest.raises(PolicyError, match=r"action_history must be \[B, 4, 4\]"):
        small_toge.predict_fast(feature, state, history[:, :3])


@torch.inference_mode()
@pytest.mark.parametrize("kind", [TogeConfig, ResnetUnetConfig])
def test_every_number_since_the_exposure_reaches_the_sticks(kind):
    image, state, history = sample()
    contract = Contract(image_height=32, image_width=32, since_exposure=True)
    if kind is TogeConfig:
        policy: BuiltinPolicy = Toge(TogeConfig(backbone="resnet18", contract=contract)).eval()
    else:
        policy = ResnetUnet(ResnetUnetConfig(contract=contract)).eval()
    with pytest.raises(PolicyError, match=r"state must be \[B, 20\], got \[1, 13\]"):
        policy.predict(image, state, history, 2)
    wide = torch.cat([state, torch.zeros(1, 7)], dim=1)
    chunk = policy.predict(image, wide, history, 2)
    for index in range(13, 20):
        moved = wide.clone()
        moved[0, index] = 1.0
        assert not torch.equal(policy.predict(image, moved, history, 2), chunk), index
    # Over its scale: a tenth of a second of age counts as much as 2 m/s.
    normal = policy.state_encoder.normalise(torch.ones(1, 20))[0, 12:]
    assert normal.tolist() == pytest.approx([10, 2, 2, 2, 0.5, 0.5, 0.5])


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: TogeConfig(size="huge"), "small"),  # type: ignore[arg-type]
        (lambda: TogeConfig(backbone="vgg16"), "efficientnet_b3"),  # type: ignore[arg-type]
        (lambda: TogeConfig(contract=Contract(feature_dim=99)), "feature_dim 99"),
        (lambda: TogeConfig(contract=Contract(arrays="numpy")), "torch"),
        (lambda: ResnetUnetConfig(contract=Contract(feature_dim=256)), "feature_dim 0"),
        (lambda: ResnetUnetConfig(size="huge"), "small"),  # type: ignore[arg-type]
        (lambda: DiffusionHead("small", Contract(horizon=10), NoiseSchedule()), "multiple of 4"),
    ],
)
def test_refuses_configs_of_another_network(build: object, message: str) -> None:
    with pytest.raises((PolicyError, ContractError), match=message):
        build()  # type: ignore[operator]


@torch.inference_mode()
def test_resnet_unet_flies_single_rate_only() -> None:
    torch.manual_seed(0)
    contract = Contract(image_height=32, image_width=32)
    policy = ResnetUnet(ResnetUnetConfig(contract=contract)).eval()
    assert isinstance(policy, SingleRatePolicy)
    assert not isinstance(policy, DualRatePolicy)
    image, state, history = sample(batch=2)
    chunk = policy.predict(image, state, history, 3)
    assert chunk.shape == (2, 16, 4)
    assert chunk.abs().max() <= 1.0
    assert not torch.equal(policy.predict(image, state + 0.5, history, 3), chunk)
    assert not torch.equal(policy.predict(image, state, -history, 3), chunk)
    centred = policy.encode_observation(image, state, history * 0)
    assert torch.equal(policy.encode_observation(image, state), centred)
    with pytest.raises(PolicyError, match="action_history"):
        policy.predict(image, state, history[:, :2], 3)


@pytest.mark.parametrize(
    ("size", "low", "high"),
    [("small", 2.5e6, 3.5e6), ("medium", 10e6, 15e6), ("large", 36e6, 44e6)],
)
def test_head_sizes(size: Size, low: float, high: float) -> None:
    head = DiffusionHead(size, Contract(), NoiseSchedule())
    assert low < sum(p.numel() for p in head.parameters()) < high
