"""One optimiser step on several cores: each core works alone on a part of the batch.

Splitting each operator over the cores instead wakes all of them some thousand times a step; on two
cores shared with another program, that left half of the time unused.
"""

import copy
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Generic, Self, TypeVar

import torch
from torch import Tensor, nn

M = TypeVar("M", bound=nn.Module)


@dataclass(frozen=True)
class TensorBatch:
    """Batch: a dataclass of tensors that share their first axis; one may be None."""

    def to(self, device: torch.device) -> Self:
        """Copy to a device."""
        given = {name: value for name, value in vars(self).items() if value is not None}
        return replace(self, **{n: v.to(device, non_blocking=True) for n, v in given.items()})

    def split(self, count: int) -> list[Self]:
        """Split into at most ``count`` parts of about equal size."""
        rows = len(next(iter(vars(self).values())))
        return [
            replace(self, **{name: value[part] for name, value in vars(self).items()})
            for part in row_parts(rows, count)
        ]


B = TypeVar("B", bound=TensorBatch)


@dataclass(frozen=True, kw_only=True)
class StepLoss:
    """Losses of one batch."""

    total: Tensor
    """Loss to minimise."""
    metrics: Mapping[str, Tensor]
    """Reported losses by name; includes ``loss``."""


class Gradients(Generic[M]):
    """Computes losses and gradients of a module; closing it joins its threads."""

    def __init__(self, trainee: M, *, device: torch.device, bf16: bool, threads: int) -> None:
        """On a CPU, use that many threads; a GPU takes the whole batch.

        Weights are shared, buffers are not: the norms' statistics are those of the first part.
        """
        self._device, self._bf16 = device, bf16
        threads = threads if device.type == "cpu" else 1
        shared = {id(weight): weight for weight in trainee.parameters()}
        others = [copy.deepcopy(trainee, dict(shared)) for _ in range(threads - 1)]
        self.replicas = [trainee, *others]
        """The trainee, and copies that share its weights."""
        self._pool = ThreadPoolExecutor(
            threads, thread_name_prefix="train", initializer=torch.set_num_threads, initargs=(1,)
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown()

    def compute(self, batch: B, losses: Callable[[M, B], StepLoss]) -> dict[str, Tensor]:
        """Set ``grad`` of all trainable weights; return the metrics, means over the parts.

        Deterministic for a batch and a number of threads: parts are added in order.
        """
        weights = [p for p in self.replicas[0].parameters() if p.requires_grad]

        def one(replica: M, part: B) -> tuple[Mapping[str, Tensor], Sequence[Tensor]]:
            with computing_in(self._device, self._bf16):
                loss = losses(replica, part)
            made = torch.autograd.grad(loss.total, weights, materialize_grads=True)
            return {name: value.detach() for name, value in loss.metrics.items()}, made

        results = list(self._pool.map(one, self.replicas, batch.split(len(self.replicas))))
        share = 1.0 / len(results)
        metrics = {name: value * share for name, value in results[0][0].items()}
        sums = [gradient * share for gradient in results[0][1]]
        for others, made in results[1:]:
            metrics = {name: value + share * others[name] for name, value in metrics.items()}
            torch._foreach_add_(sums, list(made), alpha=share)
        for weight, gradient in zip(weights, sums, strict=True):
            weight.grad = gradient
        return metrics


@contextmanager
def one_thread() -> Generator[int]:
    """Run torch on one thread inside the block; yields the number of threads that it had.

    On cores shared with another program, threads that wait for each other in every small operator
    of an optimiser's step took a hundred times the processor time of one.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield before
    finally:
        torch.set_num_threads(before)


def row_parts(count: int, parts: int) -> list[slice]:
    """Return at most ``parts`` slices of about equal size, ``count`` rows in total."""
    bounds = [count * part // parts for part in range(parts + 1)]
    return [slice(start, stop) for start, stop in pairwise(bounds) if stop > start]


def computing_in(device: torch.device, bf16: bool) -> torch.autocast:
    """Return autocast to bfloat16, or a no-op context."""
    return torch.autocast(device.type, torch.bfloat16, enabled=bf16)
