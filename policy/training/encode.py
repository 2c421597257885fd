"""Encode images once, into stored features or latents."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from policy.data.frames import disk_error
from policy.data.interpolation import Indices
from policy.engines.openvino_bulk import BulkEncoder
from policy.training.batches import Batches, FeatureStore, normalise_image
from policy.training.parallel import computing_in
from policy.training.settings import TrainSettings
from policy.training.trainee import Trainee, refresh_batch_norm

NORM_BATCHES = 16
ENCODE_BATCH = 64

Encode: TypeAlias = Callable[[Indices, bool], Tensor]
"""(images, whether to mirror them all) -> [B, D]."""
Job: TypeAlias = tuple[tuple[Indices, bool], ...]
"""Images to encode between two checks of the time, each part as it is or mirrored."""


class Encoder:
    """The backbone of a trainee on stored images, without augmentation."""

    def __init__(
        self, trainee: Trainee, batches: Batches, *, device: torch.device, bf16: bool
    ) -> None:
        self._trainee, self._batches = trainee, batches
        self._device, self._bf16 = device, bf16
        self._contract = trainee.policy.contract

    def refresh_norms(self) -> None:
        """Take the statistics of the batch norms anew from images of full size."""
        frames = self._batches.frames
        count = min(NORM_BATCHES * ENCODE_BATCH, len(frames))
        chosen = frames[np.linspace(0, len(frames) - 1, count).astype(int)]
        parts = np.array_split(chosen, max(1, count // ENCODE_BATCH))
        with computing_in(self._device, self._bf16):
            refresh_batch_norm(
                self._trainee, (self._images(part, is_mirrored=False) for part in parts)
            )

    def encode_all(
        self, path: Path, settings: TrainSettings, should_continue: Callable[[float], bool]
    ) -> FeatureStore:
        """Encode the images to ``path``, in a random order; see ``encode_rows``."""
        frames = np.random.default_rng([settings.seed, 3]).permutation(self._batches.frames)
        dim = self._trainee.policy.backbone.out_dim
        jobs = one_way_first(frames, mirror=settings.mirror)
        return encode_rows(path, jobs, self._encode(), dim=dim, should_continue=should_continue)

    def _encode(self) -> Encode:
        if self._device.type == "cpu":
            bulk = BulkEncoder(self._trainee.policy, "bf16" if self._bf16 else "f32")
            return lambda frames, is_mirrored: torch.from_numpy(
                bulk(self._images(frames, is_mirrored=is_mirrored).numpy())
            )

        @torch.inference_mode()
        def in_torch(frames: Indices, is_mirrored: bool) -> Tensor:
            images = self._images(frames, is_mirrored=is_mirrored)
            with computing_in(self._device, self._bf16):
                features: Tensor = self._trainee.policy.backbone(images)
            return features

        return in_torch

    def _images(self, frames: Indices, *, is_mirrored: bool) -> Tensor:
        images = self._batches.images(frames, is_mirrored=is_mirrored).to(self._device)
        return normalise_image(images.permute(0, 3, 1, 2).float() / 255, self._contract)


def both_ways(frames: Indices, *, mirror: bool) -> list[Job]:
    """Jobs that each encode some images both as they are and mirrored, or only as they are."""
    ways = (False, True) if mirror else (False,)
    return [tuple((part, way) for way in ways) for part in _parts(frames)]


def one_way_first(frames: Indices, *, mirror: bool) -> list[Job]:
    """Jobs that encode each image one way, and when all are done the other way.

    Where time is short, two images teach more than one image both ways.
    """
    parts = _parts(frames)
    jobs: list[Job] = [((part, mirror and index % 2 == 1),) for index, part in enumerate(parts)]
    if mirror:
        jobs += [((part, index % 2 == 0),) for index, part in enumerate(parts)]
    return jobs


def _parts(frames: Indices) -> list[Indices]:
    return [frames[start : start + ENCODE_BATCH] for start in range(0, len(frames), ENCODE_BATCH)]


def encode_rows(
    path: Path,
    jobs: Sequence[Job],
    encode: Encode,
    *,
    dim: int,
    should_continue: Callable[[float], bool],
) -> FeatureStore:
    """Encode images to ``path``, in float16 to save half the disk, while there is time.

    Args:
        path: the file.
        jobs: which images, in this order.
        encode: makes rows of ``dim`` numbers.
        dim: width of a row.
        should_continue: takes the share that is done; False ends the encoding.

    Raises:
        DatasetError: no room on the disk.
    """
    most = max(int(part.max()) for job in jobs for part, _ in job)
    row_of = np.full((2, most + 1), -1, np.int64)
    rows = 0
    try:
        with path.open("wb") as file:
            for index, job in enumerate(jobs):
                if index and not should_continue(index / len(jobs)):
                    break
                for part, is_mirrored in job:
                    encoded = encode(part, is_mirrored).to(torch.float16)
                    file.write(encoded.cpu().numpy().tobytes())
                    row_of[int(is_mirrored), part] = rows + np.arange(len(part))
                    rows += len(part)
    except OSError as error:
        raise disk_error(path, error) from error
    return FeatureStore(path, dim, row_of)
