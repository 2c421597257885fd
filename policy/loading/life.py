"""The two optional methods of a policy's life: ``reset()`` and ``close()``."""

import inspect
from collections.abc import Callable
from contextlib import ExitStack

from policy.errors import PolicyError, user_code
from policy.protocol import SingleRatePolicy, keep_nothing

_WHEN = {"reset": "when a flight begins", "close": "when it is not needed any more"}


def life_method(policy: SingleRatePolicy, name: str, spec: str) -> Callable[[], None]:
    """The policy's own ``reset`` or ``close``, ready to call; a no-op if it has none."""
    method: object = getattr(policy, name, None)
    if method is None:
        return keep_nothing
    if not callable(method):
        raise PolicyError(
            f"--policy {spec}: {name} must be a method without arguments, which is called "
            f"{_WHEN[name]}; it is {method!r}"
        )
    try:
        inspect.signature(method).bind()
    except (TypeError, ValueError) as error:
        raise PolicyError(
            f"--policy {spec}: {name} is called without arguments {_WHEN[name]}, and cannot be: "
            f"{error}; give its parameters defaults, or give it another name"
        ) from error
    with_torch = policy.contract.arrays == "torch"

    def call() -> None:
        with ExitStack() as stack:
            stack.enter_context(user_code(f"{spec} failed to {name}"))
            if with_torch:
                import torch

                # As chunks are computed: torch refuses to change their tensors in place elsewhere.
                stack.enter_context(torch.inference_mode())
            method()

    return call
