import pytest
import torch
from torch import Tensor

from policy.contract import Contract
from policy.errors import PolicyError
from policy.nets.names import BACKBONE_NAMES, BackboneName
from policy.nets.resnet import build_backbone
from policy.nets.toge import Toge, TogeConfig


def sample() -> tuple[Tensor, Tensor, Tensor]:
    """Image, state, history for ``small_toge``."""
    generator = torch.Generator().manual_seed(2)
    image = torch.randn(1, 3, 32, 32, generator=generator)
    state = torch.randn(1, 13, generator=generator)
    return image, state, torch.rand(1, 4, 4, generator=generator) * 2 - 1


@torch.inference_mode()
def test_every_input_reaches_the_sticks() -> None:
    torch.manual_seed(0)
    image, state, history = sample()
    contract = Contract(image_height=32, image_width=32, since_exposure=True)
    policy = Toge(TogeConfig(backbone="resnet18", contract=contract)).eval()
    wide = torch.cat([state, torch.zeros(1, 7)], dim=1)
    chunk = policy.predict(image, wide, history, 2)
    assert not torch.equal(policy.predict(-image, wide, history, 2), chunk)
    assert not torch.equal(policy.predict(image, wide, -history, 2), chunk)
    for index in range(20):
        moved = wide.clone()
        moved[0, index] += 1.0
        assert not torch.equal(policy.predict(image, moved, history, 2), chunk), index
    # Over its scale: a tenth of a second of age counts as much as 2 m/s.
    normal = policy.state_encoder.normalise(torch.ones(1, 20))[0, 12:]
    assert normal.tolist() == pytest.approx([10, 2, 2, 2, 0.5, 0.5, 0.5])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"arrays": "numpy"}, "torch"),
        ({"feature_dim": 12}, "toge small has 256"),
        ({"horizon": 10}, "multiple of 4"),
        ({"cameras": ("left", "right")}, "a policy class of your own"),
    ],
)
def test_a_contract_of_another_network_is_refused(changes, message):
    with pytest.raises(PolicyError, match=message):
        Toge(TogeConfig(contract=Contract(**changes)))


@pytest.mark.parametrize("name", BACKBONE_NAMES)
@torch.inference_mode()
def test_an_untrained_feature_says_where_and_any_size_has_one(name: BackboneName) -> None:
    backbone = build_backbone(name).eval()
    images = torch.zeros(2, 3, 96, 96)
    images[0, :, 40:56, 16:32] = images[1, :, 40:56, 64:80] = 3.0  # whole strides apart
    left, right = backbone(images)
    assert (left - right).abs().max() > 1e-2 * left.abs().max() > 1e-8
    for size in (32, 97):
        assert backbone(torch.randn(2, 3, size, size)).shape == (2, backbone.out_dim)
