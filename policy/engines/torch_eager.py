"""Plain torch, operator by operator: the reference for every other engine."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from policy.contract import Executable, FloatArray, PolicyError, SingleRatePolicy
from policy.engines.executable import make_executable

NAME = "torch"


def make_torch_executable(
    policy: SingleRatePolicy,
    *,
    name: str,
    device: str,
    num_diffusion_steps: int,
    dual_rate: bool,
) -> Executable:
    """Wrap a torch policy for the loops: numpy in and out, no gradients, tried once.

    Args:
        policy: takes and returns torch tensors; moved to ``device`` where it is a module.
        name: shown to people.
        device: a torch device that exists.
        num_diffusion_steps: for every sample.
        dual_rate: whether encode runs the image path; needs a ``DualRatePolicy``.

    In dual rate torch is told to use one thread an operator, in the whole process.

    Raises:
        PolicyError: no fast path, or the policy failed on a dummy sample.
    """
    if isinstance(policy, nn.Module):
        policy.to(device).eval()
    if dual_rate:
        torch.set_num_threads(1)  # two loops infer at once: one core each, no pool to fight over

    def run(method: Callable[..., Any], *arrays: FloatArray) -> FloatArray:
        with torch.inference_mode():
            # torch.tensor copies: published arrays are read-only, which torch cannot express.
            result = method(*[torch.tensor(array, device=device) for array in arrays])
            if not isinstance(result, Tensor):
                raise PolicyError(
                    f"{name} returned {type(result).__name__}; its contract says torch tensors"
                )
            return np.asarray(result.cpu().numpy(), np.float32)

    return make_executable(
        policy,
        run,
        name=name,
        engine=NAME,
        num_diffusion_steps=num_diffusion_steps,
        dual_rate=dual_rate,
    )
