"""NVIDIA GPUs: the image path and the action path captured once as CUDA graphs, then replayed.

A replay launches hundreds of kernels in one call, which is what an action head on a GPU spends its
time on. Each path has a stream of its own, the action's with high priority, so that a tick does not
wait for an image; where both are on one GPU the encoder's kernels still run between its kernels.

Every graph reads and writes static memory. Inputs go up and results come down through pinned memory
on the graph's own stream, and the caller waits for an event behind them: nothing of a replay is
left in flight, and encoded images are handed over as arrays, so no tensor has two streams.
"""

import copy
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from policy.contract import FloatArray
from policy.engines.runner import ExecutionSettings, Shape, make_runner
from policy.errors import PolicyError
from policy.protocol import PolicyRunner, SingleRatePolicy

NAME = "cuda-graph"
WARM_UP_CALLS = 3
"""Before a capture, so that libraries have their choices and handles (PyTorch's CUDA notes)."""
HIGH_PRIORITY, NORMAL_PRIORITY = -1, 0


def make_cuda_graph_runner(policy: SingleRatePolicy, settings: ExecutionSettings) -> PolicyRunner:
    """Capture a copy of the policy for the loops; tried once.

    Raises:
        PolicyError: it is no torch module, has no fast path where one was asked for, or failed on a
            dummy sample.
        RuntimeError: a capture failed.
    """
    if not isinstance(policy, nn.Module):
        raise PolicyError(f"{settings.name} is no torch.nn.Module, so its work cannot be captured")
    action_device = torch.device(settings.action_device)
    vision_device = torch.device(settings.vision_device)
    action = copy.deepcopy(policy).to(action_device).eval()
    vision = action
    if vision_device != action_device:
        vision = copy.deepcopy(action).to(vision_device)
    return make_runner(
        vision,
        action,
        partial(_Graph, stream=_stream(vision_device, NORMAL_PRIORITY)),
        partial(_Graph, stream=_stream(action_device, HIGH_PRIORITY)),
        engine=NAME,
        settings=settings,
    )


def _stream(device: torch.device, priority: int) -> torch.cuda.Stream:
    return torch.cuda.Stream(device, priority)  # type: ignore[no-untyped-call]


class _Graph:
    """A function captured with static inputs and output; for one thread."""

    def __init__(
        self,
        function: Callable[..., Tensor],
        shapes: Sequence[Shape],
        stream: torch.cuda.Stream,
    ) -> None:
        self._stream = stream
        self._pinned = [torch.zeros(shape, pin_memory=True) for shape in shapes]
        # Work of other streams that this one builds upon, such as the copy of the weights.
        torch.cuda.synchronize(stream.device)
        with torch.cuda.device(stream.device), torch.cuda.stream(stream), torch.inference_mode():
            self._inputs = [host.to(stream.device) for host in self._pinned]
            for _ in range(WARM_UP_CALLS):
                function(*self._inputs)
            stream.synchronize()
            self._graph = torch.cuda.CUDAGraph()
            # thread_local: what other threads do with CUDA meanwhile does not end the capture.
            with torch.cuda.graph(self._graph, stream=stream, capture_error_mode="thread_local"):
                self._output = function(*self._inputs)
            self._result = torch.zeros(self._output.shape, pin_memory=True)
        self._done = torch.cuda.Event()  # type: ignore[no-untyped-call]

    def __call__(self, *arrays: FloatArray) -> FloatArray:
        """Run the graph; the result is the caller's. An array of another shape is refused."""
        for host, array in zip(self._pinned, arrays, strict=True):
            if array.shape != tuple(host.shape):
                raise PolicyError(f"an input must be {list(host.shape)}, got {list(array.shape)}")
            np.copyto(host.numpy(), array)
        with torch.cuda.stream(self._stream), torch.inference_mode():
            for host, device in zip(self._pinned, self._inputs, strict=True):
                device.copy_(host, non_blocking=True)
            self._graph.replay()
            self._result.copy_(self._output, non_blocking=True)
            self._done.record(self._stream)
        self._done.synchronize()  # without the GIL
        return self._result.numpy().copy()
