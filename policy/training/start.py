"""The weights that a training run starts from, and what a checkpoint says of its training."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from policy.checkpoints.policy_file import BuiltinPolicy, build_policy, load_checkpoint
from policy.contract import STATE_NAMES
from policy.data.episodes import Episode, Nanoseconds
from policy.errors import PolicyError
from policy.nets.backbones import load_imagenet_state
from policy.training.plan import TrainSettings
from policy.training.trainee import Trainee

AGE_BIN_MS = 5


def starting_trainee(settings: TrainSettings) -> Trainee:
    """The policy to start from, and a new gate head; the process's random stream stays as it was.

    Raises:
        PolicyError: weights that do not fit.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        return Trainee(_starting_policy(settings))


def _starting_policy(settings: TrainSettings) -> BuiltinPolicy:
    """Random weights, an encoder's weights under them, or a checkpoint."""
    if settings.start_from is not None:
        return _checkpoint(settings, settings.start_from)
    policy = build_policy(settings.policy)
    if settings.backbone_weights is not None:
        state = _state_dict(settings.backbone_weights)
        load_imagenet_state(policy.backbone, state)
    return policy


def _checkpoint(settings: TrainSettings, path: Path) -> BuiltinPolicy:
    policy = load_checkpoint(path, fallback=settings.policy)
    wanted = settings.policy
    is_same = replace(policy.config, contract=wanted.contract) == wanted
    theirs, ours = (
        policy.contract,
        replace(wanted.contract, feature_dim=policy.contract.feature_dim),
    )
    if not is_same or theirs != ours:
        mine, its = (
            {**asdict(config), "contract": None, **asdict(config.contract)}
            for config in (replace(wanted, contract=ours), policy.config)
        )
        other = [f"{name} {its[name]!r}" for name in its if mine.get(name) != its[name]]
        raise PolicyError(
            f"--start-from {path} holds another policy: {', '.join(other)}; ask for the same one"
        )
    return policy.train()


def _state_dict(path: Path) -> dict[str, torch.Tensor]:
    try:
        loaded: object = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise PolicyError(
            f"--backbone-weights {path}: not a readable torch file: {error}"
        ) from error
    if not isinstance(loaded, dict):
        raise PolicyError(f"--backbone-weights {path}: no state dict in it")
    return {str(name): value for name, value in loaded.items() if isinstance(value, torch.Tensor)}


def training_card(
    settings: TrainSettings,
    episodes: Sequence[Episode],
    ages_ns: Nanoseconds,
    *,
    steps: int,
    validation: Mapping[str, float] | None,
) -> str:
    """What a checkpoint says of its training, as JSON."""
    state = np.concatenate([episode.state for episode in episodes])
    target = np.concatenate([episode.target for episode in episodes])
    ages_ms = ages_ns / 1e6
    edges = np.arange(0, ages_ms.max() + 2 * AGE_BIN_MS, AGE_BIN_MS)
    card = {
        "flights": len(episodes),
        "images": sum(len(episode.captured_ns) for episode in episodes),
        "ticks": len(state),
        "steps": steps,
        "batch_size": settings.batch_size,
        "seed": settings.seed,
        "mirror": settings.mirror,
        "world_yaw": "drawn evenly",
        "gate_weight": settings.gate_weight,
        "feature_age_ms": {
            "measured_in": "the flights" if settings.ages_ns is None else "--ages",
            "bin_ms": AGE_BIN_MS,
            "counts_from_0": np.histogram(ages_ms, edges)[0].tolist(),
        },
        "state_mean": _by_name(np.nanmean(state, axis=0)),
        "state_std": _by_name(np.nanstd(state, axis=0)),
        "stick_mean": target.mean(axis=0).round(4).tolist(),
        "stick_std": target.std(axis=0).round(4).tolist(),
        "validation": validation,
    }
    return json.dumps(card, sort_keys=True)


def _by_name(values: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> dict[str, float]:
    return {name: round(float(v), 4) for name, v in zip(STATE_NAMES, values, strict=True)}
