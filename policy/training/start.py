"""The weights that a policy's training starts from, and the card that its checkpoint carries."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch

from policy.checkpoints.policy_file import BuiltinPolicy, build_policy, load_checkpoint
from policy.contract import STATE_NAMES
from policy.data.flight_data import FlightData, Nanoseconds
from policy.errors import PolicyError
from policy.nets.backbones import load_imagenet_state
from policy.nets.resnet_unet import ResnetUnetConfig
from policy.nets.toge import TogeConfig
from policy.training.settings import TrainSettings
from policy.training.trainee import Trainee

Network: TypeAlias = TogeConfig | ResnetUnetConfig
AGE_BIN_MS = 5


def starting_trainee(network: Network, settings: TrainSettings) -> Trainee:
    """The policy to start from and a new gate head; torch's global random state is kept.

    Raises:
        PolicyError: weights that do not fit.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        if settings.start_from is not None:
            return Trainee(_checkpoint(network, settings.start_from))
        policy = build_policy(network)
        if settings.backbone_weights is not None:
            load_imagenet_state(policy.backbone, _state_dict(settings.backbone_weights))
        return Trainee(policy)


def _checkpoint(network: Network, path: Path) -> BuiltinPolicy:
    policy = load_checkpoint(path, fallback=network)
    wanted = replace(network.contract, feature_dim=policy.contract.feature_dim)
    asked, held = (
        {**asdict(config), "contract": None, **asdict(contract)}
        for config, contract in ((network, wanted), (policy.config, policy.contract))
    )
    other = [f"{name} {value!r}" for name, value in held.items() if asked.get(name) != value]
    if other or type(policy.config) is not type(network):
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
    flights: Sequence[FlightData],
    ages_ns: Nanoseconds,
    *,
    steps: int,
    validation: Mapping[str, float] | None,
) -> str:
    """How a checkpoint was trained, as JSON."""
    state = np.concatenate([flight.state for flight in flights])
    target = np.concatenate([flight.target for flight in flights])
    ages_ms = ages_ns / 1e6
    edges = np.arange(0, ages_ms.max() + 2 * AGE_BIN_MS, AGE_BIN_MS)
    card = {
        "flights": len(flights),
        "images": sum(len(flight.captured_ns) for flight in flights),
        "ticks": len(state),
        "steps": steps,
        "batch_size": settings.batch_size,
        "seed": settings.seed,
        "mirror": settings.mirror,
        "world_yaw": "drawn evenly",
        "gate_weight": settings.gate_weight,
        "feature_age_ms": {
            "measured_in": "the flights" if settings.ages is None else "--ages",
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
