"""Which engine runs a policy: the fastest that is present and computes what plain torch computes.

An engine that cannot be made, or fails the parity gate, is passed over with a note of the reason.
Torch, the reference, is last.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec

import numpy as np
import torch
from torch import nn

from policy.contract import FloatArray
from policy.engines.executable import EngineName, ExecutionSettings
from policy.engines.parity import ParitySamples, make_parity_samples, parity_failure
from policy.engines.torch_eager import make_torch_executable
from policy.errors import PolicyError
from policy.nets.resnet_unet import ResnetUnet
from policy.nets.toge import Toge
from policy.protocol import Executable, SingleRatePolicy

SAMPLE_ELAPSED_S = 0.02
"""Time between the two chunks of a sample: with a warm start, the second is a refinement."""

Candidate = tuple[str, Callable[[], Executable]]
"""The name of an engine to try, and what makes it."""


def choose_executable(
    policy: SingleRatePolicy, engine: EngineName, settings: ExecutionSettings
) -> tuple[Executable, tuple[str, ...]]:
    """The executable and lines for a person: the engine, and why faster ones were passed over.

    Raises:
        PolicyError: the engine asked for is absent here or does not serve this policy or device;
            or the policy itself failed.
    """
    if engine == "torch" or (engine == "auto" and not isinstance(policy, Toge | ResnetUnet)):
        return make_torch_executable(policy, settings), ()
    if not isinstance(policy, nn.Module):
        raise PolicyError(
            f"--engine {engine} takes a torch.nn.Module: leave it out, and {settings.name} runs on "
            "torch"
        )
    candidates = _candidates(policy, engine, settings)
    return first_that_agrees(policy, candidates, settings)


def first_that_agrees(
    policy: SingleRatePolicy, candidates: list[Candidate], settings: ExecutionSettings
) -> tuple[Executable, tuple[str, ...]]:
    """The first candidate that passes the gate, or torch, with a line for each one passed over.

    Raises:
        PolicyError: the policy fails on torch itself.
    """
    notes: list[str] = []
    if candidates:
        on_cpu = replace(settings, vision_device="cpu", action_device="cpu")
        samples = make_parity_samples(policy.contract)
        expected = chunks_of_samples(make_torch_executable(policy, on_cpu), samples)
    for label, make in candidates:
        try:
            executable = make()
            reason = parity_failure(expected, chunks_of_samples(executable, samples))
        except (PolicyError, RuntimeError, TypeError) as error:
            reason = f"{type(error).__name__}: {str(error).strip().splitlines()[0]}"
        if reason is None:
            return executable, (*notes, f"engine {executable.engine}: agrees with torch")
        notes.append(f"warning: engine {label} is passed over: {reason}")
    return make_torch_executable(policy, settings), tuple(notes)


def chunks_of_samples(executable: Executable, samples: ParitySamples) -> FloatArray:
    """Chunks [2 * samples, horizon, 4] from image to stick: each sample afresh, then once more."""
    chunks = []
    for rgb, state, history in zip(samples.rgb, samples.state, samples.history, strict=True):
        encoded = executable.encode(rgb)
        for elapsed_s in (None, SAMPLE_ELAPSED_S):
            chunks.append(executable.act(encoded, state[None], history[None], elapsed_s)[0])
    return np.stack(chunks)


def _candidates(
    policy: SingleRatePolicy, engine: EngineName, settings: ExecutionSettings
) -> list[Candidate]:
    devices = {settings.vision_device.split(":")[0], settings.action_device.split(":")[0]}
    if engine == "openvino" and devices != {"cpu"}:
        raise PolicyError(f"--engine openvino runs on --device cpu, not on {sorted(devices)}")
    if engine == "cuda-graph" and devices != {"cuda"}:
        raise PolicyError(f"--engine cuda-graph runs on --device cuda, not on {sorted(devices)}")
    if devices == {"cpu"} and find_spec("openvino") is not None:
        from policy.engines.openvino_cpu import make_openvino_executable, precisions

        return [
            (
                f"openvino (images {vision}, actions {action})",
                partial(make_openvino_executable, policy, settings, vision, action),
            )
            for vision, action in precisions()
        ]
    if engine == "openvino":
        raise PolicyError("--engine openvino: the package is missing; pip install openvino")
    if devices == {"cuda"} and torch.cuda.is_available():
        from policy.engines.cuda_graph import make_cuda_graph_executable

        return [("cuda-graph", partial(make_cuda_graph_executable, policy, settings))]
    return []
