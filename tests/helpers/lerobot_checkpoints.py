"""Checkpoints and inputs of the parity tests of LeRobot policies, by formula.

The files of a ResNet have 45 MB, so the weights are not kept: LeRobot's code and ours get equal
weights, drawn by name. This module is used in both environments and needs only numpy.
"""

import json
import zlib
from pathlib import Path

import numpy as np

SHAPES_FILE = "model_shapes.json"
"""Names, shapes and types of LeRobot's model.safetensors."""
CONSTANTS = ("pos_grid", "vae_encoder_pos_enc")
"""Tensors of a model that are not learned; kept as LeRobot computed them."""


def drawn(name, shape, seed=0):
    """Return standard normal numbers that depend only on the name; numpy guarantees this stream."""
    random = np.random.RandomState(zlib.crc32(f"{seed} {name}".encode()))
    return random.standard_normal(shape).astype(np.float32)


def weight(name, shape):
    """Return a value for a parameter that roughly preserves the size of signals."""
    if name.endswith("num_batches_tracked"):
        return np.array(7, np.int64)
    values = drawn(name, shape)
    if name.endswith("running_var"):
        return np.abs(values) + np.float32(0.5)
    if len(shape) < 2:
        centre = 1.0 if name.endswith("weight") else 0.0
        return np.float32(centre) + np.float32(0.2) * values
    fan_in = int(np.prod(shape[1:]))
    return values * np.float32(1.4 / np.sqrt(fan_in))


def weights(folder: Path, constants):
    """Return all tensors of a kept checkpoint."""
    shapes = json.loads((folder / SHAPES_FILE).read_text())
    return {
        name: constants[name] if name in constants else weight(name, tuple(shape))
        for name, shape in shapes.items()
    }


def statistics(features):
    """Return statistics of each feature {key: shape}: neither 0 nor 1, and one constant."""
    found = {}
    for key, shape in features.items():
        one = (3, 1, 1) if len(shape) == 3 else tuple(shape)
        size = 0.2 if len(shape) == 3 else 2.0
        mean = drawn(f"mean {key}", one) * np.float32(size) / 2 + np.float32(size)
        std = np.abs(drawn(f"std {key}", one)) * np.float32(size) + np.float32(0.05)
        found[key] = {"mean": mean, "std": std, "min": mean - 2 * std, "max": mean + 2 * std}
        found[key] |= {"q01": mean - std, "q99": mean + std, "q10": mean - std, "q90": mean + std}
        if one == tuple(shape):
            found[key]["max"][-1] = found[key]["min"][-1]
    return found


def images(shape, seed):
    """Return smooth images in [0, 1], float32, of the shape [..., 3, H, W]."""
    coarse = drawn("image", (*shape[:-2], 4, 4), seed)
    rows, columns = (np.arange(size) * 4 // size for size in shape[-2:])
    smooth = coarse[..., rows, :][..., columns] + np.float32(0.2) * drawn("grain", shape, seed)
    return np.float32(1) / (np.float32(1) + np.exp(-smooth))
