"""Engines of torch: operator by operator, the reference for every other engine, and CUDA graphs.

And what a user's policy holds: its modules, and the attributes that change from call to call.
"""

import copy
import gc
import hashlib
import re
import sys
from collections import UserDict, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import _lru_cache_wrapper, partial
from io import IOBase
from itertools import count, islice
from queue import Queue
from types import (
    CellType,
    CodeType,
    FunctionType,
    MemberDescriptorType,
    MethodType,
    ModuleType,
    SimpleNamespace,
)
from typing import Any

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
"""Largest number of objects that are searched for a policy's modules and memory."""
_WRAPPERS = (partial, MethodType, CellType, staticmethod, classmethod, property)
_COLLECTIONS = (list, tuple, dict, set, frozenset, deque, *_WRAPPERS)
_OPENED = (*_COLLECTIONS, _lru_cache_wrapper, SimpleNamespace, UserDict, Queue, nn.Module)
"""Types that are searched beside those of packages outside ``_LIBRARIES``; a cached function not
for its results."""
_LIBRARIES = sys.stdlib_module_names | {"torch", "numpy"}
_OURS = ("policy", "mavbridge")
_OF_TORCH = frozenset(vars(nn.Module()))
_OUTSIDE = frozenset(
    (
        *("time", "datetime", "io", "_io", "posix", "mmap", "_multiprocessing"),
        *("_thread", "_queue", "_socket", "select"),
    )
)
"""Modules of Python's own by which a function learns what its arguments do not say."""
HIGH_PRIORITY, NORMAL_PRIORITY = -1, 0


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
    """ "Compile" a function for torch on a device: convert arrays to tensors and back."""
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
    """Return the modules that a policy is or holds, except those inside another module."""
    modules = [held for _, held, _ in _held_by(policy) if isinstance(held, nn.Module)]
    inner = {id(child) for module in modules for child in module.modules() if child is not module}
    return [module for module in modules if id(module) not in inner]


def snapshot(policy: object) -> dict[str, object]:
    """Return the attributes of a policy and of all that it holds, by name, in a comparable form.

    Tensors are compared by value, except the weights, which no forward call changes; numpy arrays,
    numbers and texts by value; collections by the identity of their elements; iterators but
    counters never compare equal; other objects by identity.
    """
    return {
        path + name: _mark(value)
        for path, _, inside in _held_by(policy)
        for name, value in inside.items()
    }


def _held_by(policy: object) -> list[tuple[str, object, dict[str, object]]]:
    """Return the policy and the modules, collections and objects below it: path, it, attributes."""
    held, seen = [("", policy, _attributes(policy))], {id(policy)}
    for path, _, inside in held:  # grows
        for name, value in inside.items():
            is_open = isinstance(value, _OPENED) or _is_of_user(type(value)) or _is_code(value)
            if is_open and id(value) not in seen and len(held) < MAX_HELD:
                seen.add(id(value))
                held.append((path + name, value, _attributes(value)))
    return held


def _is_of_user(kind: type) -> bool:
    return kind.__module__.partition(".")[0] not in _LIBRARIES


def _is_code(value: object) -> bool:
    """True for a function, class or module of the user's, rather than of an installed package."""
    if not isinstance(value, FunctionType | type | ModuleType):
        return False
    name = str(getattr(value, "__module__", None) or value.__name__)
    file = getattr(sys.modules.get(name), "__file__", None) or ""
    is_library = name.partition(".")[0] in (*_LIBRARIES, *_OURS) or "site-packages" in file
    return not is_library


def _reached(function: FunctionType) -> dict[str, object]:
    """Return the globals, cells and defaults that a function reads or writes, by their names."""
    codes, names = [function.__code__], set[str]()
    for code in codes:  # grows by the functions inside
        names.update(code.co_names)
        codes += [each for each in code.co_consts if isinstance(each, CodeType)]
    reached = {name: each for name, each in function.__globals__.items() if name in names}
    code = function.__code__
    arguments = reversed(code.co_varnames[: code.co_argcount])
    reached |= dict(zip(arguments, reversed(function.__defaults__ or ()), strict=False))
    cells = dict(zip(code.co_freevars, function.__closure__ or (), strict=True))
    return reached | cells | (function.__kwdefaults__ or {})


def _attributes(holder: object) -> dict[str, object]:
    """Return the elements of a collection, and the attributes of an object and of its class."""
    items: Iterable[tuple[object, object]] = ()
    if isinstance(holder, _COLLECTIONS):
        items = holder.items() if isinstance(holder, dict) else enumerate(gc.get_referents(holder))
    elements = {f"[{key}]": value for key, value in islice(items, MAX_HELD)}
    attributes = _reached(holder) if isinstance(holder, FunctionType) else {}
    kinds = holder.__mro__ if isinstance(holder, type) else type(holder).__mro__
    for kind in filter(_is_of_user, reversed(kinds)):
        attributes |= vars(kind)
    slots = [name for name, each in attributes.items() if isinstance(each, MemberDescriptorType)]
    attributes |= {name: getattr(holder, name, None) for name in slots}
    attributes |= getattr(holder, "__dict__", {})
    if isinstance(holder, ModuleType):  # Python itself writes into __warningregistry__
        attributes = {name: each for name, each in attributes.items() if not name.startswith("__")}
    if isinstance(holder, nn.Module):
        is_script = isinstance(holder, torch.jit.ScriptModule)  # holds methods of its original, too
        attributes = {
            name: each
            for name, each in attributes.items()
            if name not in _OF_TORCH and not (is_script and isinstance(each, MethodType))
        }
        attributes |= {**dict(holder.named_buffers(recurse=False)), **dict(holder.named_children())}
    return elements | {f".{name}": value for name, value in attributes.items()}


def changes(before: dict[str, object], after: dict[str, object]) -> list[str]:
    """Return the names, without the path, of attributes that were added, removed or changed."""
    names = [name for name in {**before, **after} if before.get(name) != after.get(name)]
    return sorted({re.sub(r"\[.*?\]", "", name).rpartition(".")[2] for name in names})


@contextmanager
def outside_calls() -> Iterator[set[str]]:
    """Context manager: yield the names, complete at its end, of this thread's calls that read a
    clock, file, socket or lock."""
    names, before, collects = set[str](), sys.getprofile(), gc.isenabled()

    def note(_frame: object, event: str, called: Any) -> None:
        if event == "c_call":
            owner = getattr(called, "__self__", None)
            kind = owner if isinstance(owner, type) else type(owner)
            if (getattr(called, "__module__", None) or kind.__module__) in _OUTSIDE:
                names.add(called.__name__)

    gc.disable()  # a collection would call what is none of the policy's
    sys.setprofile(note)
    try:
        yield names
    finally:
        sys.setprofile(before)
        if collects:
            gc.enable()


def _mark(value: object) -> object:
    if isinstance(value, Tensor) and value.layout is torch.strided and not value.is_meta:
        array = value.detach().cpu().contiguous()
        digest = hashlib.sha256(array.float().numpy().tobytes()).digest()
        return str(array.dtype), tuple(array.shape), digest
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, hashlib.sha256(value.tobytes()).digest()
    if value is None or isinstance(value, bool | int | str | bytes):
        return value
    if isinstance(value, float | count):
        return repr(value)  # NaN equals itself; a counter tells its next number
    if isinstance(value, bytearray):
        return bytes(value)
    if isinstance(value, dict):
        return tuple((id(key), id(element)) for key, element in value.items())
    if isinstance(value, list | tuple | set | frozenset | deque):
        return tuple(map(id, value))
    if isinstance(value, Iterator) and not isinstance(value, IOBase):
        return object()
    return id(value)
