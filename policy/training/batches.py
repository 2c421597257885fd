"""Batches of training samples: a pure function of the seed and the step, prepared ahead.

For the stages that learn from features or latents, images are encoded once and stored.
"""

import math
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Self, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from policy.contract import Contract, FloatArray
from policy.data.flight_data import ImageArray
from policy.data.frames import shifted
from policy.data.interpolation import Indices
from policy.data.samples import Timeline, TrainingSamples
from policy.training.settings import TrainSettings

SHARE = 0.25
"""Share of the images that each of the four disturbances applies to, independently."""
FIELD_CELLS = 4
"""Most cells of a field along a side; a field of one cell is uniform."""
LIGHT = (0.12, 1.3)
"""Range of the factor on the brightness."""
MOST_VEIL = 0.9
"""Largest amount of white light that a veil adds."""
MOST_COLOUR = 1.5
"""Largest factor on the distance of colours from grey."""
MOST_COVERS = 3
COVER_SIDE = (0.08, 0.4)
"""Range of a cover's side, as a share of the image's."""
SHIFT = 0.015
"""Largest shift of an image, as a share of its side: about a degree of camera mount error."""
BRIGHTNESS, CONTRAST, COLOUR, NOISE = 0.15, 0.25, 0.08, 0.03
"""Half-ranges of the image augmentations, as shares of full scale; NOISE is the largest sigma."""
AHEAD = 3
"""Batches to prepare while the network computes."""
VALIDATION_KEY = 2**31
"""Random key of validation samples, in place of a step; no run has this many steps."""
T = TypeVar("T")
ENCODE_BATCH = 64


def disturb(images: ImageArray, random: np.random.Generator) -> None:
    """Disturb some of the images [B, height, width, 3] uint8 in place, each at random."""
    chances = random.random((len(images), 4)) < SHARE
    for image, (is_recoloured, is_lit, is_veiled, is_covered) in zip(images, chances, strict=True):
        height, width, _ = image.shape
        if is_recoloured:
            turn_rad, factor = random.uniform(0.0, math.tau), random.uniform(0.0, MOST_COLOUR)
            cv2.transform(image, colour_matrix(turn_rad, factor), dst=image)
        if is_lit:
            low, high = map(math.log, LIGHT)
            light = np.exp(_field(random, (height, width), low, high))
            cv2.multiply(image, cv2.merge([light] * 3), dst=image, dtype=cv2.CV_8U)
        if is_veiled:
            veil = _field(random, (height, width), 0.0, 1.0) ** 2
            veil *= 255 * random.uniform(0.0, MOST_VEIL)
            cv2.add(image, cv2.merge([veil] * 3), dst=image, dtype=cv2.CV_8U)
        if is_covered:
            for _ in range(random.integers(1, MOST_COVERS + 1)):
                _cover(image, random)


def colour_matrix(turn_rad: float, factor: float) -> NDArray[np.float64]:
    """Return the matrix [3, 3] that turns colours about grey and scales their distance from it."""
    turn = np.array([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]]) / math.sqrt(3)
    grey: NDArray[np.float64] = np.full((3, 3), 1 / 3)
    return grey + factor * (math.cos(turn_rad) * (np.eye(3) - grey) + math.sin(turn_rad) * turn)


def _field(
    random: np.random.Generator, shape: tuple[int, int], low: float, high: float
) -> NDArray[np.float32]:
    """Return a smooth random field [height, width] within low .. high."""
    cells = random.integers(1, FIELD_CELLS + 1, size=2)
    coarse = random.uniform(low, high, cells).astype(np.float32)
    smooth = cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(smooth, dtype=np.float32)


def _cover(image: ImageArray, random: np.random.Generator) -> None:
    """Paint one rectangle of one colour; it may extend beyond the image's edge."""
    size = np.array(image.shape[:2])
    half = (random.uniform(*COVER_SIDE, 2) / 2 * size).astype(int)
    middle = random.integers(size)
    top, left = np.maximum(middle - half, 0)
    bottom, right = middle + half + 1
    image[top:bottom, left:right] = random.integers(0, 256, 3)


@dataclass(frozen=True)
class TensorBatch:
    """Batch: a dataclass of tensors; one may be None."""

    def to(self, device: torch.device) -> Self:
        """Copy to a device."""
        given = {name: value for name, value in vars(self).items() if value is not None}
        return replace(self, **{n: v.to(device, non_blocking=True) for n, v in given.items()})


@dataclass(frozen=True, kw_only=True)
class StepLoss:
    """Losses of one batch."""

    total: Tensor
    """Loss to minimise."""
    metrics: Mapping[str, Tensor]
    """Reported losses by name; includes ``loss``."""


@dataclass(frozen=True, kw_only=True)
class Batch(TensorBatch):
    """``B`` images and R times as many samples, ``S``, of a policy; each image serves R samples.

    The samples are state [S, state_dim], history [S, K, 4], chunk and noise [S, horizon, 4], known
    [S, horizon] bool, and timestep [S] int64.
    """

    images: Tensor | None
    """[B, height, width, 3] uint8; None if ``features`` are given."""
    look: Tensor
    """[B, 5]: contrast, brightness, gain of red and of blue, sigma of noise; see ``normalised``."""
    grain: Tensor | None
    """[3, height, width] noise of sigma 1; None if the look is neutral."""
    features: Tensor | None
    """[B, D] outputs of the backbone."""
    state: Tensor
    history: Tensor
    chunk: Tensor
    known: Tensor
    gate: Tensor
    """[B, 7], NaN if unknown."""
    noise: Tensor
    timestep: Tensor


class FeatureStore:
    """Features or latents of some images on disk, plain and perhaps mirrored."""

    def __init__(self, rows: NDArray[np.float16], frames: Indices) -> None:
        """Take rows [1 or 2, N, D] of ascending ``frames`` [N]: plain, then mirrored."""
        self._rows = rows
        self.frames = frames

    def read(self, frames: Indices, is_mirrored: NDArray[np.bool_]) -> FloatArray:
        """[B, D]"""
        rows = self._rows[is_mirrored.astype(int), np.searchsorted(self.frames, frames)]
        return np.asarray(rows, dtype=np.float32)


def next_of(among: Indices, step: int, count: int, seed: int) -> Indices:
    """Return the ``count`` items due in ``step``; each pass over all has a new random order."""
    total = len(among)
    at = np.arange(step * count, (step + 1) * count)
    parts = [
        _order(seed, int(epoch), total)[at[at // total == epoch] % total]
        for epoch in np.unique(at // total)
    ]
    chosen: Indices = among[np.concatenate(parts)]
    return chosen


@lru_cache(maxsize=4)
def _order(seed: int, epoch: int, total: int) -> Indices:
    return np.random.default_rng([seed, 2, epoch]).permutation(total)


class Batches:
    """Creates batches of one set of flights."""

    def __init__(
        self,
        timeline: Timeline,
        frames: Indices,
        images: ImageArray,
        *,
        timesteps: int,
        settings: TrainSettings,
    ) -> None:
        """Take some ``frames`` of the timeline, and the ``images`` [N, H, W, 3] of all flights."""
        self._timeline, self._images = timeline, images
        self._timesteps, self._settings, self._seed = timesteps, settings, settings.seed
        self.frames = frames

    def with_images(self, step: int) -> Batch:
        """Return a batch to train encoder and head."""
        count = self._settings.batch_size
        random = np.random.default_rng([self._seed, step])
        frames = next_of(self.frames, step, count, self._seed)
        is_mirrored = self._mirrored(random, count)
        most = round(SHIFT * self._settings.image_size)
        shifts = random.integers(-most, most + 1, size=(count, 2))
        images = shifted(self._images[frames], shifts)
        images[is_mirrored] = images[is_mirrored, :, ::-1]
        if self._settings.disturb:
            disturb(images, random)
        low = np.array([-CONTRAST, -BRIGHTNESS, -COLOUR, -COLOUR, 0.0])
        high = np.array([CONTRAST, BRIGHTNESS, COLOUR, COLOUR, NOISE])
        look = random.uniform(low, high, (count, 5)).astype(np.float32)
        samples = self._samples(random, frames, is_mirrored, self._settings.repeats)
        return self._batch(random, samples, len(frames), images=images, look=look)

    def with_features(self, step: int, features: FeatureStore) -> Batch:
        """Return a batch to train the head alone."""
        count = self._settings.head_batch_size
        random = np.random.default_rng([self._seed, step])
        frames = next_of(features.frames, step, count, self._seed)
        is_mirrored = self._mirrored(random, count)
        rows = features.read(frames, is_mirrored)
        samples = self._samples(random, frames, is_mirrored, 1)
        return self._batch(random, samples, len(frames), features=rows)

    def validation(self, frames: Indices, samples: int) -> Iterator[Batch]:
        """Return the same samples at each call, not augmented, with inputs hidden as in training.

        Otherwise, validation by body rates would favour weights that copy.
        """
        count = self._settings.batch_size
        chosen = frames[np.linspace(0, len(frames) - 1, min(samples, len(frames))).astype(int)]
        for start in range(0, len(chosen), count):
            random = np.random.default_rng([self._seed, VALIDATION_KEY, start])
            part = chosen[start : start + count]
            ticks = self._timeline.draw_ticks(part, random)
            plain = self._timeline.samples(part, ticks, random if self._timeline.by_rates else None)
            yield self._batch(random, plain, len(part), images=self._images[part])

    def _mirrored(self, random: np.random.Generator, count: int) -> NDArray[np.bool_]:
        return (random.random(count) < 0.5) & self._settings.mirror

    def _samples(
        self,
        random: np.random.Generator,
        frames: Indices,
        is_mirrored: NDArray[np.bool_],
        repeats: int,
    ) -> TrainingSamples:
        repeated = np.repeat(frames, repeats)
        ticks = self._timeline.draw_ticks(repeated, random)
        samples = self._timeline.samples(repeated, ticks, random)
        return samples.mirrored(np.repeat(is_mirrored, repeats))

    def _batch(
        self,
        random: np.random.Generator,
        samples: TrainingSamples,
        frames: int,
        *,
        images: ImageArray | None = None,
        look: FloatArray | None = None,
        features: FloatArray | None = None,
    ) -> Batch:
        count, grain = len(samples.state), None
        if look is not None and images is not None:
            grain = random.standard_normal((3, *images.shape[1:3]), dtype=np.float32)
        arrays = {
            **vars(samples),
            "images": images,
            "look": np.zeros((frames, 5), np.float32) if look is None else look,
            "grain": grain,
            "features": features,
            "gate": samples.gate[:: count // frames].copy(),
            "noise": random.standard_normal(samples.chunk.shape, dtype=np.float32),
            "timestep": random.integers(0, self._timesteps, count),
        }
        tensors: dict[str, Any] = {
            name: None if array is None else torch.from_numpy(array)
            for name, array in arrays.items()
        }
        return Batch(**tensors)


def ahead(make: Callable[[int], T], first: int) -> Generator[T]:
    """Yield ``make(first)``, ``make(first + 1)``, ... without end, prepared in one thread.

    Closing the generator ends and joins the thread.
    """
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="train-loader") as pool:
        waiting: deque[Future[T]] = deque()
        step = first
        try:
            while True:
                while len(waiting) < AHEAD:
                    waiting.append(pool.submit(make, step))
                    step += 1
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def normalised(batch: Batch, contract: Contract) -> Tensor:
    """Return images [B, 3, height, width] as the network takes them, in the look of ``batch.look``.

    A look is contrast about mid-grey, brightness, the colour of the light, and the sensor's noise.
    A neutral look equals ``preprocess.image_to_input``. The memory is channels-last.
    """
    if batch.images is None:
        raise ValueError("a batch without images")
    image = batch.images.permute(0, 3, 1, 2).float() / 255
    if batch.grain is not None:
        contrast, brightness, red, blue, sigma = batch.look.view(-1, 5, 1, 1, 1).unbind(1)
        gain = torch.cat([1 + red, torch.ones_like(red), 1 + blue], dim=1)
        image = ((image - 0.5) * (1 + contrast) + 0.5 + brightness) * gain
        image = (image + sigma * batch.grain).clamp(0, 1)
    return normalise_image(image, contract)


def normalise_image(image: Tensor, contract: Contract) -> Tensor:
    """Normalise images [B, 3, height, width] in [0, 1] for the network."""
    mean = torch.tensor(contract.image_mean_rgb, device=image.device).view(1, 3, 1, 1)
    std = torch.tensor(contract.image_std_rgb, device=image.device).view(1, 3, 1, 1)
    return (image - mean) / std
