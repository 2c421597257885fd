from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch

from policy.checkpoints.policy_file import BuiltinPolicy, load_checkpoint
from policy.contract import Contract, FloatArray
from policy.loading.builtin import SHIPPED
from policy.nets.toge import Toge, TogeConfig
from policy.protocol import Executable


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
def trained_toge() -> BuiltinPolicy:
    """The shipped policy: what a warm start does cannot be judged by untrained weights."""
    return load_checkpoint(SHIPPED, fallback=TogeConfig())


Fly = Callable[[Executable, float | None], FloatArray]
TICK_S = 0.02


@pytest.fixture(scope="session")
def fly() -> Fly:
    """Chunks [ticks, horizon, 4] of a made-up flight at 50 Hz, an image every third tick."""

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
    for now_s in np.arange(70) * TICK_S:
        rgb = first + (last - first) * (0.5 + 0.5 * np.sin(now_s))
        velocity = (np.sin(now_s), np.cos(now_s), 0.3 * np.sin(2 * now_s))
        attitude = (np.cos(0.2 * now_s), np.sin(0.2 * now_s), 0.0, 0.0)
        motion = (0.5 * np.sin(3 * now_s), 0.3, 0.1, 0, 0, -9.8)
        state = np.zeros((1, contract.state_dim), np.float32)
        state[0, :13] = (*velocity, *attitude, *motion)
        history = 0.5 * np.sin(now_s + np.arange(16).reshape(1, 4, 4))
        yield rgb.astype(np.uint8), state, history.astype(np.float32)
