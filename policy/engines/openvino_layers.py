"""Torch modules as functions between OpenVINO nodes, with their weights as constants.

Weights are made once, however often a function is applied: copies of them for every use of a layer
would not fit a CPU's cache. Biases are made for each use: the CPU plugin adds a bias within the
convolution only where nothing else reads it, and else in two operators of their own.
"""

from collections.abc import Callable, Sequence
from functools import singledispatch
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from openvino import opset15 as ops
from torch import Tensor, nn

from policy.nets.convnext import ChannelNorm, ConvNextBlock, ConvNextTiny, Permute
from policy.nets.efficientnet import EfficientNetB3, MBConv, SqueezeExcitation
from policy.nets.encoders import HEADS, AttentionBlock, HistoryEncoder
from policy.nets.pooling import MOMENTS, moment_weights
from policy.nets.resnet import RESNET8_CELLS, BasicBlock, Bottleneck, ResNet, ResNet8
from policy.nets.unet1d import Conv

Node: TypeAlias = Any
"""openvino's Node and Output, which have no types."""
Layer = Callable[[Node], Node]


def constant(value: Tensor | ArrayLike) -> Node:
    """A float32 constant."""
    array = value.detach().cpu().numpy() if isinstance(value, Tensor) else value
    return ops.constant(np.ascontiguousarray(array, np.float32))


def ints(*values: int) -> Node:
    """A constant of int64, for axes and shapes."""
    return ops.constant(np.array(values, np.int64))


def same(x: Node) -> Node:
    """The identity as a layer."""
    return x


# --- layers of torch


def _sequence(*layers: Layer) -> Layer:
    def apply(x: Node) -> Node:
        for one in layers:
            x = one(x)
        return x

    return apply


def conv(
    weight: Tensor, bias: Tensor | None, *, strides: Sequence[int], pads: Sequence[int]
) -> Layer:
    """Convolution by [C_out, C_in, H, W] of [1, C_in, H, W]."""
    kernel, ones = constant(weight), [1, 1]

    def apply(x: Node) -> Node:
        y = ops.convolution(x, kernel, list(strides), list(pads), list(pads), ones)
        return y if bias is None else ops.add(y, constant(bias.reshape(1, -1, 1, 1)))

    return apply


def _average(x: Node) -> Node:
    return ops.reduce_mean(x, ints(2, 3), keep_dims=True)


def _moments(x: Node) -> Node:
    """``pooling.moments``: [1, C, H, W] -> [1, 3, C]."""
    _, channels, height, width = x.get_output_shape(0)
    cells = ops.reshape(x, ints(1, channels, height * width), False)
    weights = constant(moment_weights(height, width).T[None])
    return ops.matmul(weights, cells, False, True)


@singledispatch
def layer(module: nn.Module) -> Layer:
    """What the module computes in eval mode, as a function from node to node.

    Raises:
        TypeError: the module has no form here.
    """
    raise TypeError(f"{type(module).__name__} has no OpenVINO form")


@layer.register
def _(module: nn.Sequential) -> Layer:
    return _sequence(*[layer(child) for child in module])


@layer.register
def _(module: nn.Conv2d) -> Layer:
    strides, pads = tuple(module.stride), [int(pad) for pad in module.padding]
    if module.groups == 1:
        return conv(module.weight, module.bias, strides=strides, pads=pads)
    if module.groups != module.in_channels:
        raise TypeError("grouped convolutions have no OpenVINO form, but for depthwise ones")
    kernel = constant(module.weight.unsqueeze(1))  # depthwise: a group of one channel each
    bias = None if module.bias is None else constant(module.bias.reshape(1, -1, 1, 1))

    def apply(x: Node) -> Node:
        y = ops.group_convolution(x, kernel, list(strides), pads, pads, [1, 1])
        return y if bias is None else ops.add(y, bias)

    return apply


@layer.register
def _(module: nn.BatchNorm2d) -> Layer:
    mean, variance = module.running_mean, module.running_var
    if mean is None or variance is None:
        raise TypeError("a batch norm without running statistics has no OpenVINO form")
    constants = [constant(value) for value in (module.weight, module.bias, mean, variance)]
    return lambda x: ops.batch_norm_inference(x, *constants, module.eps)


@layer.register
def _(module: nn.GroupNorm) -> Layer:
    # Not the operator of that name: in bf16 the CPU plugin takes it apart into slower ones.
    def apply(x: Node) -> Node:
        shape = x.get_output_shape(0)
        groups = ops.reshape(x, ints(1, module.num_groups, -1), False)
        normed = ops.mvn(groups, ints(2), True, module.eps, "inside_sqrt")
        back = ops.reshape(normed, ints(*shape), False)
        scaled = ops.multiply(back, constant(module.weight.reshape(1, -1, 1, 1)))
        return ops.add(scaled, constant(module.bias.reshape(1, -1, 1, 1)))

    return apply


@layer.register
def _(module: nn.LayerNorm) -> Layer:
    weight, bias = constant(module.weight), constant(module.bias)

    def apply(x: Node) -> Node:
        normed = ops.mvn(x, ints(-1), True, module.eps, "inside_sqrt")
        return ops.add(ops.multiply(normed, weight), bias)

    return apply


@layer.register
def _(module: ChannelNorm) -> Layer:
    over_last = layer.dispatch(nn.LayerNorm)(module)
    to_last, back = ints(0, 2, 3, 1), ints(0, 3, 1, 2)
    return lambda x: ops.transpose(over_last(ops.transpose(x, to_last)), back)


@layer.register
def _(module: nn.Linear) -> Layer:
    weight = constant(module.weight)
    bias = None if module.bias is None else constant(module.bias)

    def apply(x: Node) -> Node:
        y = ops.matmul(x, weight, False, True)
        return y if bias is None else ops.add(y, bias)

    return apply


@layer.register
def _(_module: nn.SiLU) -> Layer:
    return lambda x: ops.swish(x)


@layer.register
def _(_module: nn.ReLU) -> Layer:
    return lambda x: ops.relu(x)


@layer.register
def _(_module: nn.GELU) -> Layer:
    return lambda x: ops.gelu(x, "erf")


@layer.register
def _(_module: nn.Flatten) -> Layer:
    return lambda x: ops.reshape(x, ints(1, -1), special_zero=False)


@layer.register
def _(module: Permute) -> Layer:
    axes = ints(*module.axes)
    return lambda x: ops.transpose(x, axes)


@layer.register
def _(module: nn.MaxPool2d) -> Layer:
    kernel, stride, pad = (
        np.broadcast_to(size, 2).tolist()
        for size in (module.kernel_size, module.stride, module.padding)
    )
    return lambda x: ops.max_pool(x, stride, [1, 1], pad, pad, kernel).output(0)


# --- blocks of ours


@layer.register
def _(module: SqueezeExcitation) -> Layer:
    gate = _sequence(layer(module.fc1), layer(module.activation), layer(module.fc2))
    return lambda x: ops.multiply(x, ops.sigmoid(gate(_average(x))))


@layer.register
def _(module: MBConv) -> Layer:
    block = layer(module.block)
    return lambda x: ops.add(block(x), x) if module.has_shortcut else block(x)


@layer.register
def _(module: EfficientNetB3) -> Layer:
    features = layer(module.features)
    return lambda x: ops.reshape(_moments(features(x)), ints(1, -1), False)


@layer.register
def _(module: BasicBlock) -> Layer:
    hidden = _sequence(layer(module.conv1), layer(module.bn1), ops.relu)
    hidden = _sequence(hidden, layer(module.conv2), layer(module.bn2))
    shortcut = same if module.downsample is None else layer(module.downsample)
    return lambda x: ops.relu(ops.add(hidden(x), shortcut(x)))


@layer.register
def _(module: Bottleneck) -> Layer:
    hidden = _sequence(layer(module.conv1), layer(module.bn1), ops.relu)
    hidden = _sequence(hidden, layer(module.conv2), layer(module.bn2), ops.relu)
    hidden = _sequence(hidden, layer(module.conv3), layer(module.bn3))
    shortcut = same if module.downsample is None else layer(module.downsample)
    return lambda x: ops.relu(ops.add(hidden(x), shortcut(x)))


@layer.register
def _(module: ResNet) -> Layer:
    stem = (module.conv1, module.bn1, module.relu, module.maxpool)
    stages = (module.layer1, module.layer2, module.layer3, module.layer4)
    features = _sequence(*[layer(part) for part in (*stem, *stages)])
    return lambda x: ops.reshape(_moments(features(x)), ints(1, -1), False)


@layer.register
def _(module: ResNet8) -> Layer:
    parts = (module.conv1, module.bn1, module.relu, module.layers, module.conv2, module.bn2)
    features = _sequence(*[layer(part) for part in parts], ops.relu)
    fc = layer(module.fc)

    def apply(x: Node) -> Node:
        cells = ops.adaptive_avg_pool(features(x), ints(RESNET8_CELLS, RESNET8_CELLS))
        return ops.relu(fc(ops.reshape(cells, ints(1, -1), special_zero=False)))

    return apply


@layer.register
def _(module: ConvNextBlock) -> Layer:
    block, scale = layer(module.block), constant(module.layer_scale)
    return lambda x: ops.add(x, ops.multiply(block(x), scale))


@layer.register
def _(module: ConvNextTiny) -> Layer:
    features, classifier = layer(module.features), layer(module.classifier)

    def apply(x: Node) -> Node:
        y = features(x)
        places = ops.slice(_moments(y), ints(1), ints(MOMENTS), ints(1), ints(1))
        return ops.concat([classifier(_average(y)), ops.reshape(places, ints(1, -1), False)], 1)

    return apply


@layer.register
def _(module: Conv) -> Layer:
    # On rows, [1, C_in, 1, L] -> [1, C_out, 1, L / stride]; a weight is [C_out, taps * C_in].
    linear, taps = module.linear, module.taps
    weight = linear.weight.reshape(linear.out_features, taps, -1).transpose(1, 2).unsqueeze(2)
    return conv(weight, linear.bias, strides=(1, module.stride), pads=(0, taps // 2))


@layer.register
def _(module: AttentionBlock) -> Layer:
    norm1, norm2 = layer(module.norm1), layer(module.norm2)
    qkv, project, mlp = layer(module.qkv), layer(module.project), layer(module.mlp)

    def apply(tokens: Node) -> Node:
        _, count, dim = tokens.get_output_shape(0)
        parts = ops.reshape(qkv(norm1(tokens)), ints(1, count, 3, HEADS, dim // HEADS), False)
        heads = ops.transpose(parts, ints(2, 0, 3, 1, 4))
        query, key, value = (ops.gather(heads, ints(i), ints(0)) for i in range(3))
        scores = ops.multiply(ops.matmul(query, key, False, True), constant((dim // HEADS) ** -0.5))
        mixed = ops.matmul(ops.softmax(scores, -1), value, False, False)  # [1, 1, HEADS, T, d]
        rows = ops.transpose(ops.squeeze(mixed, ints(0)), ints(0, 2, 1, 3))
        tokens = ops.add(tokens, project(ops.reshape(rows, ints(1, count, dim), False)))
        return ops.add(tokens, mlp(norm2(tokens)))

    return apply


@layer.register
def _(module: HistoryEncoder) -> Layer:
    embed, attention, position = layer(module.embed), layer(module.attention), module.position

    def apply(history: Node) -> Node:
        tokens = attention(ops.add(embed(history), constant(position)))
        return ops.reshape(tokens, ints(1, -1), special_zero=False)

    return apply
