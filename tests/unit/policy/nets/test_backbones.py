import pytest
import torch

from policy.errors import PolicyError
from policy.nets.backbones import build_backbone, load_imagenet_state
from policy.nets.depthwise import Depthwise
from policy.nets.names import BACKBONE_NAMES, BackboneName


@pytest.mark.parametrize(
    ("name", "total", "out_dim", "shapes"),
    [
        (
            *("efficientnet_b3", 12_233_232, 1536),
            {
                "features.0.0.weight": (40, 3, 3, 3),
                "features.1.0.block.1.fc1.weight": (10, 40, 1, 1),
                "features.7.1.block.3.0.weight": (384, 2304, 1, 1),
                "features.8.0.weight": (1536, 384, 1, 1),
            },
        ),
        (
            *("convnext_tiny", 28_589_128, 768),
            {
                "features.0.1.weight": (96,),
                "features.1.0.layer_scale": (96, 1, 1),
                "features.7.2.block.5.weight": (768, 3072),
                "classifier.0.weight": (768,),
            },
        ),
        (
            *("resnet18", 11_689_512, 512),
            {"layer2.0.downsample.0.weight": (128, 64, 1, 1), "layer4.1.bn2.running_mean": (512,)},
        ),
        ("resnet50", 25_557_032, 2048, {"layer3.5.conv3.weight": (1024, 256, 1, 1)}),
    ],
)
def test_parameters_are_those_of_torchvision_with_its_classifier(name, total, out_dim, shapes):
    backbone = build_backbone(name)
    classifier = out_dim * 1000 + 1000
    assert sum(p.numel() for p in backbone.parameters()) + classifier == total
    state = backbone.state_dict()
    assert {key: tuple(state[key].shape) for key in shapes} == shapes


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


def test_imagenet_weights_load_without_their_classifier() -> None:
    source, target = build_backbone("resnet18"), build_backbone("resnet18")
    state = source.state_dict()
    state["fc.weight"], state["fc.bias"] = torch.zeros(1000, 512), torch.zeros(1000)
    load_imagenet_state(target, state)
    assert torch.equal(target.state_dict()["layer4.1.conv2.weight"], state["layer4.1.conv2.weight"])
    with pytest.raises(PolicyError, match="not of this backbone"):
        load_imagenet_state(build_backbone("resnet50"), state)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize(("kernel", "stride"), [(3, 1), (3, 2), (5, 1), (5, 2), (7, 1)])
@pytest.mark.parametrize("size", [8, 9])
def test_depthwise_gradients_are_those_of_a_convolution(
    kernel: int, stride: int, size: int, dtype: torch.dtype
) -> None:
    torch.manual_seed(0)
    module = Depthwise(6, kernel, stride=stride, bias=True).to(dtype)
    x = torch.randn(2, 6, size, size, dtype=dtype, requires_grad=True)
    made, expected = module(x), torch.nn.Conv2d.forward(module, x)
    torch.testing.assert_close(made, expected, rtol=0, atol=0)
    gradient = torch.randn_like(made)
    wanted = [x, *module.parameters()]
    for one, other in zip(
        torch.autograd.grad(made, wanted, gradient),
        torch.autograd.grad(expected, wanted, gradient),
        strict=True,
    ):
        torch.testing.assert_close(one, other)
