"""Policies made of torch modules, named by a user's class or stored in a TorchScript archive.

docs/policy_exported.md lists the names and arguments of the modules; shapes are those of
``policy.protocol``, and ``timestep`` is [B] float32. Arguments beyond the last that a function
declares are not passed. An archive may have methods with these names, and a policy.json.
"""

import inspect
import json
import math
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from policy.adapters.description import USUAL_NAMES, Description, is_ordered
from policy.adapters.interface import Interface
from policy.contract import ACTION_DIM
from policy.engines.torch_engines import modules_of
from policy.errors import CheckpointError, PolicyError, user_code
from policy.files import last_line, library_name, why_unreadable
from policy.nets.diffusion import NoiseSchedule, flight_noise
from policy.protocol import SingleRatePolicy, predict_by_pair, predict_by_steps

Call = Callable[..., Any]
"""Part of a policy, called as this module's docstring says."""
PARTS = "forward alone, visual_encoder and action_head, or visual_encoder and denoiser"


def adopt_modules(
    name: str, holder: object, description: Description, seed: int
) -> SingleRatePolicy | None:
    """Return the policy made of the modules or methods of ``holder``, or None if it has none.

    A contract without feature_dim gets it from the encoder's output.
    """
    encoder, head, denoiser = (
        getattr(holder, part, None) for part in ("visual_encoder", "action_head", "denoiser")
    )
    interface, modules = description.interface, modules_of(holder)
    if encoder is None and head is None and denoiser is None:
        if not _has_forward(holder):
            return None
        call = _Call(name, holder, "chunk", description, ("image", "state", "action_history"))
        call.skip = int(_takes_no_image(call, interface))
        call.require_order()
        return _owned(ForwardPolicy(interface, call), holder, modules)
    if encoder is None or (head is None) == (denoiser is None):
        raise PolicyError(f"{name}: its modules do not make a policy: it takes {PARTS}")
    for module in modules:
        module.eval()
    features = _Call(name, encoder, "feature", description, ("image",))

    def encode(image: Tensor) -> Tensor:
        return features(image).flatten(1)

    interface = _with_feature(name, encode, interface)
    if head is not None:
        call = _Call(name, head, "chunk", description, ("feature", "state", "action_history"))
        call.require_order()
        return _owned(HeadPolicy(interface, encode, call), holder, modules)
    schedule = getattr(holder, "noise_schedule", None) or NoiseSchedule()
    if description.schedule:
        schedule = make_schedule(name, description.schedule)
    roles = ("noisy", "timestep", "feature", "state", "action_history")
    call = _Call(name, denoiser, "prediction", description, roles)
    call.require_order()
    return _owned(DenoiserPolicy(interface, encode, call, schedule, seed), holder, modules)


def load_torchscript(
    spec: str, path: Path, description: Description, seed: int
) -> SingleRatePolicy:
    """Load the policy of a TorchScript archive, on the CPU."""
    try:
        # torch warns that this is deprecated; few projects export to its successor yet.
        with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
            module = torch.jit.load(library_name(path), map_location="cpu").eval()  # type: ignore[no-untyped-call]
    except (RuntimeError, OSError) as error:
        raise CheckpointError(why_unreadable(path, error)) from error
    graphs = [part.graph for part in module.modules() if _has_forward(part)]
    if any(_is_training(node) for each in graphs for node in each.findAllNodes("aten::batch_norm")):
        raise CheckpointError(
            f"{path} was traced in training mode, in which a batch norm scales each image by its "
            "own statistics: call eval() of the module before torch.jit.trace"
        )
    contract = replace(description.interface.contract, arrays="torch")
    interface = replace(description.interface, contract=contract)
    policy = adopt_modules(spec, module, replace(description, interface=interface), seed)
    if policy is None:
        raise CheckpointError(f"--policy {spec}: the archive has none of {PARTS}")
    return policy


def make_schedule(where: object, fields: dict[str, Any]) -> NoiseSchedule:
    """Return the schedule of a description; a PolicyError names ``where`` a wrong field stands."""
    try:
        return NoiseSchedule(**fields)
    except (TypeError, PolicyError) as error:
        raise PolicyError(
            f"{where}: schedule {fields} is malformed ({error}): it takes num_train_timesteps, "
            "betas and prediction"
        ) from error


class ForwardPolicy(nn.Module):
    """Single rate: one call makes a chunk from image, state and history.

    Calls take and return tensors, or numpy arrays if the contract says so.
    """

    def __init__(self, interface: Interface, call: Call) -> None:
        super().__init__()
        self.contract = interface.contract
        self._call, self._interface = call, interface

    def predict(self, image: Any, state: Any, action_history: Any, num_diffusion_steps: int) -> Any:
        """Make the call."""
        return self.to_chunk(self._call(image, *self._own(state, action_history)))

    def to_chunk(self, sample: Any) -> Any:
        """Convert the policy's actions [1, L, 4] to the contract's; axes of 1 may be missing."""
        wanted = (1, self.contract.horizon, ACTION_DIM)
        if (1, 1, *sample.shape)[-3:] == wanted and math.prod(sample.shape) == math.prod(wanted):
            sample = sample.reshape(wanted)
        return self._interface.to_actions(sample)

    def _own(self, state: Any, history: Any) -> tuple[Any, Any]:
        """Return state and history in the policy's order and units."""
        return self._interface.to_state(state), self._interface.from_actions(history)


class HeadPolicy(ForwardPolicy):
    """Dual rate: an encoder, and a head that makes a chunk in one call."""

    def __init__(self, interface: Interface, encode: Call, head: Call) -> None:
        super().__init__(interface, head)
        self._encode = encode

    def encode_visual(self, image: Any, camera: int = 0) -> Any:
        """Encode an image [1, 3, H, W] -> feature [1, F]; all cameras share one encoder."""
        return self._encode(image)

    def predict_fast(
        self, feature: Any, state: Any, action_history: Any, num_diffusion_steps: int
    ) -> Any:
        """Call the head once."""
        return self.to_chunk(self._call(feature, *self._own(state, action_history)))

    predict = predict_by_pair


class DenoiserPolicy(HeadPolicy):
    """Dual rate: an encoder and one step of a diffusion solve, as ``protocol.StepwisePolicy``."""

    def __init__(
        self,
        interface: Interface,
        encode: Call,
        denoiser: Call,
        schedule: NoiseSchedule,
        seed: int,
    ) -> None:
        super().__init__(interface, encode, denoiser)
        if not isinstance(schedule, NoiseSchedule):
            raise PolicyError(
                f"noise_schedule must be a policy.nets.diffusion.NoiseSchedule, got {schedule!r}"
            )
        if any(interface.action_offset):
            raise PolicyError("[action] offset must be zeros for a denoiser: noise is about 0")
        self.schedule = schedule
        self.initial_noise = nn.Buffer(flight_noise(seed, self.contract.horizon), persistent=False)

    def denoise(
        self, noisy: Any, timestep: Any, feature: Any, state: Any, action_history: Any
    ) -> Any:
        """Call the denoiser once."""
        return self._call(noisy, timestep, feature, *self._own(state, action_history))

    predict_fast = predict_by_steps


def _with_feature(name: str, encode: Call, interface: Interface) -> Interface:
    """Return the interface; a missing feature_dim is taken from the encoder's output."""
    contract = interface.contract
    if contract.feature_dim > 0:
        return interface
    with user_code(f"{name}: visual_encoder failed on a dummy image"), torch.inference_mode():
        image = torch.zeros(1, *contract.image_shape[-3:])
        dim = encode(image).shape[1]
    return replace(interface, contract=replace(contract, feature_dim=dim))


def _owned(policy: ForwardPolicy, holder: object, modules: list[nn.Module]) -> ForwardPolicy:
    """Add the modules, and ``reset`` and ``close`` of their owner, to the policy."""
    policy.held = nn.ModuleList(modules)
    for name in ("reset", "close"):
        if (method := getattr(holder, name, None)) is not None:
            # Python cannot inspect the signature of a TorchScript method.
            setattr(policy, name, (lambda call=method: call()) if _is_script(method) else method)
    return policy


def _is_script(method: object) -> bool:
    return getattr(method, "schema", None) is not None


def _takes_no_image(call: "_Call", interface: Interface) -> bool:
    """True if the first argument of a forward is the state.

    Decided by the argument's name; a single argument without a telling name is tried. Raises
    PolicyError if it accepts neither, or both and may be either by its name.
    """
    first = next(iter(call.names), "")
    is_state, is_observation = first in USUAL_NAMES["state"], first.startswith("obs")
    is_told = is_state or first in (*USUAL_NAMES["image"], *interface.camera_keys)
    if len(call.names) != 1 or (is_told and not is_observation):
        return is_state
    contract = interface.contract
    shapes = ((*contract.state_shape[:-1], interface.state_dim), contract.image_shape)
    refusals = []
    for shape in shapes:
        try:
            with torch.inference_mode(), suppress(PolicyError):  # it ran: its result comes later
                call(torch.zeros(1, *shape))
            refusals.append("")
        except Exception as error:  # noqa: BLE001 - a foreign module may raise anything
            refusals.append(f"{[1, *shape]} ({last_line(error)})")
    if all(refusals):
        state, image = refusals
        raise PolicyError(
            f"{call.name}: its {first} takes neither a state {state} nor an image {image}"
        )
    if not any(refusals) and not is_state:
        raise PolicyError(
            f"{call.name}: its {first or 'input'} may be a state or an image, it takes both: call "
            f'it so, or write "inputs": {{"state": "{first}"}} into policy.json'
        )
    return not refusals[0]


def _has_forward(holder: object) -> bool:
    if isinstance(holder, torch.jit.ScriptModule):
        return _is_script(getattr(holder, "forward", None))
    return isinstance(holder, nn.Module) and type(holder).forward is not nn.Module.forward


def _unwrapped(function: Any) -> Any:
    """Return the module inside those of torch.compile and data parallelism, which declare no
    arguments of their own."""
    while True:
        is_parallel = isinstance(function, nn.DataParallel)
        inner = function.module if is_parallel else getattr(function, "_orig_mod", None)
        if inner is None:
            return function
        function = inner


def _is_training(batch_norm: Any) -> bool:
    """True if a graph's batch norm is fixed in training mode; without averages it has only one."""
    _, _, _, average, _, is_training, *_ = batch_norm.inputs()
    return is_training.toIValue() is True and not average.node().mustBeNone()


class _Call:
    """Module or function that is passed as many arguments as it declares and returns one tensor."""

    def __init__(
        self,
        name: str,
        function: Any,
        result: str,
        description: Description,
        roles: Sequence[str],
    ) -> None:
        """Prepare the calls, with arguments of these roles.

        ``outputs[result]`` of the description selects the result among several values, and its
        ``inputs`` name arguments. An argument with a number or text as its default is a setting
        and keeps it, with all after it, unless it is named as a role.
        """
        self.name, self._function, self._roles = name, function, roles
        self._result, self._pick = result, description.outputs.get(result)
        self.skip = 0
        """Leading arguments to drop: 1 for a policy that takes no image."""
        inner = _unwrapped(function)
        called = inner.forward if isinstance(inner, nn.Module) else inner
        schema = getattr(called, "schema", None)  # of TorchScript
        takes_any = False
        if schema is not None:
            declared = [(each.name, each.default_value) for each in schema.arguments[1:]]
        else:
            parameters = inspect.signature(called).parameters.values()
            takes_any = any(each.kind is each.VAR_POSITIONAL for each in parameters)
            by_place = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
            declared = [(each.name, each.default) for each in parameters if each.kind in by_place]
        usual = {name for role in roles for name in USUAL_NAMES[role]}
        given = takewhile(
            lambda each: each[0] in usual or not isinstance(each[1], int | float | str), declared
        )
        told = {name: role for role, name in description.inputs.items()}
        self.names = [told.get(name, name) for name, _ in given]
        takes_all = takes_any and len(self.names) == len(declared)
        self._count = sys.maxsize if takes_all else len(self.names)

    def require_order(self) -> None:
        """Raise PolicyError if an argument has the usual name of another role than its own."""
        told = ["" if name.startswith("obs") else name for name in self.names]  # any may be one
        if not is_ordered([""] * self.skip + told, self._roles):
            raise PolicyError(
                f"{self.name}: its {self._result} is made from {', '.join(self._roles)}, passed "
                f"in this order, but the arguments are {', '.join(self.names)}: reorder or rename "
                "them"
            )

    def __call__(self, *arguments: Tensor) -> Tensor:
        returned: object = self._function(*arguments[self.skip :][: self._count])
        values = returned
        if isinstance(values, Sequence):
            values = dict(enumerate(values))
        if isinstance(values, Mapping):
            only = next(iter(values)) if len(values) == 1 else None
            pick = only if self._pick is None else self._pick
            if pick not in values:
                raise PolicyError(
                    f"{self.name}: it returns {len(values)} values "
                    f"({', '.join(map(str, values))}): return the {self._result} alone, or say in "
                    f'an archive\'s policy.json which it is, "outputs": {{"{self._result}": '
                    f"{json.dumps(next(iter(values), 0))}}}"
                )
            returned = values[pick]
        if not isinstance(returned, Tensor):
            raise PolicyError(
                f"{self.name}: its {self._result} is a {type(returned).__name__}, not a tensor"
            )
        if not returned.is_floating_point():
            raise PolicyError(
                f"{self.name}: its {self._result} is of type {returned.dtype}, and the contract's "
                "numbers are not whole: what do they count? Export the continuous actions"
            )
        return returned
