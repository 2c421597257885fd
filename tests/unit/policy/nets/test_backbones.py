import pytest
import torch

from policy.nets.names import BACKBONE_NAMES, BackboneName
from policy.nets.resnet import build_backbone


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
