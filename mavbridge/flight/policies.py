"""Load the policy that the flags name."""

import random
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from mavbridge.camera.open import NO_CAMERA, require_present
from mavbridge.config.flight import FlyConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_S, Clock, MonotonicClock
from mavbridge.core.errors import CameraError, UserError
from policy.adapters.description import DESCRIPTION
from policy.files import CONTRACT_FILE, user_path
from policy.loading.builtin import shipped_weights
from policy.loading.load import load_policy
from policy.loading.request import LoadedPolicy, PolicyRequest
from policy.nets.names import BUILTIN_KINDS

NO_IMAGE_ADVICE = "uses no image: give --camera none"
STATELESS = (*BUILTIN_KINDS, "onnx")
FILE_KINDS = ("lerobot", "onnx", "torchscript")
POLICY_SUFFIXES = (".safetensors", ".onnx", ".data", ".onnx_data", ".pt", ".json", ".toml")
"""Suffixes of the files in a policy's folder that belong to it."""
BESIDE = (CONTRACT_FILE, DESCRIPTION)
"""Files that are read beside a policy of one file, with its external weights: FILE.data by torch,
FILE_data by Optimum."""


def load_configured_policy(
    wanted: PolicyConfig, clock: Clock, *, starts_in_air: bool = False
) -> LoadedPolicy:
    """Load the policy that the flags name.

    A scripted policy follows ``clock``, and climbs first unless ``starts_in_air``.

    Raises:
        PolicyError: it cannot be loaded.
    """
    request = replace(policy_request(wanted), starts_in_air=starts_in_air)
    return load_policy(request, now_s=lambda: clock.now_ns() / NS_PER_S)


def policy_request(wanted: PolicyConfig) -> PolicyRequest:
    """Return the request for the policy that the flags name."""
    return PolicyRequest(
        spec=wanted.policy,
        checkpoint=wanted.checkpoint,
        contract_file=wanted.contract,
        allow_untrained=wanted.allow_untrained,
        engine=wanted.engine,
        device=wanted.device,
        dual_rate=wanted.dual_rate is not False,
        num_diffusion_steps=wanted.steps,
        by_rates=wanted.by_rates,
        image_size=wanted.image_size,
        seed=wanted.seed,
    )


def policy_files(wanted: PolicyConfig) -> list[Path]:
    """Return the files that define the policy: weights, contract, graphs, user code."""
    files = [path for path in (wanted.checkpoint, wanted.contract) if path is not None]
    shipped = shipped_weights(wanted.policy)
    if shipped is not None and wanted.checkpoint is None and not wanted.allow_untrained:
        files.append(shipped)
    named = wanted.policy.partition(":")[2] if wanted.kind in FILE_KINDS else wanted.kind
    path = user_path(named)
    if path.is_dir() and wanted.kind in FILE_KINDS:
        files += sorted(each for each in path.iterdir() if each.suffix in POLICY_SUFFIXES)
    elif path.is_file():
        files.append(path)
        weights = (f"{path.name}.data", f"{path.name}_data")
        beside = (*weights, *BESIDE) if wanted.kind in FILE_KINDS else ()
        files += filter(Path.is_file, map(path.with_name, beside))
    return files


def is_scripted(policy: PolicyConfig) -> bool:
    """Return True if the policy is scripted and uses no image."""
    return policy.kind == "scripted"


def looks_at_images(config: FlyConfig) -> bool:
    """Return True if a frozen or black image is a fault for this policy.

    A user's policy may fly without a camera; our own networks need images.
    """
    is_blind = _has_no_camera(config) and config.policy.kind not in BUILTIN_KINDS
    return not is_blind and not is_scripted(config.policy)


def require_images(config: FlyConfig) -> None:
    """Raise UserError if a network of ours is flown without a camera."""
    if config.policy.kind in BUILTIN_KINDS and _has_no_camera(config):
        raise UserError(
            f"--camera none: {config.policy.policy} needs images, so name a camera; only "
            "scripted policies, and policies of yours that use no image, fly without one"
        )


def require_cameras(config: FlyConfig) -> None:
    """Raise CameraError if a local camera is not plugged in."""
    for source in config.camera.sources:
        try:
            require_present(source)
        except CameraError as error:
            if looks_at_images(config):
                raise
            raise CameraError(f"{error}; {config.policy.policy} {NO_IMAGE_ADVICE}") from error


def _has_no_camera(config: FlyConfig) -> bool:
    return set(config.camera.sources) == {NO_CAMERA}


def is_stateless(policy: PolicyConfig) -> bool:
    """Return True if the policy keeps no state between flights, as networks that we load."""
    return policy.kind in STATELESS


@lru_cache(maxsize=1)
def _loaded_once(policy: PolicyConfig) -> LoadedPolicy:
    return load_configured_policy(policy, MonotonicClock())


def load_for_episodes(policy: PolicyConfig, clock: Clock, seed: int) -> LoadedPolicy:
    """Load a policy for one of many flights. Stateless policies are loaded once per process.

    Others may draw random numbers of the whole process, which start at ``seed``: a flight depends
    on no flight before it.
    """
    if is_stateless(policy):
        return _loaded_once(policy)
    _seed_globals(policy, seed)
    loaded = load_configured_policy(policy, clock)
    _seed_globals(policy, seed)  # only the first import of a user's file runs code of its own
    return loaded


def _seed_globals(policy: PolicyConfig, seed: int) -> None:
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - the generator that a user's code may draw from
    if not is_scripted(policy):
        import torch

        torch.manual_seed(seed)
