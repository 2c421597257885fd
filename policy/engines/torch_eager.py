"""Plain torch, operator by operator: the reference for every other engine.

And what a user's policy holds: its modules, and the attributes that change from call to call.
"""

from collections.abc import Collection
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from policy.engines.runner import Compile, ExecutionSettings, make_runner, run_as
from policy.protocol import PolicyRunner, SingleRatePolicy

NAME = "torch"


def make_torch_runner(policy: SingleRatePolicy, settings: ExecutionSettings) -> PolicyRunner:
    """Wrap a torch policy for the loops: numpy in and out, no gradients, tried once.

    A module is moved to the device. In dual rate, torch is set to one thread per operator in the
    whole process.
    """
    if settings.dual_rate:
        torch.set_num_threads(1)  # two loops infer at once: one core each, no contention
    if isinstance(policy, nn.Module):
        policy.to(settings.device).eval()
    run = run_eagerly(settings.name, settings.device)
    return make_runner(policy, run, run, engine=NAME, settings=settings)


def run_eagerly(name: str, device: str) -> Compile:
    """ "Compile" a function for torch on a device: convert arrays to tensors and back."""
    # torch.tensor copies: published arrays are read-only, which torch cannot express.
    run = run_as(name, partial(torch.tensor, device=device), Tensor, "torch tensors")
    return lambda method, shapes: torch.inference_mode()(run(method, shapes))


def modules_of(policy: object) -> list[nn.Module]:
    """Return the policy itself if it is a module, else the modules among its attributes."""
    if isinstance(policy, nn.Module):
        return [policy]
    values = vars(policy).values() if hasattr(policy, "__dict__") else ()
    return [value for value in values if isinstance(value, nn.Module)]


def snapshot(policy: object) -> dict[str, object]:
    """Return the attributes of a policy and of all its modules, by name, in a comparable form.

    Tensors are compared by value, except the weights, which no forward call changes; numpy arrays,
    numbers and texts by value; collections by the identity of their elements; other objects by
    identity.
    """
    holders: dict[str, object] = {"": policy}
    for at, module in enumerate(modules_of(policy)):
        holders |= {f"{at}.{name}.": child for name, child in module.named_modules() if name}
        holders[f"{at}."] = module
    marks: dict[str, object] = {}
    for path, holder in holders.items():
        attributes = dict(vars(holder)) if hasattr(holder, "__dict__") else {}
        attributes |= attributes.pop("_buffers", {})
        attributes.pop("_parameters", None)
        marks |= {f"{path}{name}": _mark(value) for name, value in attributes.items()}
    return marks


def changes(before: dict[str, object], after: dict[str, object]) -> list[str]:
    """Return the names, without the path, of attributes that were added, removed or changed."""
    names = [name for name in {**before, **after} if before.get(name) != after.get(name)]
    return sorted({name.rpartition(".")[2] for name in names})


def _mark(value: object) -> object:
    if isinstance(value, Tensor):
        array = value.detach().cpu().contiguous()
        return str(array.dtype), tuple(array.shape), array.float().numpy().tobytes()
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if value is None or isinstance(value, bool | int | float | str | bytes):
        return value
    if isinstance(value, dict):
        return tuple((id(key), id(element)) for key, element in value.items())
    if isinstance(value, Collection):
        return tuple(map(id, value))
    return id(value)
