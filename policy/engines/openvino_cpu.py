"""OpenVINO on the CPU: the image path and the action path as one compiled graph each.

Each path infers on its own thread alone, without the GIL, on arrays that are bound once. Threads
are not pinned to cores: measured beside a second loop, pinning was slower or made no difference.
"""

import hashlib
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import openvino as ov
import torch
from torch import nn

from policy.contract import FloatArray
from policy.engines.compile_cache import CompileCache, user_cache_folder
from policy.engines.executable import (
    Act,
    Compile,
    ExecutionSettings,
    Precision,
    always_full,
    assemble,
    make_executable,
)
from policy.engines.openvino_graph import convert, denoise_graph, step_inputs, vision_graph
from policy.engines.signal_stack import signal_stack_kept
from policy.engines.warm_start import Segment, WarmStart, make_solve
from policy.errors import PolicyError
from policy.nets.resnet_unet import ResnetUnet
from policy.nets.toge import Toge
from policy.preprocess import egocentric
from policy.protocol import Executable, SingleRatePolicy

NAME = "openvino"
DEVICE = "CPU"

MAX_UNROLLED = 10
"""Denoising steps in one graph: each takes a third of a second to convert, the first time."""


@signal_stack_kept()
def precisions() -> tuple[tuple[Precision, Precision], ...]:
    """Pairs to try for the image and the action path, the fastest first.

    bf16 only where the CPU computes in it; elsewhere it is emulated, or slower than float32.
    """
    if "BF16" in ov.Core().get_property(DEVICE, "OPTIMIZATION_CAPABILITIES"):
        return ("bf16", "bf16"), ("bf16", "f32"), ("f32", "f32")
    return (("f32", "f32"),)


@signal_stack_kept()
def make_openvino_executable(
    policy: SingleRatePolicy, settings: ExecutionSettings, vision: Precision, action: Precision
) -> Executable:
    """Compile a policy for the loops, or take it from the user's cache; tried once.

    A module of a user is traced, so what it decides by a tensor's values, or keeps between calls,
    is frozen. It is not cached: its code may change where its weights do not. The initial noise of
    the policy is taken as it is now; ``vision`` and ``action`` are the precisions of both paths.

    Raises:
        PolicyError: it is no torch module, cannot be converted, has no fast path where one was
            asked for, or failed on a dummy sample.
        RuntimeError: OpenVINO cannot compile it.
    """
    name = f"{NAME}-{vision}" if vision == action else f"{NAME}-{vision}-{action}"
    if isinstance(policy, Toge | ResnetUnet):
        return _make_builtin(policy, settings, vision, action, name)
    if not isinstance(policy, nn.Module):
        raise PolicyError(f"{settings.name} is no torch.nn.Module, so it cannot be converted")
    module = policy.eval()

    def compile_as(precision: Precision) -> Compile:
        return lambda function, shapes: _Graph(
            ov.Core().compile_model(
                convert(module, function, shapes), DEVICE, _properties(precision)
            )
        )

    return make_executable(
        policy, policy, compile_as(vision), compile_as(action), engine=name, settings=settings
    )


def _make_builtin(
    policy: Toge | ResnetUnet,
    settings: ExecutionSettings,
    vision: Precision,
    action: Precision,
    name: str,
) -> Executable:
    compiler, steps = _Compiler(policy), settings.num_diffusion_steps
    encode = compiler.compile("vision", vision, lambda: vision_graph(policy))
    warm_steps = settings.head_steps if settings.dual_rate and isinstance(policy, Toge) else None
    at_once = min(steps, MAX_UNROLLED) if warm_steps is None else warm_steps
    segment = _segments(compiler, policy, action, steps, at_once)
    solve = make_solve(policy.head, segment, steps, at_once)
    if warm_steps is not None:
        act: Act = WarmStart(solve, chunk_dt_s=policy.contract.chunk_dt_s)
        return assemble(policy.contract, encode, act, name, settings)
    if settings.dual_rate:
        return assemble(policy.contract, encode, always_full(solve.sample), name, settings)
    act = always_full(lambda image, s, h: solve.sample(encode(image), s, h))
    return assemble(policy.contract, lambda image: image, act, name, settings)


def _segments(
    compiler: "_Compiler",
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


class _Compiler:
    """Compiles the graphs of a policy of ours; a key holds all that the result depends on."""

    def __init__(self, policy: Toge | ResnetUnet) -> None:
        self._core = ov.Core()
        self._cache = CompileCache(user_cache_folder() / NAME)
        digest = hashlib.sha256()
        here = Path(__file__).parent
        for source in sorted([*here.glob("openvino_*.py"), *here.parent.glob("nets/*.py")]):
            digest.update(source.read_bytes())
        for name, value in policy.state_dict().items():
            digest.update(f"{name} {value.dtype} {list(value.shape)}".encode())
            digest.update(value.cpu().contiguous().numpy())
        cpu = self._core.get_property(DEVICE, "FULL_DEVICE_NAME")
        capabilities = self._core.get_property(DEVICE, "OPTIMIZATION_CAPABILITIES")
        versions = f"{ov.__version__} {torch.__version__}"
        self._key = f"{digest.hexdigest()} {policy.config} {versions} {cpu} {capabilities}"

    def compile(self, name: str, precision: Precision, build: Callable[[], "ov.Model"]) -> "_Graph":
        properties = _properties(precision)
        key = f"{self._key} {name} {properties}"
        stored = self._cache.load(key)
        if stored is not None:
            try:
                return _Graph(self._core.import_model(io.BytesIO(stored), DEVICE, properties))
            except RuntimeError:
                pass  # of another build after all: compile it again
        compiled = self._core.compile_model(build(), DEVICE, properties)
        self._cache.store(key, compiled.export_model().getvalue())
        return _Graph(compiled)


def _properties(precision: Precision) -> dict[str, str]:
    return {
        "PERFORMANCE_HINT": "LATENCY",
        "NUM_STREAMS": "1",
        "INFERENCE_NUM_THREADS": "1",
        "ENABLE_CPU_PINNING": "NO",
        "INFERENCE_PRECISION_HINT": precision,
    }


class _Graph:
    """One compiled graph with arrays of its own at every input; for one thread."""

    def __init__(self, compiled: "ov.CompiledModel") -> None:
        self._request = compiled.create_infer_request()
        self._inputs = [np.zeros(port.shape, np.float32) for port in compiled.inputs]
        for index, array in enumerate(self._inputs):
            self._request.set_input_tensor(index, ov.Tensor(array, shared_memory=True))
        self._output = np.zeros(compiled.output(0).shape, np.float32)
        self._request.set_output_tensor(ov.Tensor(self._output, shared_memory=True))

    def __call__(self, *arrays: FloatArray) -> FloatArray:
        """Run the graph; the result is the caller's. An array of another shape is refused."""
        for index, (own, array) in enumerate(zip(self._inputs, arrays, strict=True)):
            if own.shape != array.shape:
                raise PolicyError(
                    f"input {index} must be {list(own.shape)}, got {list(array.shape)}"
                )
            np.copyto(own, array)
        self._request.infer()
        return self._output.copy()
