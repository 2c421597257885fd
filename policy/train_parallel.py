"""One optimiser step on several cores: each works on a part of the batch, alone.

Splitting each operator over cores instead wakes all of them some thousand times a step; on two
cores that somebody else uses too, that left half of the time unused.
"""

import copy
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType

import torch
from torch import Tensor

from policy.train_batches import Batch
from policy.train_model import Losses, Trainee, computing_in


class Gradients:
    """Computes losses and gradients of a trainee; close it to join its threads."""

    def __init__(self, trainee: Trainee, *, device: torch.device, bf16: bool) -> None:
        """Take as many threads as torch has, on a CPU; a GPU takes the whole batch."""
        self._device, self._bf16 = device, bf16
        self._threads = torch.get_num_threads() if device.type == "cpu" else 1
        others = [_sharing_weights(trainee) for _ in range(self._threads - 1)]
        self._replicas = [trainee, *others]
        self._pool = ThreadPoolExecutor(
            self._threads, thread_name_prefix="train", initializer=_use_one_thread
        )

    def __enter__(self) -> "Gradients":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._pool.shutdown()

    def set_mode(self, *, trains_encoder: bool) -> None:
        """Training mode, but for the norms of an encoder that stands still."""
        for replica in self._replicas:
            replica.train()
            replica.policy.backbone.train(trains_encoder)

    def compute(self, batch: Batch, stick_scale: Tensor, gate_weight: float) -> Tensor:
        """Set ``grad`` of all weights; losses [2], of sticks and gates.

        The same numbers for the same batch and count of threads: parts are added in order.
        """
        weights = [p for p in self._replicas[0].parameters() if p.requires_grad]
        # A batch norm needs two images.
        parts = batch.split(max(1, min(self._threads, len(batch.look) // 2)))

        def one(replica: Trainee, part: Batch) -> tuple[Tensor, Sequence[Tensor]]:
            with computing_in(self._device, self._bf16):
                losses: Losses = replica(part, stick_scale)
            total = losses.sticks + gate_weight * losses.gate
            made = torch.autograd.grad(total, weights, allow_unused=True, materialize_grads=True)
            return torch.stack([losses.sticks.detach(), losses.gate.detach()]), made

        results = list(self._pool.map(one, self._replicas, parts))
        share = 1.0 / len(results)
        told, sums = results[0][0] * share, [g * share for g in results[0][1]]
        for losses, made in results[1:]:
            told += share * losses
            torch._foreach_add_(sums, list(made), alpha=share)
        for weight, gradient in zip(weights, sums, strict=True):
            weight.grad = gradient
        return told


def _sharing_weights(trainee: Trainee) -> Trainee:
    """The same parameters, with buffers of its own."""
    return copy.deepcopy(trainee, {id(weight): weight for weight in trainee.parameters()})


def _use_one_thread() -> None:
    torch.set_num_threads(1)
