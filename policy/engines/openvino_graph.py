"""Our policies as OpenVINO graphs, written operator by operator.

Written rather than converted, because of what a conversion of the unrolled sampler does not give:
all steps share one copy of the weights, the convolutions of the U-Net are 2-D ones over a single
row (the CPU plugin's fastest form of those tried), and the timesteps' share of FiLM is a constant.
It also takes a tenth of a second instead of ten. The parity gate compares the result with torch.
"""

from collections.abc import Callable, Sequence

import numpy as np
import openvino as ov
import torch
from openvino import opset15 as ops
from torch import Tensor, nn

from policy.contract import ACTION_DIM, FloatArray
from policy.engines.openvino_layers import Layer, Node, conv, ints, layer, same
from policy.nets.action_head import DiffusionHead, size_dims
from policy.nets.diffusion import DdimStep, NoiseSchedule
from policy.nets.resnet_unet import ResnetUnet
from policy.nets.toge import Toge
from policy.nets.unet1d import ResidualBlock, UNet1d
from policy.preprocess import egocentric_scale


def backbone_graph(policy: Toge | ResnetUnet) -> ov.Model:
    """Normalised image [1, 3, H, W] -> output of the backbone [1, D]."""
    contract = policy.contract
    image = _parameter("image", 1, 3, contract.image_height, contract.image_width)
    return ov.Model([ops.result(layer(policy.backbone)(image))], [image], "backbone")


def vision_graph(policy: Toge | ResnetUnet) -> ov.Model:
    """Normalised image [1, 3, H, W] -> feature [1, F]."""
    contract = policy.contract
    image = _parameter("image", 1, 3, contract.image_height, contract.image_width)
    feature = layer(policy.visual_projection)(layer(policy.backbone)(image))
    return ov.Model([ops.result(feature)], [image], "vision")


def denoise_graph(policy: Toge | ResnetUnet, count: int) -> ov.Model:
    """``count`` steps of a solve, unrolled; ``step_inputs`` says which ones.

    (feature, egocentric, history, noisy [1, horizon, 4], films, updates) -> less noisy.
    """
    unet = policy.head.unet
    inputs = _action_inputs(policy)
    noisy = _parameter("noisy", 1, policy.contract.horizon, ACTION_DIM)
    films = _parameter("films", count, unet.film_dim)
    updates = _parameter("updates", count, 4)
    condition = _condition(policy, *inputs)
    film = ops.add(layer(unet.film_condition)(condition), films)
    denoise = _with_read(_UNetGraph(unet), policy.head, condition)
    sample = ops.unsqueeze(ops.transpose(noisy, ints(0, 2, 1)), ints(2))
    for film_of_step, update in zip(
        _split(film, 0, [1] * count), _split(updates, 0, [1] * count), strict=True
    ):
        sample = _updated(sample, denoise(sample, film_of_step), update)
    less_noisy = ops.transpose(ops.squeeze(sample, ints(2)), ints(0, 2, 1))
    return ov.Model([ops.result(less_noisy)], [*inputs, noisy, films, updates], "denoise")


def step_inputs(
    head: DiffusionHead, num_diffusion_steps: int, first: int, count: int, unrolled: int
) -> tuple[FloatArray, FloatArray]:
    """What makes a graph of ``unrolled`` steps the steps ``first`` to ``first + count`` of a solve.

    Where those are fewer, steps that change nothing come before them.

    Returns:
        The timesteps' shares of FiLM [unrolled, film_dim], 1 added to the scales, and the
        coefficients of ``_updated`` [unrolled, 4].
    """
    steps = head.schedule.ddim_steps(num_diffusion_steps)[first : first + count]
    timesteps = torch.tensor([step.timestep for step in steps])
    with torch.inference_mode():
        film_of_steps = head.unet.film_of_timestep(timesteps.to(head.initial_noise.device)).cpu()
        films = (film_of_steps + _one_at_every_scale(head.unet)).numpy()
    updates = np.array([_coefficients(head.schedule, step) for step in steps], np.float32)
    idle = unrolled - count
    unchanged = np.tile(np.array([[0, 0, 0, 1]], np.float32), (idle, 1))
    films = np.concatenate([films[:1].repeat(idle, axis=0), films])
    return films, np.concatenate([unchanged, updates])


def _action_inputs(policy: Toge | ResnetUnet) -> tuple[Node, Node, Node]:
    return (
        _parameter("feature", 1, size_dims(policy.config.size).base_dim),
        _parameter("egocentric", 1, len(egocentric_scale(policy.contract))),
        _parameter("history", 1, policy.contract.history_len, ACTION_DIM),
    )


def _parameter(name: str, *shape: int) -> Node:
    return ops.parameter(list(shape), np.float32, name)


# --- the condition


def _condition(policy: Toge | ResnetUnet, feature: Node, state: Node, history: Node) -> Node:
    token = layer(policy.state_encoder.mlp)(state)
    if isinstance(policy, Toge):
        past = layer(policy.history_encoder)(history)
        return layer(policy.fusion.mlp)(ops.concat([feature, token, past], axis=1))
    flat = ops.reshape(history, ints(1, -1), special_zero=False)
    return layer(policy.fuse)(ops.concat([feature, token, flat], axis=1))


# --- the sampler


def _with_read(
    unet: Callable[[Node, Node], Node], head: DiffusionHead, condition: Node
) -> Callable[[Node, Node], Node]:
    """The net: ``unet`` plus what the head reads off the condition, where it does."""
    if not head.reads_condition:
        return unet
    flat = layer(head.direct)(condition)
    chunk = ops.reshape(flat, ints(1, 1, -1, ACTION_DIM), special_zero=False)
    rows = ops.transpose(chunk, ints(0, 3, 1, 2))
    return lambda noisy, film: ops.add(unet(noisy, film), rows)


def _one_at_every_scale(unet: UNet1d) -> Tensor:
    """FiLM's scales are about 1: what to add to all of them beforehand; [film_dim]."""
    halves = [(torch.ones(size // 2), torch.zeros(size // 2)) for size in unet.film_sizes]
    return torch.cat([half for pair in halves for half in pair])


def _coefficients(schedule: NoiseSchedule, step: DdimStep) -> tuple[float, float, float, float]:
    """``NoiseSchedule.ddim_update`` as ``next = c * clip(a * noisy + b * output) + d * noisy``."""
    a, b = 0.0, 1.0
    if schedule.prediction == "epsilon":
        a, b = 1 / step.signal, -step.noise / step.signal
    kept = step.next_noise / step.noise
    return a, b, step.next_signal - kept * step.signal, kept


def _updated(noisy: Node, output: Node, update: Node) -> Node:
    """One reverse step by the net's output; ``update`` [1, 4] are its ``_coefficients``.

    ``noisy`` and ``update`` also reach the graph's end by a way without convolutions; along such a
    way OpenVINO keeps float32 where the rest is bf16.
    """
    a, b, c, d = _split(ops.reshape(update, ints(1, 4, 1, 1), special_zero=False), 1, [1] * 4)
    clean = ops.clamp(ops.add(ops.multiply(noisy, a), ops.multiply(output, b)), -1.0, 1.0)
    return ops.add(ops.multiply(clean, c), ops.multiply(noisy, d))


class _UNetGraph:
    """``UNet1d`` on images of one row, [1, C, 1, L]; its weights serve all steps."""

    def __init__(self, unet: UNet1d) -> None:
        self._film_sizes = unet.film_sizes
        self._down = [_residual_block(block) for block in unet.down]
        self._downsample = [layer(conv) for conv in unet.downsample]
        self._mid = [_residual_block(block) for block in unet.mid]
        self._upsample = [layer(conv) for conv in unet.upsample]
        self._up = [_residual_block(block) for block in unet.up]
        self._out = _linear_of_row(unet.out)

    def __call__(self, noisy: Node, film: Node) -> Node:
        """Noisy actions and FiLM [1, film_dim], 1 added to its scales -> prediction.

        Actions are rows [1, 4, 1, horizon], here and through the whole solve.
        """
        films = iter(_split(ops.unsqueeze(film, ints(2, 3)), 1, self._film_sizes))
        x = noisy
        skips = []
        for block, downsample in zip(self._down, self._downsample, strict=True):
            x = block(x, next(films))
            skips.append(x)
            x = downsample(x)
        for block in self._mid:
            x = block(x, next(films))
        for block, upsample in zip(self._up, self._upsample, strict=True):
            x = upsample(_doubled(x))
            x = block(ops.concat([x, skips.pop()], axis=1), next(films))
        return self._out(x)


def _residual_block(block: nn.Module) -> Callable[[Node, Node], Node]:
    if not isinstance(block, ResidualBlock):
        raise TypeError(f"{type(block).__name__} has no OpenVINO form as a block of the U-Net")
    conv1, conv2 = layer(block.conv1), layer(block.conv2)
    norm1, norm2 = layer(block.norm1), layer(block.norm2)
    shortcut: Layer = same
    if isinstance(block.shortcut, nn.Linear):
        shortcut = _linear_of_row(block.shortcut)

    def apply(x: Node, film: Node) -> Node:
        scale, shift = ops.split(film, ops.constant(np.int64(1)), 2).outputs()
        hidden = ops.swish(norm1(conv1(x)))
        hidden = ops.add(ops.multiply(hidden, scale), shift)
        return ops.add(ops.swish(norm2(conv2(hidden))), shortcut(x))

    return apply


def _linear_of_row(linear: nn.Linear) -> Layer:
    return conv(linear.weight[:, :, None, None], linear.bias, strides=(1, 1), pads=(0, 0))


def _doubled(x: Node) -> Node:
    length = x.get_output_shape(0)[3]
    return ops.interpolate(
        x,
        ints(1, 2 * length),
        mode="nearest",
        shape_calculation_mode="sizes",
        pads_begin=[0, 0],
        pads_end=[0, 0],
        coordinate_transformation_mode="asymmetric",
        nearest_mode="floor",
        axes=ints(2, 3),
    )


def _split(x: Node, axis: int, sizes: Sequence[int]) -> list[Node]:
    parts: list[Node] = ops.variadic_split(x, ints(axis), ints(*sizes)).outputs()
    return parts
