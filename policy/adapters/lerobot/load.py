"""The weights of a LeRobot policy, into the networks that its config.json describes."""

from pathlib import Path

import torch
from torch import Tensor

from policy.adapters.lerobot.config import ActConfig
from policy.adapters.lerobot.plan import Plan
from policy.adapters.lerobot.policy import LeRobotDiffusion, LeRobotPolicy, build_policy_of
from policy.adapters.lerobot.statistics import WEIGHTS_FILE
from policy.errors import CheckpointError
from policy.files import open_safetensors

_STATISTICS = ("normalize_inputs.", "normalize_targets.", "unnormalize_outputs.")
"""Prefixes of the statistics in checkpoints before 0.4, which are read apart."""
_COUNTS = "num_batches_tracked"


def load_policy_of(
    plan: Plan, *, seed: int, num_diffusion_steps: int
) -> tuple[LeRobotPolicy, list[str]]:
    """Build a policy and load its weights; with notes for the user.

    ``seed`` is that of a flight's initial noise.
    """
    policy = build_policy_of(plan)
    policy.net.load_state_dict(_read(plan.folder / WEIGHTS_FILE, policy))
    policy.eval().requires_grad_(False)
    if isinstance(policy, LeRobotDiffusion):
        policy.net.seed_noise(seed)
    return policy, [*plan.notes, *_notes(plan, policy, seed, num_diffusion_steps)]


def _read(path: Path, policy: LeRobotPolicy) -> dict[str, Tensor]:
    net, wanted = policy.net, policy.net.state_dict()
    with open_safetensors(path, "pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    state = {name: value for name, value in wanted.items() if name.endswith(_COUNTS)}
    problems, seen = [], set(state)
    for name, value in tensors.items():
        if name.startswith(_STATISTICS):
            continue
        own = net.own_name(name.removeprefix(net.prefix)) if name.startswith(net.prefix) else name
        if own is None:
            continue
        seen.add(own)
        if own not in wanted:
            problems.append(f"unexpected {name!r}")
        elif value.shape != wanted[own].shape:
            problems.append(f"{name!r} is {list(value.shape)}, not {list(wanted[own].shape)}")
        elif not torch.isfinite(value).all():
            problems.append(f"{name!r} holds NaN or infinity")
        else:
            state[own] = value.to(wanted[own].dtype)
    problems += [f"missing {name!r}" for name in wanted if name not in seen]
    if problems:
        raise CheckpointError(
            f"{path}: does not fit the policy of its config.json in {len(problems)} places: "
            f"{'; '.join(problems[:4])}. Copy both files again, from one folder"
        )
    return state


def _notes(plan: Plan, policy: LeRobotPolicy, seed: int, num_diffusion_steps: int) -> list[str]:
    config = plan.config
    millions = sum(parameter.numel() for parameter in policy.parameters()) / 1e6
    kind = "ACT" if isinstance(config, ActConfig) else "DiffusionPolicy"
    notes = [f"LeRobot's {kind} of {plan.folder}, {millions:.1f} M parameters"]
    if isinstance(config, ActConfig):
        if config.temporal_ensemble_coeff is not None:
            notes.append(
                "its temporal ensembling is not computed: the guard smooths from chunk to chunk"
            )
        return notes
    notes.append(
        f"solved by DDIM in {num_diffusion_steps} steps (--num-diffusion-steps) from noise of seed "
        f"{seed}; its config.json says {config.noise_scheduler_type} in "
        f"{config.num_inference_steps}. More steps come closer to that, and take longer"
    )
    return notes
