"""Parity check: do two ways to compute a policy agree, from image to stick?"""

from dataclasses import dataclass

import numpy as np

from policy.contract import (
    QUATERNION,
    SINCE_EXPOSURE_DIM,
    STATE_DIM,
    CameraImage,
    Contract,
    FloatArray,
)
from policy.preprocess import SINCE_EXPOSURE_SCALE

MIN_COSINE = 0.999
"""Minimum cosine between the two chunks of a sample, taken as vectors."""
MAX_STICK_ERROR = 0.01
"""Largest difference in full deflections: 5 us of PWM on the usual 1000..2000 us."""
SAMPLES = 4


@dataclass(frozen=True, kw_only=True)
class ParitySamples:
    """Synthetic samples that exercise every input of a policy; equal for equal contracts.

    They are rgb [samples, H, W, 3] or depth in its place, state [samples, state_dim] and history
    [samples, K, 4]. Several cameras or observations add axes as in ``Contract.image_shape``.
    """

    rgb: CameraImage
    state: FloatArray
    history: FloatArray


def make_parity_samples(contract: Contract) -> ParitySamples:
    """Return smooth random images, with states and sticks of a fast flight."""
    random = np.random.default_rng(0)
    height, width = contract.image_height, contract.image_width
    images = (SAMPLES, *contract.image_shape[:-3])
    coarse = random.integers(0, 256, (*images, 8, 8, 3), dtype=np.uint8)
    rows, columns = np.arange(height) * 8 // height, np.arange(width) * 8 // width
    fine = random.integers(0, 32, (*images, height, width, 3), dtype=np.uint8)
    rgb = coarse[..., rows, :, :][..., columns, :] // 8 * 7 + fine
    states = (SAMPLES, *contract.state_shape[:-1])
    parts = [random.normal(0.0, 2.0, (*states, STATE_DIM))]
    parts[0][..., QUATERNION] /= np.linalg.norm(parts[0][..., QUATERNION], axis=-1, keepdims=True)
    history = random.uniform(-1.0, 1.0, (SAMPLES, *contract.history_shape))
    if contract.since_exposure:
        since = random.uniform(-1.0, 1.0, (*states, SINCE_EXPOSURE_DIM)) * SINCE_EXPOSURE_SCALE
        since[..., 0] = np.abs(since[..., 0])
        parts.append(since)
    extras = contract.state_dim - sum(part.shape[-1] for part in parts)
    parts.append(random.normal(0.0, 5.0, (*states, extras)))  # metres
    pixels: CameraImage = rgb.astype(np.uint8)
    return ParitySamples(
        rgb=64 * pixels[..., 0].astype(np.uint16) if contract.is_depth else pixels,
        state=np.concatenate(parts, axis=-1).astype(np.float32),
        history=history.astype(np.float32),
    )


def parity_failure(expected: FloatArray, chunks: FloatArray) -> str | None:
    """Return why two arrays of chunks [samples, horizon, 4] disagree, or None."""
    if expected.shape != chunks.shape:
        return f"chunks of shape {list(chunks.shape)} instead of {list(expected.shape)}"
    if not np.isfinite(chunks).all():
        return "NaN or infinity in a chunk"
    furthest = float(np.abs(expected - chunks).max())
    cosine = min(_cosine(a, b) for a, b in zip(expected, chunks, strict=True))
    if furthest <= MAX_STICK_ERROR and cosine >= MIN_COSINE:
        return None
    return (
        f"a stick is off by {furthest:.4f} (at most {MAX_STICK_ERROR}), the cosine is "
        f"{cosine:.5f} (at least {MIN_COSINE})"
    )


def _cosine(a: FloatArray, b: FloatArray) -> float:
    lengths = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float((a * b).sum()) / lengths if lengths > 0 else float(np.array_equal(a, b))
