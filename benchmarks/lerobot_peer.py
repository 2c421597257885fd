"""Time LeRobot's code in LeRobot's environment.

    python benchmarks/lerobot_peer.py make DIR KIND   # a checkpoint with random weights
    python benchmarks/lerobot_peer.py time DIR STEPS  # a line of JSON: ms of a chunk, p50 and p99

It imports nothing of this project. KIND is one of ``KINDS``.
"""

import dataclasses
import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.factory import make_pre_post_processors

_DIFFUSION = {"horizon": 16, "n_action_steps": 8, "use_separate_rgb_encoder_per_camera": False}
_PLAIN = {"pretrained_backbone_weights": None, "use_group_norm": True} | _DIFFUSION
KINDS: dict[str, tuple[Any, dict[str, Any]]] = {
    "act": (ACTConfig, {"pretrained_backbone_weights": None}),
    "diffusion": (DiffusionConfig, _PLAIN),
    "diffusion-20m": (DiffusionConfig, _PLAIN | {"down_dims": (96, 192, 384)}),
}
IMAGE, STATE, ACTION = "observation.images.front", "observation.state", "action"
SECONDS = 4.0
PIXELS = 96


def make(folder: Path, kind: str) -> None:
    """Write a policy with seeded random weights in LeRobot's format."""
    torch.manual_seed(0)
    config_class, options = KINDS[kind]
    inputs = {
        IMAGE: PolicyFeature(FeatureType.VISUAL, (3, PIXELS, PIXELS)),
        STATE: PolicyFeature(FeatureType.STATE, (13,)),
    }
    outputs = {ACTION: PolicyFeature(FeatureType.ACTION, (4,))}
    config = config_class(input_features=inputs, output_features=outputs, device="cpu", **options)
    policy = _class_of(config)(config)
    ones = {key: torch.ones(3, 1, 1) if key == IMAGE else torch.ones(feature.shape)
            for key, feature in (inputs | outputs).items()}  # fmt: skip
    scales = {"mean": 0.5, "std": 0.25, "min": -1.0, "max": 1.0}
    stats = {key: {name: one * by for name, by in scales.items()} for key, one in ones.items()}
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    for part in (policy, before, after):
        part.save_pretrained(folder)
    (folder / "mavbridge.toml").write_text("[contract]\nchunk_dt_s = 0.1\n")


def time_chunks(folder: Path, steps: int) -> list[float]:
    """Return the median and 99th percentile of a chunk's time [ms], on a still scene."""
    torch.set_num_threads(1)
    config = PreTrainedConfig.from_pretrained(folder)
    if isinstance(config, DiffusionConfig):
        change = {"noise_scheduler_type": "DDIM", "num_inference_steps": steps}
        config = dataclasses.replace(config, **change)
    config.device = "cpu"
    policy = _class_of(config).from_pretrained(folder, config=config)
    before, _ = make_pre_post_processors(config, pretrained_path=str(folder))
    scene = {STATE: torch.zeros(config.input_features[STATE].shape)}
    for key in config.image_features:
        scene[key] = torch.full(config.input_features[key].shape, 0.5)
    observation = before(scene)
    predict: Callable[[], Any] = partial(policy.predict_action_chunk, observation)
    if isinstance(config, DiffusionConfig):
        keys = [STATE, *config.image_features]
        batch = {key: torch.stack([observation[key]] * config.n_obs_steps, dim=1) for key in keys}
        images = [batch[key] for key in config.image_features]
        batch["observation.images"] = torch.stack(images, dim=-4)
        predict = partial(policy.diffusion.generate_actions, batch)
    times: list[float] = []
    with torch.inference_mode():
        predict()
        end = time.perf_counter() + SECONDS  # noqa: TID251 - a program of its own
        while len(times) < 5 or time.perf_counter() < end:  # noqa: TID251
            start = time.perf_counter()  # noqa: TID251
            predict()
            times.append(1e3 * (time.perf_counter() - start))  # noqa: TID251
    return [float(np.percentile(times, percent)) for percent in (50, 99)]


def _class_of(config: Any) -> Any:
    return ACTPolicy if isinstance(config, ACTConfig) else DiffusionPolicy


if __name__ == "__main__":
    if sys.argv[1] == "make":
        make(Path(sys.argv[2]), sys.argv[3])
    else:
        print(json.dumps(time_chunks(Path(sys.argv[2]), int(sys.argv[3]))))  # noqa: T201
