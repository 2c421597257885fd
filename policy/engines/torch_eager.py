"""Plain torch, operator by operator: the reference for every other engine."""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from policy.contract import FloatArray
from policy.engines.runner import ArrayFunction, Compile, ExecutionSettings, Shape, make_runner
from policy.errors import PolicyError
from policy.protocol import PolicyRunner, SingleRatePolicy

NAME = "torch"


def make_torch_runner(policy: SingleRatePolicy, settings: ExecutionSettings) -> PolicyRunner:
    """Wrap a torch policy for the loops: numpy in and out, no gradients, tried once.

    A module is moved to the action device, and copied to the vision device if that differs. In dual
    rate, torch is set to one thread per operator in the whole process.
    """
    if settings.dual_rate:
        torch.set_num_threads(1)  # two loops infer at once: one core each, no contention
    vision = action = policy
    if isinstance(policy, nn.Module):
        policy.to(settings.action_device).eval()
        if settings.vision_device != settings.action_device:
            vision = copy.deepcopy(policy).to(settings.vision_device)
    return make_runner(
        vision,
        action,
        run_eagerly(settings.name, settings.vision_device),
        run_eagerly(settings.name, settings.action_device),
        engine=NAME,
        settings=settings,
    )


def run_eagerly(name: str, device: str) -> Compile:
    """ "Compile" a function for torch on a device: convert arrays to tensors and back."""

    def compile_(method: Callable[..., Any], _shapes: Sequence[Shape]) -> ArrayFunction:
        def run(*arrays: FloatArray) -> FloatArray:
            with torch.inference_mode():
                # torch.tensor copies: published arrays are read-only, which torch cannot express.
                result = method(*[torch.tensor(array, device=device) for array in arrays])
                if not isinstance(result, Tensor):
                    raise PolicyError(
                        f"{name} returned {type(result).__name__}; its contract says torch tensors"
                    )
                # Copy the output: a policy may return a buffer that it overwrites.
                return np.array(result.cpu().numpy(), np.float32)

        return run

    return compile_
