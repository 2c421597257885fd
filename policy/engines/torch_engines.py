"""Engines of torch: operator by operator, the reference for every other engine, and CUDA graphs."""

import copy
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from policy.contract import FloatArray
from policy.engines.runner import Compile, ExecutionSettings, Shape, make_runner, run_as
from policy.errors import PolicyError
from policy.protocol import PolicyRunner, SingleRatePolicy

WARM_UP_CALLS = 3
"""Calls before a capture, so that libraries have set up kernels (PyTorch's CUDA notes)."""
MAX_HELD = 10_000
"""Largest number of objects that are searched for a policy's modules."""
_COLLECTIONS = (list, tuple, set, deque)
_LIBRARIES = sys.stdlib_module_names | {"torch", "numpy"}
"""Packages whose objects are not searched."""
HIGH_PRIORITY, NORMAL_PRIORITY = -1, 0
TRIAL_EVERY, TRIAL_STEPS = 200, 4
"""Steps from one trial of threads to the next; and in a trial, which warms up by the first two."""


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Context manager: let torch use ``count`` threads, at least one."""
    before = torch.get_num_threads()
    torch.set_num_threads(max(1, count))
    try:
        yield
    finally:
        torch.set_num_threads(before)


class FasterThreads:
    """Uses all of torch's threads or one, whichever took a step faster in the last trial.

    Threads wait for each other in every operator: on cores that other programs use too, a step of
    a training took two threads ten times as long as one.
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s, self._steps = now_s, 0
        self._spent_s = {torch.get_num_threads(): 0.0, 1: 0.0}

    @contextmanager
    def step(self) -> Iterator[None]:
        """Context manager: one of many similar steps; what follows it uses the faster number."""
        number = self._steps % TRIAL_EVERY
        self._steps += 1
        if number >= TRIAL_STEPS:
            yield
            return
        counts = list(self._spent_s)
        count = counts[number % len(counts)]
        torch.set_num_threads(count)
        begun_s = self._now_s()
        yield
        self._spent_s[count] = self._now_s() - begun_s
        torch.set_num_threads(min(counts, key=self._spent_s.__getitem__))


def make_torch_runner(policy: SingleRatePolicy, settings: ExecutionSettings) -> PolicyRunner:
    """Wrap a torch policy for the loops: numpy in and out, no gradients, tried once.

    A module is moved to the device. In dual rate, torch is set to one thread per operator in the
    whole process.
    """
    if settings.dual_rate:
        torch.set_num_threads(1)  # two loops infer at once: one core each, no contention
    if isinstance(policy, nn.Module):
        policy.to(settings.device).eval()
    run = run_eagerly(settings.name, settings.device)
    return make_runner(policy, run, run, engine="torch", settings=settings)


def run_eagerly(name: str, device: str) -> Compile:
    """Return an adapter of functions of tensors on a device: converts arrays to them and back."""
    # torch.tensor copies: published arrays are read-only, which torch cannot express.
    run = run_as(name, partial(torch.tensor, device=device), Tensor, "torch tensors")
    return lambda method, shapes: torch.inference_mode()(run(method, shapes))


def make_cuda_graph_runner(policy: SingleRatePolicy, settings: ExecutionSettings) -> PolicyRunner:
    """Capture a copy of the policy for the loops; tried once."""
    if not isinstance(policy, nn.Module):
        raise PolicyError(f"{settings.name} is no torch.nn.Module, so its work cannot be captured")
    device = torch.device(settings.device)
    return make_runner(
        copy.deepcopy(policy).to(device).eval(),
        partial(_Graph, stream=_stream(device, NORMAL_PRIORITY)),
        partial(_Graph, stream=_stream(device, HIGH_PRIORITY)),
        engine="cuda-graph",
        settings=settings,
    )


def _stream(device: torch.device, priority: int) -> torch.cuda.Stream:
    return torch.cuda.Stream(device, priority)  # type: ignore[no-untyped-call]


class _Graph:
    """NVIDIA GPUs: a function that is captured once as a CUDA graph, then replayed; for one thread.

    A replay launches hundreds of kernels in one call; otherwise an action head on a GPU spends its
    time on launches. Each path has its own stream, the action's with high priority, so a tick does
    not wait for an image. The encoder's kernels still run between the action's kernels.

    Every graph reads and writes static memory. Inputs and results are copied through pinned memory
    on the graph's own stream, and the caller waits for an event after the last copy. So nothing of
    a replay is left in flight; encoded images are passed on as arrays, and no tensor is used on two
    streams.
    """

    def __init__(
        self, function: Callable[..., Tensor], shapes: Sequence[Shape], stream: torch.cuda.Stream
    ) -> None:
        self._stream = stream
        self._pinned = [torch.zeros(shape, pin_memory=True) for shape in shapes]
        # Wait for work of other streams that the capture depends on, such as the weights' copy.
        torch.cuda.synchronize(stream.device)
        with torch.cuda.device(stream.device), torch.cuda.stream(stream), torch.inference_mode():
            self._inputs = [host.to(stream.device) for host in self._pinned]
            for _ in range(WARM_UP_CALLS):
                function(*self._inputs)
            stream.synchronize()
            self._graph = torch.cuda.CUDAGraph()
            # thread_local: CUDA calls of other threads do not abort the capture.
            with torch.cuda.graph(self._graph, stream=stream, capture_error_mode="thread_local"):
                self._output = function(*self._inputs)
            self._result = torch.zeros(self._output.shape, pin_memory=True)
        self._done = torch.cuda.Event()  # type: ignore[no-untyped-call]

    def __call__(self, *arrays: FloatArray) -> FloatArray:
        """Run the graph and return a copy of its output; reject arrays of another shape."""
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


def modules_of(policy: object) -> list[nn.Module]:
    """Return the modules that a policy is or holds, except those inside another module.

    They are searched in attributes and collections, and in the objects of other classes there.
    """
    held, seen = [policy], {id(policy)}
    for each in held:  # grows
        inside = [*getattr(each, "__dict__", {}).values()]
        if isinstance(each, dict):
            inside += each.values()
        elif isinstance(each, _COLLECTIONS):
            inside += each
        elif isinstance(each, partial):
            inside += [each.func, *each.args, *each.keywords.values()]
        for value in inside:
            is_open = isinstance(value, (*_COLLECTIONS, dict, partial, nn.Module))
            is_foreign = type(value).__module__.partition(".")[0] not in _LIBRARIES
            if (is_open or is_foreign) and id(value) not in seen and len(held) < MAX_HELD:
                seen.add(id(value))
                held.append(value)
    modules = [each for each in held if isinstance(each, nn.Module)]
    children = {id(child) for each in modules for child in each.modules() if child is not each}
    return [each for each in modules if id(each) not in children]
