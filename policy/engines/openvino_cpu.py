"""OpenVINO on the CPU: the image path and the action path as one compiled graph each."""

import hashlib
from collections.abc import Callable

from torch import nn

from policy.engines.openvino_compile import GraphCompiler, engine_name
from policy.engines.openvino_graph import denoise_graph, step_inputs, vision_graph
from policy.engines.openvino_modules import ModuleConverter, make_module_runner
from policy.engines.runner import (
    ExecutionSettings,
    Precision,
    assemble,
)
from policy.engines.signal_stack import signal_stack_kept
from policy.engines.stepwise import Segment, sample_in_segments, to_numpy
from policy.nets.resnet_unet import ResnetUnet
from policy.nets.toge import Toge
from policy.preprocess import egocentric
from policy.protocol import PolicyRunner, SingleRatePolicy

MAX_UNROLLED = 10
"""Denoising steps in one graph: each takes a third of a second to convert, the first time."""


@signal_stack_kept()
def make_openvino_runner(
    policy: SingleRatePolicy,
    settings: ExecutionSettings,
    vision: Precision,
    action: Precision,
    converter: ModuleConverter | None = None,
) -> PolicyRunner:
    """Compile a policy for the loops, or take it from the user's cache; tried once.

    The initial noise of the policy is taken as it is now; ``vision`` and ``action`` are the
    precisions of both paths. A policy that is none of ours is converted by ``converter``, which
    may be kept from one precision to the next.

    Raises:
        PolicyError: it holds no torch module, cannot be converted, has no fast path where one was
            asked for, or failed on a dummy sample.
        RuntimeError: OpenVINO cannot compile it.
    """
    if isinstance(policy, Toge | ResnetUnet):
        return _make_builtin(policy, settings, vision, action)
    converter = converter or ModuleConverter(policy, settings.name)
    return make_module_runner(policy, settings, vision, action, converter)


def _make_builtin(
    policy: Toge | ResnetUnet, settings: ExecutionSettings, vision: Precision, action: Precision
) -> PolicyRunner:
    name, steps = engine_name(vision, action), settings.num_diffusion_steps
    compiler = GraphCompiler(f"{policy.config} {digest_of_weights(policy)}")
    encode = compiler.compile("vision", vision, lambda: vision_graph(policy))
    at_once = min(steps, MAX_UNROLLED)
    segment = _segments(compiler, policy, action, steps, at_once)
    sample = sample_in_segments(to_numpy(policy.head.initial_noise), segment, steps, at_once)
    if settings.dual_rate:
        return assemble(policy.contract, (encode,), sample, name, settings)
    return assemble(
        policy.contract, (), lambda image, s, h: sample(encode(image), s, h), name, settings
    )


def _segments(
    compiler: GraphCompiler,
    policy: Toge | ResnetUnet,
    precision: Precision,
    steps: int,
    unrolled: int,
) -> Callable[[int, int], Segment]:
    """(first, count <= ``unrolled``) -> that part of a solve of ``steps``.

    One graph, and so one copy of the weights, runs them all: what tells the steps apart are inputs.
    """
    denoise = compiler.compile(
        f"denoise {unrolled}", precision, lambda: denoise_graph(policy, unrolled)
    )

    def segment(first: int, count: int) -> Segment:
        films, updates = step_inputs(policy.head, steps, first, count, unrolled)
        return lambda encoded, state, history, noisy: denoise(
            encoded, egocentric(state, policy.contract), history, noisy, films, updates
        )

    return segment


def digest_of_weights(module: nn.Module) -> str:
    """A text that differs wherever a weight does."""
    digest = hashlib.sha256()
    for name, value in module.state_dict().items():
        digest.update(f"{name} {value.dtype} {list(value.shape)}".encode())
        digest.update(value.cpu().contiguous().numpy())
    return digest.hexdigest()
