"""LeRobot's own code, timed and asked for its actions; runs in LeRobot's environment.

    python benchmarks/lerobot_peer.py make DIR KIND          # a checkpoint with random weights
    python benchmarks/lerobot_peer.py time DIR INPUTS STEPS  # a line of JSON

It imports nothing of this project. KIND is one of ``KINDS``. INPUTS is an .npz with state
[T, S], images [T, N, 3, H, W] in the order of config.json, and noise [1, horizon, 4].
"""

import dataclasses
import json
import statistics
import sys
import time
from collections.abc import Callable
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


def make(folder: Path, kind: str, pixels: int = 96) -> None:
    """Write a policy with seeded random weights, as LeRobot saves one."""
    torch.manual_seed(0)
    config_class, options = KINDS[kind]
    inputs = {
        IMAGE: PolicyFeature(FeatureType.VISUAL, (3, pixels, pixels)),
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


def run(folder: Path, inputs: Path, steps: int) -> dict[str, Any]:
    """Best and median milliseconds of a whole chunk, and the chunk, from now on."""
    torch.set_num_threads(1)
    config = _config(folder, steps)
    policy = _class_of(config).from_pretrained(folder, config=config)
    before, after = make_pre_post_processors(config, pretrained_path=str(folder))
    arrays = dict(np.load(inputs))
    rows = [
        before(
            {STATE: torch.from_numpy(state)}
            | {key: torch.from_numpy(images[at]) for at, key in enumerate(config.image_features)}
        )
        for state, images in zip(arrays["state"], arrays["images"], strict=True)
    ]
    predict = _prediction(policy, config, rows, torch.from_numpy(arrays["noise"]))
    with torch.inference_mode():
        chunk = after(predict())
        return {"ms": _time(predict), "chunk": chunk[0].tolist()}


def _config(folder: Path, steps: int) -> Any:
    config = PreTrainedConfig.from_pretrained(folder)
    if isinstance(config, DiffusionConfig):
        whole = config.horizon - config.n_obs_steps + 1
        change = {"noise_scheduler_type": "DDIM", "num_inference_steps": steps}
        config = dataclasses.replace(config, n_action_steps=whole, **change)
    config.device = "cpu"
    return config


def _class_of(config: Any) -> Any:
    return ACTPolicy if isinstance(config, ACTConfig) else DiffusionPolicy


def _prediction(
    policy: Any, config: Any, rows: list[dict[str, Any]], noise: torch.Tensor
) -> Callable[[], Any]:
    if isinstance(config, ACTConfig):
        return lambda: policy.predict_action_chunk(rows[0])
    keys = [STATE, *config.image_features]
    batch = {key: torch.stack([row[key] for row in rows], dim=1) for key in keys}
    batch["observation.images"] = torch.stack([batch[key] for key in config.image_features], -4)
    return lambda: policy.diffusion.generate_actions(batch, noise=noise)


def _time(function: Callable[[], Any]) -> list[float]:
    times: list[float] = []
    end = time.perf_counter() + SECONDS  # noqa: TID251 - a program of its own
    while len(times) < 5 or time.perf_counter() < end:  # noqa: TID251
        start = time.perf_counter()  # noqa: TID251
        function()
        times.append(1e3 * (time.perf_counter() - start))  # noqa: TID251
    return [min(times), statistics.median(times)]


if __name__ == "__main__":
    if sys.argv[1] == "make":
        make(Path(sys.argv[2]), sys.argv[3], *map(int, sys.argv[4:]))
    else:
        found = run(Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4]))
        print(json.dumps(found))  # noqa: T201 - its result
