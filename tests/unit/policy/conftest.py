import pytest
import torch

from policy.checkpoints.networks import load_checkpoint
from policy.contract import Contract
from policy.loading.builtin import SHIPPED
from policy.nets.toge import Toge, TogeConfig


@pytest.fixture(scope="session")
def small_toge() -> Toge:
    """The cheapest TOGE: seeded random weights, ResNet-8 at 32x32. Not to be changed by a test."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        contract = Contract(image_height=32, image_width=32)
        return Toge(TogeConfig(backbone="resnet8", contract=contract)).eval()


@pytest.fixture(scope="session")
def trained_toge() -> Toge:
    """The shipped policy."""
    return load_checkpoint(SHIPPED, fallback=TogeConfig())
