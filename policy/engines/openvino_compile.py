"""OpenVINO graphs, converted and compiled for the CPU or loaded from the user's cache.

Each graph infers on the calling thread alone, without the GIL, on arrays that are bound once.
Threads are not pinned to cores: measured beside a second loop, pinning was slower or made no
difference.
"""

import contextlib
import ctypes
import hashlib
import io
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import openvino as ov
import torch

from policy.contract import FloatArray
from policy.engines.runner import Precision
from policy.errors import PolicyError
from policy.files import whole_file

MAX_ENTRIES = 24
"""Files to keep: about eight policies of two graphs each, some at two precisions. The least
recently used is dropped first."""
MAX_BYTES = 2_000_000_000
"""Total size of the files: the graphs of a large policy are as large as its weights."""
_DIGEST_BYTES = hashlib.sha256().digest_size


def user_cache_folder() -> Path:
    """Return the cache folder (XDG base directory specification): $XDG_CACHE_HOME or ~/.cache."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    # The specification says to ignore a relative path.
    root = Path(base) if Path(base).is_absolute() else Path("~/.cache").expanduser()
    return root / "mavbridge"


def load_blob(path: Path) -> bytes | None:
    """Return the bytes stored in a file; None if there are none, or they are damaged."""
    try:
        content = path.read_bytes()
        path.touch()
    except OSError:
        return None
    digest, blob = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
    return blob if hashlib.sha256(blob).digest() == digest else None


def store_blob(path: Path, blob: bytes) -> None:
    """Store ``blob`` if possible; drop the oldest beyond ``MAX_ENTRIES`` or ``MAX_BYTES``."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as draft:
            draft.write_bytes(hashlib.sha256(blob).digest() + blob)
        _make_room(path.parent)


def _make_room(folder: Path) -> None:
    entries = []
    for path in folder.glob("*.graph*"):  # leftovers of a killed process count too
        with contextlib.suppress(FileNotFoundError):  # another process made room
            stat = path.stat()
            entries.append((stat.st_mtime_ns, path, stat.st_size))
    total = 0
    for place, (_, path, size) in enumerate(sorted(entries, reverse=True)):
        total += size
        if place >= MAX_ENTRIES or total > MAX_BYTES:
            path.unlink(missing_ok=True)


NAME = "openvino"
DEVICE = "CPU"
_SS_DISABLE = 2
"""bits/ss_flags.h: no alternate stack."""


class _StackT(ctypes.Structure):
    """stack_t of Linux, see sigaltstack(2)."""

    _fields_ = (
        ("ss_sp", ctypes.c_void_p),
        ("ss_flags", ctypes.c_int),
        ("ss_size", ctypes.c_size_t),
    )


@contextlib.contextmanager
def signal_stack_kept() -> Iterator[None]:
    """Context manager: restore the calling thread's alternate signal stack, or its absence.

    OpenVINO's CPU plugin gives the loading thread an alternate signal stack, and frees that memory
    with the last of its objects. Python's handlers use the alternate stack, so the next Ctrl-C
    would run in freed memory and end the process while it still holds the vehicle. (Seen with
    2026.4: ``sigaltstack`` after loading, a segmentation fault in ``kill`` later.)
    """
    if sys.platform != "linux":
        yield
        return
    sigaltstack = ctypes.CDLL(None, use_errno=True).sigaltstack
    before = _StackT()
    sigaltstack(None, ctypes.byref(before))
    try:
        yield
    finally:
        if sigaltstack(ctypes.byref(before), None) != 0:
            # Too small for the registers that the CPU now saves (AMX): no stack beats a freed one.
            none = _StackT(ss_sp=None, ss_flags=_SS_DISABLE, ss_size=0)
            sigaltstack(ctypes.byref(none), None)


@signal_stack_kept()
def precisions() -> tuple[tuple[Precision, Precision], ...]:
    """Return pairs of precisions to try for the image and the action path, the fastest first.

    bf16 only if the CPU computes in it; elsewhere it is emulated, or slower than float32.
    """
    if "BF16" in ov.Core().get_property(DEVICE, "OPTIMIZATION_CAPABILITIES"):
        return ("bf16", "bf16"), ("bf16", "f32"), ("f32", "f32")
    return (("f32", "f32"),)


def engine_name(vision: Precision, action: Precision) -> str:
    """Return the name of the engine at these precisions of the image and the action path."""
    return f"{NAME}-{vision}" if vision == action else f"{NAME}-{vision}-{action}"


def compile_graph(subject: str, precision: Precision, build: Callable[[], "ov.Model"]) -> "Graph":
    """Compile the graph of ``build``, or load it from the cache by ``subject``, which is a text
    that identifies its content."""
    properties = {
        "PERFORMANCE_HINT": "LATENCY",
        "NUM_STREAMS": "1",
        "INFERENCE_NUM_THREADS": "1",
        "ENABLE_CPU_PINNING": "NO",
        "INFERENCE_PRECISION_HINT": precision,
    }
    core, code = ov.Core(), hashlib.sha256()
    here = Path(__file__).parent
    traced = ("engines/openvino_*.py", "nets/*.py", "*.py", "motion/rotation.py")
    for source in sorted(path for each in traced for path in here.parent.glob(each)):
        code.update(source.read_bytes())
    facts = [
        core.get_property(DEVICE, n) for n in ("FULL_DEVICE_NAME", "OPTIMIZATION_CAPABILITIES")
    ]
    versions = f"{ov.__version__} {torch.__version__}"
    key = f"{subject} {code.hexdigest()} {versions} {facts} {properties}"
    path = user_cache_folder() / NAME / f"{hashlib.sha256(key.encode()).hexdigest()}.graph"
    if (stored := load_blob(path)) is not None:
        try:
            return Graph(core.import_model(io.BytesIO(stored), DEVICE, properties))
        except RuntimeError:
            pass  # from another build: compile it again
    compiled = core.compile_model(build(), DEVICE, properties)
    store_blob(path, compiled.export_model().getvalue())
    return Graph(compiled)


class Graph:
    """Compiled graph with its own arrays at every input; for one thread."""

    def __init__(self, compiled: "ov.CompiledModel") -> None:
        self._request = compiled.create_infer_request()
        self._inputs = [np.zeros(port.shape, np.float32) for port in compiled.inputs]
        for index, array in enumerate(self._inputs):
            self._request.set_input_tensor(index, ov.Tensor(array, shared_memory=True))
        self._outputs = [np.zeros(port.shape, np.float32) for port in compiled.outputs]
        for index, array in enumerate(self._outputs):
            self._request.set_output_tensor(index, ov.Tensor(array, shared_memory=True))

    def __call__(self, *arrays: FloatArray) -> FloatArray:
        """Run the graph and return a copy of its first output; reject arrays of another shape."""
        for index, (own, array) in enumerate(zip(self._inputs, arrays, strict=True)):
            if own.shape != array.shape:
                raise PolicyError(
                    f"input {index} must be {list(own.shape)}, got {list(array.shape)}"
                )
            np.copyto(own, array)
        self._request.infer()
        return self._outputs[0].copy()

    def rest(self) -> list[FloatArray]:
        """Return copies of the other outputs of the last run."""
        return [array.copy() for array in self._outputs[1:]]
