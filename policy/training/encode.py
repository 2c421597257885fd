"""Encode images once, into stored features or latents."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from policy.data.frames import disk_error
from policy.data.interpolation import Indices
from policy.training.batches import FeatureStore

ENCODE_BATCH = 64

Encode: TypeAlias = Callable[[Indices, bool], Tensor]
"""(images, whether to mirror them all) -> [B, D]."""
Job: TypeAlias = tuple[tuple[Indices, bool], ...]
"""Images to encode between two checks of the time, each part as it is or mirrored."""


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
    """Encode images to ``path``, as rows of ``dim`` float16, in the order of the jobs.

    ``should_continue`` takes the share that is done; False ends the encoding.
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
