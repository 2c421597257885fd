"""Torch policies as a user might write them, small and untrained."""

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from policy.contract import Contract
from policy.nets.diffusion import NoiseSchedule
from policy.protocol import predict_by_steps

SINGLE = Contract(image_height=32, image_width=32, horizon=8)
DUAL = Contract(image_height=32, image_width=32, horizon=8, feature_dim=12)


class Encoder(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(3, 8, 5, stride=4), nn.BatchNorm2d(8), nn.ReLU(), nn.Flatten()
        )
        self.project = nn.Linear(8 * 7 * 7, DUAL.feature_dim)

    def forward(self, image: Tensor) -> Tensor:
        feature: Tensor = self.project(self.layers(image))
        return feature


class Head(nn.Module):
    def __init__(self, extra: int = 0) -> None:
        super().__init__()
        inputs = DUAL.feature_dim + DUAL.state_dim + DUAL.history_len * 4 + extra
        self.layers = nn.Sequential(
            nn.Linear(inputs, 32), nn.SiLU(), nn.Dropout(), nn.Linear(32, DUAL.horizon * 4)
        )

    def forward(self, feature: Tensor, state: Tensor, history: Tensor, *more: Tensor) -> Tensor:
        if state.shape[1] != DUAL.state_dim:
            raise ValueError("a check of a shape is no decision by values")
        flat = [part.flatten(1) for part in (feature, history, *more)]
        chunk: Tensor = self.layers(torch.cat([*flat, state * 0.1], dim=1)).tanh()
        return chunk.reshape(-1, DUAL.horizon, 4)


class TwoRates(nn.Module):
    """The whole protocol on a module."""

    contract = DUAL

    def __init__(self) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(1)
            self.visual_encoder, self.head = Encoder(), Head()

    def encode_visual(self, image: Tensor) -> Tensor:
        return torch.as_tensor(self.visual_encoder(image))

    def predict_fast(self, feature: Tensor, state: Tensor, history: Tensor, steps: int) -> Tensor:
        return torch.as_tensor(self.head(feature, state, history))

    def predict(self, image: Tensor, state: Tensor, history: Tensor, steps: int) -> Tensor:
        return self.predict_fast(self.encode_visual(image), state, history, steps)


class PlainClass:
    """The whole protocol on a class that is not a module, but holds two."""

    contract = DUAL
    encode_visual: Any = TwoRates.encode_visual
    predict_fast: Any = TwoRates.predict_fast
    predict: Any = TwoRates.predict

    def __init__(self) -> None:
        whole = TwoRates()
        self.visual_encoder, self.head = whole.visual_encoder, whole.head
        self.gain, self.mean = np.array(0.5), np.zeros(13)  # constants, not memory


class Listed(PlainClass):
    """Holds a module in a partial in a deque, and one in TorchScript."""

    def __init__(self) -> None:
        super().__init__()
        self.visual_encoder = torch.jit.script(self.visual_encoder)
        self.heads = deque([partial(self.head)])
        del self.head

    def predict_fast(self, feature: Tensor, state: Tensor, history: Tensor, steps: int) -> Tensor:
        return torch.as_tensor(self.heads[0](feature, state, history))


class ModuleAsMethod(nn.Module):
    """The fast pair alone, one of it a module."""

    contract = DUAL

    def __init__(self) -> None:
        super().__init__()
        whole = TwoRates()
        self.encode_visual, self.head = whole.visual_encoder, whole.head

    predict_fast: Any = TwoRates.predict_fast


def changed(change: Callable[[Tensor, Tensor], Tensor]) -> TwoRates:
    """Return a policy whose chunk is what ``change`` makes of that of another, and of a state."""

    class Changed(TwoRates):
        def predict_fast(self, feature: Tensor, state: Tensor, history: Tensor, steps: int) -> Any:
            return change(super().predict_fast(feature, state, history, steps), state)

    return Changed()


class Scripted(TwoRates):
    """Python around an encoder in TorchScript."""

    def __init__(self) -> None:
        super().__init__()
        self.visual_encoder = torch.jit.script(self.visual_encoder)


class Resetting(TwoRates):
    def reset(self) -> None:
        """Called when a flight begins."""


class Stepwise(TwoRates):
    """Diffusion policy that defines how one of its steps is computed."""

    def __init__(self) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(2)
            self.head = Head(extra=DUAL.horizon * 4 + 1)
            self.register_buffer("initial_noise", torch.randn(1, DUAL.horizon, 4))
        self.schedule = NoiseSchedule(prediction="epsilon")

    def denoise(self, noisy: Tensor, timestep: Tensor, *rest: Any) -> Tensor:
        return torch.as_tensor(self.head(*rest, noisy, timestep[:, None] / 100))

    def to_chunk(self, sample: Tensor) -> Tensor:
        return sample

    predict_fast = predict_by_steps


class ForwardOnly(nn.Module):
    """Single-rate policy: a contract, and ``forward`` with two of the three arguments."""

    contract = SINGLE

    def __init__(self) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(3)
            self.net = nn.Linear(3 + SINGLE.state_dim, SINGLE.horizon * 4)

    def forward(self, image: Tensor, state: Tensor) -> Tensor:
        seen = torch.cat([image.mean(dim=(2, 3)), state * 0.1], dim=1)
        chunk: Tensor = self.net(seen).tanh()
        return chunk.reshape(-1, SINGLE.horizon, 4)


class Settable(ForwardOnly):
    """Settings behind the arguments, which keep their defaults."""

    def forward(
        self, image: Tensor, state: Tensor, scale: float = 1.0, *, offset: float = 0.0
    ) -> Tensor:
        return super().forward(image, state) * scale + offset


class NamedHead:
    """Neither module nor methods: two modules by name."""

    contract = SINGLE

    def __init__(self) -> None:
        whole = TwoRates()
        self.visual_encoder, self.action_head = whole.visual_encoder, whole.head


class SettableHead(Head):
    def forward(  # type: ignore[override]
        self, feature: Tensor, state: Tensor, scale: float = 1.0
    ) -> dict[str, Tensor]:
        history = torch.zeros(len(state), *SINGLE.history_shape)
        return {"actions": super().forward(feature, state, history) * scale}


class NamedSettableHead(NamedHead):
    def __init__(self) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(6)
            self.action_head: nn.Module = SettableHead()


class WrappedHead(NamedSettableHead):
    def __init__(self) -> None:
        super().__init__()
        compiled: Any = torch.compile(self.action_head, backend="eager")
        self.action_head = nn.DataParallel(compiled)


class NoisyHead(Head):
    """Head that is one step of a diffusion policy, with arguments in a denoiser's order."""

    def __init__(self) -> None:
        super().__init__(extra=DUAL.horizon * 4 + 1)

    def forward(
        self, noisy: Tensor, timestep: Tensor, feature: Tensor, state: Tensor, history: Tensor
    ) -> Tensor:  # type: ignore[override]
        return super().forward(feature, state, history, noisy, timestep[:, None] / 100)


class NamedDenoiser:
    """Neither module nor methods: two modules by name, one of them a denoiser."""

    contract = SINGLE
    noise_schedule = NoiseSchedule(prediction="epsilon", betas="linear")

    def __init__(self) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(4)
            self.visual_encoder, self.denoiser = Encoder(), NoisyHead()


class Incomplete:
    contract = SINGLE

    def __init__(self) -> None:
        self.visual_encoder = Encoder()


def scripted(signature: str, chunk: str) -> nn.Module:
    """Return a module whose forward takes these arguments and returns this expression."""
    module = type("Scripted", (torch.jit.ScriptModule,), {})()  # its class has one forward
    module.define(f"def forward(self, {signature}):\n    return {chunk}\n")
    return module


WIDE = Contract(
    image_height=32, image_width=32, horizon=8, cameras=("front", "down"), observation_steps=2
)


class WideDenoiser(nn.Module):
    """Denoising step on two observations of two cameras."""

    def __init__(self) -> None:
        super().__init__()
        seen = 2 * (2 * DUAL.feature_dim + WIDE.state_dim) + WIDE.horizon * 4
        self.net = nn.Linear(seen, WIDE.horizon * 4)

    def forward(self, noisy: Tensor, timestep: Tensor, feature: Tensor, state: Tensor) -> Tensor:
        weight = timestep[:, None] / 100
        parts = [feature.flatten(1), state.flatten(1) * 0.1, noisy.flatten(1) * weight]
        chunk: Tensor = self.net(torch.cat(parts, dim=1)).tanh()
        return chunk.reshape(-1, WIDE.horizon, 4)


class Wide:
    contract = WIDE

    def __init__(self) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(5)
            self.visual_encoder, self.denoiser = Encoder(), WideDenoiser()
