"""Torch modules converted to OpenVINO graphs, and the form of our action path that converts best.

The image path is converted as it is. The denoiser is written again over the same weights, as 2-D
convolutions over a single row, which the CPU plugin runs faster than the products of matrices that
torch prefers (bf16: by a third). What tells the steps of a solve apart are inputs, so that one
graph, and one copy of the weights, serves every step. The parity check compares the result with
torch.
"""

import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import openvino as ov
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.contract import ACTION_DIM, FloatArray
from policy.engines.openvino_compile import DEVICE
from policy.engines.runner import Precision, Shape
from policy.engines.signal_stack import signal_stack_kept
from policy.errors import user_code
from policy.nets.action_head import DiffusionHead, size_dims
from policy.nets.resnet_unet import ResnetUnet
from policy.nets.toge import Toge
from policy.nets.unet1d import Conv, ResidualBlock, UNet1d, norm_of_groups
from policy.preprocess import egocentric_scale


class Traceable(nn.Module):
    """A function of tensors as a module, with the modules whose weights it uses."""

    def __init__(self, held: nn.Module, function: Callable[..., Any]) -> None:
        super().__init__()
        self.held = held
        self.function = function

    def forward(self, *arrays: Tensor) -> Any:
        """Call the function."""
        return self.function(*arrays)


@contextmanager
def quiet() -> Iterator[None]:
    """Keep tracer and converter from writing to the terminal, and from muting others for good."""
    level, disabled = logging.root.level, logging.root.manager.disable
    fast_path = torch.backends.mha.get_fastpath_enabled()
    try:
        logging.disable(logging.CRITICAL)
        # The fused layer of torch's own transformers is an operation that no converter knows.
        torch.backends.mha.set_fastpath_enabled(False)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # each shape check of ours is one, rightly constant
            yield
    finally:
        torch.backends.mha.set_fastpath_enabled(fast_path)
        logging.disable(disabled)
        logging.root.setLevel(level)


def convert(policy: nn.Module, function: Callable[..., Any], shapes: Sequence[Shape]) -> ov.Model:
    """``function`` of float32 tensors of these shapes, which uses the weights of ``policy``.

    It is traced: what it decides by a tensor's values is decided once, by zeros.
    """
    with user_code("converting it for OpenVINO failed"), quiet():
        return ov.convert_model(
            Traceable(policy, function).eval(),
            example_input=tuple(torch.zeros(shape) for shape in shapes),
            input=[list(shape) for shape in shapes],
        )


def vision_graph(policy: Toge | ResnetUnet) -> ov.Model:
    """Normalised image [1, 3, H, W] -> feature [1, F]."""
    image = (1, 3, policy.contract.image_height, policy.contract.image_width)
    return convert(policy, lambda i: policy.visual_projection(policy.backbone(i)), [image])


def denoise_graph(policy: Toge | ResnetUnet, count: int) -> ov.Model:
    """``count`` steps of a solve, unrolled; ``step_inputs`` says which ones.

    (feature, egocentric, history, noisy [1, horizon, 4], films, updates) -> less noisy.
    """
    contract, head = policy.contract, policy.head

    def denoise(
        feature: Tensor, egocentric: Tensor, history: Tensor, noisy: Tensor, films: Tensor,
        updates: Tensor,
    ) -> Tensor:  # fmt: skip
        condition = policy.condition(feature, policy.state_encoder.mlp(egocentric), history)
        film_of_condition = head.unet.film_of_condition(condition)
        sample = _to_row(noisy)
        mean = _to_row(head.read(condition)) if head.reads_condition else None
        all_films = film_of_condition + films
        for film, update in zip(all_films.chunk(count), updates.chunk(count), strict=True):
            output = _unet(head.unet, sample, film)
            sample = _updated(sample, output if mean is None else output + mean, update)
        return sample.squeeze(2).transpose(1, 2)

    feature = (1, size_dims(policy.config.size).base_dim)
    state, history = (1, len(egocentric_scale(contract))), (1, contract.history_len, ACTION_DIM)
    noisy, steps = (1, contract.horizon, ACTION_DIM), ((count, head.unet.film_dim), (count, 4))
    return convert(policy, denoise, [feature, state, history, noisy, *steps])


def step_inputs(
    head: DiffusionHead, num_diffusion_steps: int, first: int, count: int, unrolled: int
) -> tuple[FloatArray, FloatArray]:
    """Inputs that make a graph of ``unrolled`` steps run ``first`` to ``first + count`` of a solve.

    Where those are fewer, steps that change nothing come before them. Returns the timesteps' shares
    of FiLM [unrolled, film_dim], 1 added to the scales, and the coefficients of ``_updated``
    [unrolled, 4].
    """
    steps = head.schedule.ddim_steps(num_diffusion_steps)[first : first + count]
    timesteps = torch.tensor([step.timestep for step in steps])
    # FiLM's scales are about 1: added here, not in each step.
    halves = [(torch.ones(size // 2), torch.zeros(size // 2)) for size in head.unet.film_sizes]
    one_at_every_scale = torch.cat([half for pair in halves for half in pair])
    with torch.inference_mode():
        film_of_steps = head.unet.film_of_timestep(timesteps.to(head.initial_noise.device)).cpu()
        films = (film_of_steps + one_at_every_scale).numpy()
    updates = np.array([head.schedule.coefficients(step) for step in steps], np.float32)
    idle = unrolled - count
    unchanged = np.tile(np.array([[0, 0, 0, 1]], np.float32), (idle, 1))
    films = np.concatenate([films[:1].repeat(idle, axis=0), films])
    return films, np.concatenate([unchanged, updates])


def _updated(noisy: Tensor, output: Tensor, update: Tensor) -> Tensor:
    """One reverse step by the net's output; ``update`` [1, 4] are the schedule's ``coefficients``.

    ``noisy`` and ``update`` also reach the graph's end by a way without convolutions; along such a
    way OpenVINO keeps float32 where the rest is bf16.
    """
    a, b, c, d = update.reshape(1, 4, 1, 1).chunk(4, dim=1)
    clean = (noisy * a + output * b).clamp(-1.0, 1.0)
    return torch.add(clean * c, noisy * d)


def _to_row(chunk: Tensor) -> Tensor:
    """[1, L, C] -> [1, C, 1, L]."""
    return chunk.transpose(1, 2).unsqueeze(2)


# --- UNet1d on images of one row, [1, C, 1, L]; film [1, film_dim] with 1 added to its scales


def _unet(unet: UNet1d, noisy: Tensor, film: Tensor) -> Tensor:
    layers: Any = unet  # its lists of modules do not say of which class
    films = iter(torch.split(film[:, :, None, None], unet.film_sizes, dim=1))
    x, skips = noisy, []
    for block, downsample in zip(layers.down, layers.downsample, strict=True):
        x = _residual_block(block, x, next(films))
        skips.append(x)
        x = _conv(downsample, x)
    for block in layers.mid:
        x = _residual_block(block, x, next(films))
    for block, upsample in zip(layers.up, layers.upsample, strict=True):
        x = _conv(upsample, F.interpolate(x, scale_factor=(1.0, 2.0)))
        x = _residual_block(block, torch.cat([x, skips.pop()], dim=1), next(films))
    return _pointwise(unet.out, x)


def _residual_block(block: ResidualBlock, x: Tensor, film: Tensor) -> Tensor:
    scale, shift = film.chunk(2, dim=1)
    hidden = F.silu(norm_of_groups(block.norm1, _conv(block.conv1, x)))
    hidden = F.silu(norm_of_groups(block.norm2, _conv(block.conv2, hidden * scale + shift)))
    shortcut = block.shortcut
    return hidden + (_pointwise(shortcut, x) if isinstance(shortcut, nn.Linear) else x)


def _conv(conv: Conv, x: Tensor) -> Tensor:
    linear, taps = conv.linear, conv.taps
    weight = linear.weight.reshape(linear.out_features, taps, -1).transpose(1, 2).unsqueeze(2)
    return F.conv2d(x, weight, linear.bias, stride=(1, conv.stride), padding=(0, taps // 2))


def _pointwise(linear: nn.Linear, x: Tensor) -> Tensor:
    return F.conv2d(x, linear.weight[:, :, None, None], linear.bias)


class BulkEncoder:
    """The backbone of a policy, with its weights as they are now; one image a stream and core.

    Measured on two cores without matrix units, EfficientNet-B3 at 128x128: four times as many
    images a second as torch in batches.
    """

    def __init__(self, policy: Toge | ResnetUnet, precision: Precision) -> None:
        properties = {
            "PERFORMANCE_HINT": "THROUGHPUT",
            "INFERENCE_PRECISION_HINT": precision,
        }
        image = (1, 3, policy.contract.image_height, policy.contract.image_width)
        graph = convert(policy.backbone, policy.backbone, [image])
        with signal_stack_kept():
            compiled = ov.Core().compile_model(graph, DEVICE, properties)
            self._queue = ov.AsyncInferQueue(compiled, 0)
        self._dim = policy.backbone.out_dim

    def __call__(self, images: FloatArray) -> FloatArray:
        """Normalised images [B, 3, H, W] of the contract's size -> outputs [B, D]."""
        out = np.empty((len(images), self._dim), np.float32)

        def keep(request: "ov.InferRequest", row: int) -> None:
            out[row] = request.get_output_tensor(0).data[0]

        self._queue.set_callback(keep)
        for row in range(len(images)):
            image = np.ascontiguousarray(images[row : row + 1])
            self._queue.start_async({0: image}, row)
        self._queue.wait_all()
        return out
