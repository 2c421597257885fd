from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from policy.contract import QUATERNION, Contract, Executable, FloatArray
from policy.nets.toge import Toge, TogeConfig


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """Sums of two threads differ in the last bit; and the other cores are in use, too."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def small_toge() -> Toge:
    """The cheapest TOGE: seeded random weights, ResNet-18 at 32x32. Not to be changed by a test."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        contract = Contract(image_height=32, image_width=32)
        return Toge(TogeConfig(backbone="resnet18", contract=contract)).eval()


@pytest.fixture(scope="session")
def trained_toge() -> Toge:
    """``small_toge`` after a few seconds of training: from the state to a smooth chunk.

    A net that has learnt nothing pulls no guess anywhere, so what a warm start does cannot be
    judged by it.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        contract = Contract(image_height=32, image_width=32)
        policy = Toge(TogeConfig(backbone="resnet18", contract=contract))
        policy.backbone.requires_grad_(False)
        learning = [weight for weight in policy.parameters() if weight.requires_grad]
        optimiser = torch.optim.AdamW(learning, lr=1e-3)
        for _ in range(100):
            loss = _loss(policy, batch=512)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    return policy.eval()


def _loss(policy: Toge, batch: int) -> Tensor:
    """As in training: all samples for what is read off the condition, few for the denoiser."""
    state, feature = torch.randn(batch, 13), torch.randn(batch, policy.contract.feature_dim)
    state[:, QUATERNION] = F.normalize(state[:, QUATERNION], dim=1)
    history = torch.rand(batch, 4, 4) * 2 - 1
    ahead_s = torch.arange(16) * policy.contract.chunk_dt_s
    seen = policy.state_encoder.normalise(state)[:, :4, None]  # the same on every heading
    chunk = 0.8 * torch.tanh(2.5 * seen + 0.7 * state[:, 7:11, None] * ahead_s)
    chunk = chunk.transpose(1, 2)
    timestep = torch.randint(0, 100, (batch,))
    noisy = policy.head.schedule.add_noise(chunk, torch.randn(chunk.shape), timestep)
    condition = policy.encode_and_fuse(feature, state, history)
    read = policy.head.read(condition)
    denoised = policy.denoise(noisy[:32], timestep[:32], condition[:32])
    return (denoised - chunk[:32]).square().mean() + (read - chunk).square().mean()


@pytest.fixture
def fly() -> Callable[[Executable, float | None], FloatArray]:
    """Chunks [ticks, horizon, 4] of a made-up flight at 100 Hz, an image every third tick."""

    def flight(executable: Executable, elapsed_s: float | None) -> FloatArray:
        chunks = []
        encoded = None
        for tick, (rgb, state, history) in enumerate(_moments(executable.contract)):
            if encoded is None or tick % 3 == 0:
                encoded = executable.encode(rgb)
            since_s = elapsed_s if tick else None
            chunks.append(executable.act(encoded, state, history, since_s)[0])
        return np.stack(chunks)

    return flight


def _moments(contract: Contract) -> Iterator[tuple[np.ndarray, FloatArray, FloatArray]]:
    shape = (2, contract.image_height, contract.image_width, 3)
    first, last = np.random.default_rng(0).integers(0, 255, shape).astype(float)
    for now_s in np.arange(150) * 0.01:
        rgb = first + (last - first) * (0.5 + 0.5 * np.sin(now_s))
        velocity = (np.sin(now_s), np.cos(now_s), 0.3 * np.sin(2 * now_s))
        attitude = (np.cos(0.2 * now_s), np.sin(0.2 * now_s), 0.0, 0.0)
        state = np.array([[*velocity, *attitude, 0.5 * np.sin(3 * now_s), 0.3, 0.1, 0, 0, -9.8]])
        history = 0.5 * np.sin(now_s + np.arange(16).reshape(1, 4, 4))
        yield rgb.astype(np.uint8), state.astype(np.float32), history.astype(np.float32)
