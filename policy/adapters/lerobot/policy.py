"""Loading of LeRobot policies: the networks, their weights, and notes for the user."""

from functools import partial
from pathlib import Path

from torch import Tensor

from policy.adapters.lerobot.act import Act
from policy.adapters.lerobot.base import LeRobotPolicy
from policy.adapters.lerobot.config import ActConfig
from policy.adapters.lerobot.diffusion import Diffusion
from policy.adapters.lerobot.plan import WEIGHTS_FILE, Plan
from policy.checkpoints.tensors import load_fitting, read_tensors


def load_policy_of(
    plan: Plan, *, seed: int, num_diffusion_steps: int
) -> tuple[LeRobotPolicy, list[str]]:
    """Build a policy, load its weights, draw the initial noise; return notes for the user too."""
    path, config = plan.folder / WEIGHTS_FILE, plan.config
    advice = "Copy both files again, from one folder"
    policy: LeRobotPolicy
    notes = list(plan.notes)
    if isinstance(config, ActConfig):
        policy = load_fitting(path, partial(Act, plan, config), _read(path, Act), advice)
        kind = "ACT"
        if config.temporal_ensemble_coeff is not None:
            notes.append(
                "its temporal ensembling is not computed: the guard smooths from chunk to chunk"
            )
    else:
        build = partial(Diffusion, plan, config)
        policy = load_fitting(path, build, _read(path, Diffusion), advice)
        policy.seed_noise(seed)
        kind = "DiffusionPolicy"
        notes.append(
            f"solved by DDIM in {num_diffusion_steps} steps (--num-diffusion-steps) from noise of "
            f"seed {seed}; its config.json says {config.noise_scheduler_type} in "
            f"{config.num_inference_steps}. More steps come closer to that, and take longer"
        )
    policy.requires_grad_(False)
    millions = sum(parameter.numel() for parameter in policy.parameters()) / 1e6
    return policy, [f"LeRobot's {kind} of {plan.folder}, {millions:.1f} M parameters", *notes]


def _read(path: Path, net: type[LeRobotPolicy]) -> dict[str, Tensor]:
    """Return the weights of LeRobot's file under our names."""
    state = {}
    for name, value in read_tensors(path)[1].items():
        ours = net.own_name(name.removeprefix(net.prefix)) if name.startswith(net.prefix) else name
        if ours is not None:
            state[ours] = value
    return state
