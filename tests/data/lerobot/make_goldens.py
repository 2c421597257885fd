"""Makes this folder's checkpoints and what LeRobot computes with them, in LeRobot's environment.

    python tests/data/lerobot/make_goldens.py          # from the root, with LeRobot 0.4 to 0.6

A case is one folder: config.json, processors and statistics as LeRobot's own code writes them, the
shapes of model.safetensors, and expected.npz: states, noise, images' seed and LeRobot's actions.
"""

import importlib.metadata
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1]))

from lerobot.configs.types import FeatureType, PolicyFeature  # noqa: E402
from lerobot.policies.act.configuration_act import ACTConfig  # noqa: E402
from lerobot.policies.act.modeling_act import ACTPolicy  # noqa: E402
from lerobot.policies.act.processor_act import make_act_pre_post_processors  # noqa: E402
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig  # noqa: E402
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy  # noqa: E402
from lerobot.policies.diffusion.processor_diffusion import (  # noqa: E402
    make_diffusion_pre_post_processors,
)

from helpers import lerobot_checkpoints as formula  # noqa: E402

SAMPLES = 2
VERSION = importlib.metadata.version("lerobot")
FRONT, DOWN = "observation.images.front", "observation.images.down"
TINY_UNET = {"down_dims": (16, 32), "n_groups": 4, "diffusion_step_embed_dim": 16}
TINY_UNET |= {"spatial_softmax_num_keypoints": 4, "pretrained_backbone_weights": None}
TINY_UNET |= {"noise_scheduler_type": "DDIM", "num_inference_steps": 4}
TINY_ACT = {"dim_model": 32, "n_heads": 4, "dim_feedforward": 48, "n_vae_encoder_layers": 1}
TINY_ACT |= {"n_encoder_layers": 2, "pretrained_backbone_weights": None}
ACT_04 = {"chunk_size": 10, "n_action_steps": 10, "latent_dim": 8} | TINY_ACT

CASES = {
    "0.4.4": {
        "act": (ACTConfig, (64, 96), (FRONT,), 13, ACT_04),
        "act_two_cameras_pre_norm": (
            ACTConfig,
            (48, 64),
            (FRONT, DOWN),
            7,
            ACT_04
            | {"pre_norm": True, "feedforward_activation": "gelu", "n_decoder_layers": 2}
            | {"use_vae": False, "n_action_steps": 1, "temporal_ensemble_coeff": 0.01},
        ),
        "diffusion": (
            DiffusionConfig,
            (64, 96),
            (FRONT,),
            13,
            TINY_UNET | {"horizon": 8, "n_action_steps": 4, "crop_shape": (57, 84)},
        ),
        "diffusion_sample": (
            DiffusionConfig,
            (64, 64),
            (FRONT, DOWN),
            5,
            TINY_UNET
            | {"horizon": 8, "n_action_steps": 4, "prediction_type": "sample", "kernel_size": 3}
            | {"use_film_scale_modulation": False, "beta_schedule": "linear", "n_obs_steps": 1}
            | {"clip_sample_range": 1.5, "num_inference_steps": 7},
        ),
    },
    "0.6.1": {
        "act_quantiles": (ACTConfig, (64, 64), (FRONT,), 13, TINY_ACT | {"chunk_size": 6}),
        "diffusion_separate": (
            DiffusionConfig,
            (70, 101),
            (DOWN, FRONT),
            13,
            TINY_UNET
            | {"resize_shape": (64, 80), "crop_ratio": 0.85, "horizon": 8, "n_action_steps": 6},
        ),
    },
}


def _features(size, cameras, state_dim):
    images = {key: PolicyFeature(FeatureType.VISUAL, (3, *size)) for key in cameras}
    state = {"observation.state": PolicyFeature(FeatureType.STATE, (state_dim,))}
    return images | state, {"action": PolicyFeature(FeatureType.ACTION, (4,))}


def _make(name, kind, size, cameras, state_dim, options):
    inputs, outputs = _features(size, cameras, state_dim)
    if name == "act_quantiles":
        options = options | {"n_action_steps": 6, "normalization_mapping": _quantiles()}
    config = kind(input_features=inputs, output_features=outputs, device="cpu", **options)
    policy = (ACTPolicy if kind is ACTConfig else DiffusionPolicy)(config)
    shapes = {key: list(value.shape) for key, value in policy.state_dict().items()}
    constants = {
        key: value.numpy()
        for key, value in policy.state_dict().items()
        if key.endswith(formula.CONSTANTS)
    }
    policy.load_state_dict(
        {
            key: torch.from_numpy(constants.get(key, formula.weight(key, tuple(shape))))
            for key, shape in shapes.items()
        }
    )
    policy.eval()
    statistics = formula.statistics({key: f.shape for key, f in (inputs | outputs).items()})
    make = make_act_pre_post_processors
    make = make if kind is ACTConfig else make_diffusion_pre_post_processors
    before, after = make(config, dataset_stats=statistics)
    folder = HERE / name
    with tempfile.TemporaryDirectory() as written:
        policy.save_pretrained(written)  # its weights are not kept
        folder.mkdir(exist_ok=True)
        (folder / "config.json").write_bytes((Path(written) / "config.json").read_bytes())
    before.save_pretrained(folder)
    after.save_pretrained(folder)
    (folder / formula.SHAPES_FILE).write_text(json.dumps(shapes, separators=(",", ":")))
    state = formula.drawn("state", (SAMPLES, config.n_obs_steps, state_dim)) * 2
    state[..., -1] = statistics["observation.state"]["min"][-1]  # it is the same in all the data
    expected = _compute(policy, before, after, config, state)
    np.savez_compressed(folder / "expected.npz", **expected, **constants)
    print(name, {key: value.shape for key, value in expected.items()}, expected["actions"].std())


def _quantiles():
    return {"VISUAL": "MEAN_STD", "STATE": "QUANTILES", "ACTION": "QUANTILE10"}


def _compute(policy, before, after, config, state):
    """The whole chunk, from index 0 of LeRobot on, through its processors."""
    steps, cameras = config.n_obs_steps, config.image_features
    size = next(iter(cameras.values())).shape[1:]
    frames = {
        key: formula.images((SAMPLES, steps, 3, *size), seed) for seed, key in enumerate(cameras)
    }
    rows = []
    for sample in range(SAMPLES):
        batches = [
            before(
                {"observation.state": torch.from_numpy(state[sample, step])}
                | {key: torch.from_numpy(frames[key][sample, step]) for key in cameras}
            )
            for step in range(steps)
        ]
        rows.append(after(_chunk(policy, batches, config)))
    actions = torch.cat(rows).numpy()
    return {"state": state, "actions": actions, "lerobot": np.array(VERSION)}


def _chunk(policy, batches, config):
    if isinstance(config, ACTConfig):
        return policy.predict_action_chunk(batches[0])
    keys = ["observation.state", *config.image_features]
    batch = {key: torch.stack([each[key] for each in batches], dim=1) for key in keys}
    batch["observation.images"] = torch.stack([batch[k] for k in config.image_features], dim=-4)
    policy.config.n_action_steps = config.horizon - config.n_obs_steps + 1
    noise = torch.from_numpy(formula.drawn("noise", (1, config.horizon, 4)))
    with torch.no_grad():
        return policy.diffusion.generate_actions(batch, noise=noise)


def main():
    """Make the cases of the LeRobot that is installed here."""
    torch.manual_seed(0)
    for name, case in CASES[VERSION].items():
        _make(name, *case)


if __name__ == "__main__":
    main()
