"""A policy of the user's own: any class with the members of ``policy.contract``."""

import importlib
import inspect
from pathlib import Path

from policy.contract import Contract
from policy.errors import PolicyError, user_code
from policy.protocol import DualRatePolicy, SingleRatePolicy

FORMS = (
    "toge[:SIZE][:BACKBONE], resnet-unet[:SIZE], scripted[:PROGRAM][:ACTION][:air] or "
    "package.module:Class"
)
"""What a user may write to name a policy."""


def user_class_name(spec: str) -> tuple[str, str]:
    """(package.module, Class); raises PolicyError if ``spec`` has another form."""
    module_name, _, class_name = spec.partition(":")
    if not all(name.isidentifier() for name in (*module_name.split("."), class_name)):
        raise PolicyError(f"policy {spec!r} is unknown; write {FORMS}")
    return module_name, class_name


def load_user_class(spec: str, checkpoint: Path | None) -> SingleRatePolicy:
    """Import a class that keeps the protocol of ``policy.contract``, and make one.

    Raises:
        PolicyError: there is no such class, it cannot be made, or a member is missing.
    """
    module_name, class_name = user_class_name(spec)
    try:
        with user_code(f"importing {module_name} failed"):
            module = importlib.import_module(module_name)
    except PolicyError as error:
        raise PolicyError(
            f"--policy {spec}: {error}; put its folder on PYTHONPATH or install it, or write "
            f"{FORMS}"
        ) from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        classes = sorted(name for name, value in vars(module).items() if isinstance(value, type))
        raise PolicyError(f"--policy {spec}: no class {class_name} there; it has {classes}")
    return _instance(spec, found, checkpoint)


def _instance(spec: str, found: type, checkpoint: Path | None) -> SingleRatePolicy:
    arguments: dict[str, Path] = {} if checkpoint is None else {"checkpoint": checkpoint}
    try:
        inspect.signature(found).bind(**arguments)
    except (TypeError, ValueError) as error:
        call = "Class()" if checkpoint is None else "Class(checkpoint=path)"
        raise PolicyError(f"--policy {spec}: cannot be made with {call}: {error}") from error
    with user_code(f"--policy {spec}: making it failed"):
        policy: object = found(**arguments)
    contract = getattr(policy, "contract", None)
    lacking = [] if isinstance(contract, Contract) else ["contract"]
    lacking += [] if hasattr(policy, "predict") else ["predict"]
    if not isinstance(policy, SingleRatePolicy) or not isinstance(contract, Contract):
        raise PolicyError(
            f"--policy {spec}: a policy needs a member contract (a policy.contract.Contract) and "
            "predict(image, state, action_history, num_diffusion_steps); for the dual-rate mode "
            "also encode_visual(image) and predict_fast(feature, state, action_history, "
            f"num_diffusion_steps). Missing or wrong here: {lacking}"
        )
    if isinstance(policy, DualRatePolicy) and contract.feature_dim == 0:
        raise PolicyError(f"--policy {spec}: its contract needs feature_dim, F of encode_visual")
    return policy
