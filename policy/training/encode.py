"""From the end of the encoder's training to kept features for the head's."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from policy.contract import Contract
from policy.data.frames import disk_error
from policy.data.interpolation import Indices
from policy.engines.openvino_bulk import BulkEncoder
from policy.training.batches import Batches, PooledStore, normalise_image
from policy.training.parallel import computing_in
from policy.training.trainee import Trainee, refresh_batch_norm

NORM_BATCHES = 16
ENCODE_BATCH = 64


class Encoder:
    """The backbone of a trainee on stored images, as they are in flight."""

    def __init__(
        self, trainee: Trainee, batches: Batches, *, device: torch.device, bf16: bool
    ) -> None:
        self._trainee, self._batches = trainee, batches
        self._device, self._bf16 = device, bf16
        self._contract: Contract = trainee.policy.contract

    def refresh_norms(self) -> None:
        """Batch norms of the images at their full size."""
        frames = self._batches.frames
        count = min(NORM_BATCHES * ENCODE_BATCH, len(frames))
        chosen = frames[np.linspace(0, len(frames) - 1, count).astype(int)]

        def images() -> Iterator[Tensor]:
            for part in np.array_split(chosen, max(1, count // ENCODE_BATCH)):
                yield self._images(part, mirrored=False)

        with computing_in(self._device, self._bf16):
            refresh_batch_norm(self._trainee, images())

    def encode_all(
        self, path: Path, *, mirror: bool, seed: int, go_on: Callable[[float], bool]
    ) -> PooledStore:
        """Encode the images to ``path``, in a random order, while ``go_on`` of the part done.

        Raises:
            DatasetError: no room on the disk.
        """
        frames = np.random.default_rng([seed, 3]).permutation(self._batches.frames)
        jobs = one_way_first(frames, mirror=mirror)
        dim = self._trainee.policy.backbone.out_dim
        return encode_rows(path, jobs, self._encode(), dim=dim, go_on=go_on)

    def _encode(self) -> Callable[[Indices, bool], Tensor]:
        """(frames, are they mirrored) -> [B, D]"""
        if self._device.type == "cpu":
            bulk = BulkEncoder(self._trainee.policy, "bf16" if self._bf16 else "f32")
            return lambda frames, mirrored: torch.from_numpy(
                bulk(self._images(frames, mirrored=mirrored).numpy())
            )

        @torch.inference_mode()
        def in_torch(frames: Indices, mirrored: bool) -> Tensor:
            with computing_in(self._device, self._bf16):
                pooled: Tensor = self._trainee.policy.backbone(
                    self._images(frames, mirrored=mirrored)
                )
            return pooled

        return in_torch

    def _images(self, frames: Indices, *, mirrored: bool) -> Tensor:
        contract = self._contract
        size = (contract.image_height, contract.image_width)
        images = self._batches.images(frames, size, mirrored=mirrored).to(self._device)
        return normalise_image(images.permute(0, 3, 1, 2).float() / 255, contract)


Job: TypeAlias = tuple[tuple[Indices, bool], ...]
"""Images to encode before it is asked whether to go on, each part as it is or mirrored."""


def both_ways(frames: Indices, *, mirror: bool) -> list[Job]:
    """Jobs that encode each image both ways at a time, or none of them mirrored."""
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
    encode: Callable[[Indices, bool], Tensor],
    *,
    dim: int,
    go_on: Callable[[float], bool],
) -> PooledStore:
    """Encode images to ``path``, in float16 to save half the disk, while there is time.

    Args:
        path: the file.
        jobs: of the images, in this order.
        encode: some images, as they are or all mirrored -> [B, dim].
        dim: of what it makes.
        go_on: of the part done; False ends it.

    Raises:
        DatasetError: no room on the disk.
    """
    most = max(int(part.max()) for job in jobs for part, _ in job)
    row_of = np.full((2, most + 1), -1, np.int64)
    rows = 0
    try:
        with path.open("wb") as file:
            for index, job in enumerate(jobs):
                if index and not go_on(index / len(jobs)):
                    break
                for part, is_mirrored in job:
                    encoded = encode(part, is_mirrored).to(torch.float16)
                    file.write(encoded.cpu().numpy().tobytes())
                    row_of[int(is_mirrored), part] = rows + np.arange(len(part))
                    rows += len(part)
    except OSError as error:
        raise disk_error(path, error) from error
    return PooledStore(path, dim, row_of)
