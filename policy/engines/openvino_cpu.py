"""OpenVINO on the CPU: the image path and the action path as one compiled graph each.

The image path is converted unchanged. The denoiser is rewritten over the same weights, as 2-D
convolutions over a single row: the CPU plugin runs them faster than the matrix products that torch
prefers (bf16: by a third). The values that differ between the steps of a solve are inputs, so one
graph, and one copy of the weights, serves every step. The parity check compares the result with
torch.
"""

import hashlib
from typing import Any

import numpy as np
import openvino as ov
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.contract import ACTION_DIM, FloatArray
from policy.engines.openvino_compile import (
    DEVICE,
    GraphCompiler,
    convert,
    engine_name,
    signal_stack_kept,
    update_digest,
)
from policy.engines.runner import Act, ExecutionSettings, Precision, assemble, to_numpy
from policy.nets.diffusion import DiffusionHead, size_dims
from policy.nets.toge import BuiltinPolicy
from policy.nets.unet1d import Conv, ResidualBlock, UNet1d, norm_of_groups
from policy.preprocess import egocentric, egocentric_scale
from policy.protocol import PolicyRunner

MAX_UNROLLED = 10
"""Denoising steps in one graph; each takes a third of a second to convert, once."""


@signal_stack_kept()
def make_openvino_runner(
    policy: BuiltinPolicy, settings: ExecutionSettings, vision: Precision, action: Precision
) -> PolicyRunner:
    """Compile a policy for the loops, or load it from the user's cache; tried once.

    The policy's initial noise is copied now. ``vision`` and ``action`` are the precisions of both
    paths.
    """
    name = engine_name(vision, action)
    digest = hashlib.sha256()
    for key, value in policy.state_dict().items():
        update_digest(digest, key, value)
    compiler = GraphCompiler(f"{policy.config} {digest.hexdigest()}")
    encode = compiler.compile("vision", vision, lambda: vision_graph(policy))
    sample = _solver(compiler, policy, action, settings.num_diffusion_steps)
    if settings.dual_rate:
        return assemble(policy.contract, (encode,), sample, name, settings)
    return assemble(
        policy.contract, (), lambda image, s, h: sample(encode(image), s, h), name, settings
    )


def _solver(
    compiler: GraphCompiler, policy: BuiltinPolicy, precision: Precision, steps: int
) -> Act:
    """Return (encoded image, state, history) -> chunk, by ``steps`` from the policy's noise.

    One graph, and so one copy of the weights, runs all steps, at most ``MAX_UNROLLED`` at a time:
    the values that differ between steps are inputs.
    """
    at_once = min(steps, MAX_UNROLLED)
    denoise = compiler.compile(
        f"denoise {at_once}", precision, lambda: denoise_graph(policy, at_once)
    )
    noise = to_numpy(policy.head.initial_noise)
    segments = [
        step_inputs(policy.head, steps, first, min(at_once, steps - first), at_once)
        for first in range(0, steps, at_once)
    ]

    def sample(encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        own_state, noisy = egocentric(state, policy.contract), noise
        for films, updates in segments:
            noisy = denoise(encoded, own_state, history, noisy, films, updates)
        return noisy

    return sample


def vision_graph(policy: BuiltinPolicy) -> ov.Model:
    """Build the graph: normalised image [1, 3, H, W] -> feature [1, F]."""
    image = (1, 3, policy.contract.image_height, policy.contract.image_width)
    return convert(policy, lambda i: policy.visual_projection(policy.backbone(i)), [image])


def denoise_graph(policy: BuiltinPolicy, count: int) -> ov.Model:
    """Build the graph of ``count`` unrolled steps of a solve; ``step_inputs`` selects the steps.

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
    state, history = (1, len(egocentric_scale(contract))), (1, *contract.history_shape)
    noisy, steps = (1, contract.horizon, ACTION_DIM), ((count, head.unet.film_dim), (count, 4))
    return convert(policy, denoise, [feature, state, history, noisy, *steps])


def step_inputs(
    head: DiffusionHead, num_diffusion_steps: int, first: int, count: int, unrolled: int
) -> tuple[FloatArray, FloatArray]:
    """Return inputs that make a graph of ``unrolled`` steps run ``count`` steps from ``first``.

    If ``count`` is less than ``unrolled``, steps without effect come first. Returns the timesteps'
    parts of FiLM [unrolled, film_dim], with 1 added to the scales, and the coefficients for
    ``_updated`` [unrolled, 4].
    """
    steps = head.schedule.ddim_steps(num_diffusion_steps)[first : first + count]
    timesteps = torch.tensor([step.timestep for step in steps])
    # FiLM's scales are relative to 1: add the 1 here, not in each step.
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
    """Take one reverse step with the net's output; ``update`` [1, 4] are ``coefficients``.

    ``noisy`` and ``update`` also reach the graph's end by a path without convolutions; OpenVINO
    keeps such a path in float32 if the rest is bf16.
    """
    a, b, c, d = update.reshape(1, 4, 1, 1).chunk(4, dim=1)
    clean = (noisy * a + output * b).clamp(-1.0, 1.0)
    return torch.add(clean * c, noisy * d)


def _to_row(chunk: Tensor) -> Tensor:
    """[1, L, C] -> [1, C, 1, L]."""
    return chunk.transpose(1, 2).unsqueeze(2)


# --- UNet1d on images of one row, [1, C, 1, L]; film [1, film_dim] with 1 added to its scales


def _unet(unet: UNet1d, noisy: Tensor, film: Tensor) -> Tensor:
    layers: Any = unet  # its module lists are not typed
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
    """Backbone of a policy, with its current weights; one image per stream and core.

    Measured on two cores without matrix units, EfficientNet-B3 at 128x128: four times as many
    images a second as torch in batches.
    """

    def __init__(self, policy: BuiltinPolicy, precision: Precision) -> None:
        properties = {"PERFORMANCE_HINT": "THROUGHPUT", "INFERENCE_PRECISION_HINT": precision}
        image = (1, 3, policy.contract.image_height, policy.contract.image_width)
        graph = convert(policy.backbone, policy.backbone, [image])
        with signal_stack_kept():
            compiled = ov.Core().compile_model(graph, DEVICE, properties)
            self._queue = ov.AsyncInferQueue(compiled, 0)
        self._dim = policy.backbone.out_dim

    def __call__(self, images: FloatArray) -> FloatArray:
        """Return outputs [B, D] for normalised images [B, 3, H, W] of the contract's size."""
        out = np.empty((len(images), self._dim), np.float32)

        def keep(request: ov.InferRequest, row: int) -> None:
            out[row] = request.get_output_tensor(0).data[0]

        self._queue.set_callback(keep)
        for row in range(len(images)):
            image = np.ascontiguousarray(images[row : row + 1])
            self._queue.start_async({0: image}, row)
        self._queue.wait_all()
        return out
