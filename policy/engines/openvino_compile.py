"""OpenVINO graphs compiled for the CPU, or taken from the user's cache.

Each graph infers on the calling thread alone, without the GIL, on arrays that are bound once.
Threads are not pinned to cores: measured beside a second loop, pinning was slower or made no
difference.
"""

import contextlib
import hashlib
import io
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import openvino as ov
import torch

from policy.contract import FloatArray
from policy.engines.runner import Precision
from policy.engines.signal_stack import signal_stack_kept
from policy.errors import PolicyError
from policy.files import whole_file

MAX_ENTRIES = 24
"""Files kept, about eight policies of two graphs each, some at two precisions; the least recently
used is dropped first."""
MAX_BYTES = 2_000_000_000
"""Size of all files together: the graphs of a large policy are as large as its weights."""
_DIGEST_BYTES = hashlib.sha256().digest_size


def user_cache_folder() -> Path:
    """XDG base directory specification: $XDG_CACHE_HOME or ~/.cache; an own folder in it."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    # The specification says to ignore a relative path.
    root = Path(base) if Path(base).is_absolute() else Path("~/.cache").expanduser()
    return root / "mavbridge"


class CompileCache:
    """Bytes by key, in one folder of a file each."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def load(self, key: str) -> bytes | None:
        """The bytes stored under ``key``; None if there are none, or they are damaged."""
        path = self._path(key)
        try:
            content = path.read_bytes()
            path.touch()
        except OSError:
            return None
        digest, blob = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
        return blob if hashlib.sha256(blob).digest() == digest else None

    def store(self, key: str, blob: bytes) -> None:
        """Keep ``blob`` if possible; the oldest beyond ``MAX_ENTRIES`` or ``MAX_BYTES`` go."""
        with contextlib.suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
            with whole_file(self._path(key)) as draft:
                draft.write_bytes(hashlib.sha256(blob).digest() + blob)
            self._make_room()

    def _path(self, key: str) -> Path:
        return self._folder / f"{hashlib.sha256(key.encode()).hexdigest()}.graph"

    def _make_room(self) -> None:
        entries = []
        for path in self._folder.glob("*.graph*"):  # leftovers of a killed process count too
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


@signal_stack_kept()
def precisions() -> tuple[tuple[Precision, Precision], ...]:
    """Pairs to try for the image and the action path, the fastest first.

    bf16 only where the CPU computes in it; elsewhere it is emulated, or slower than float32.
    """
    if "BF16" in ov.Core().get_property(DEVICE, "OPTIMIZATION_CAPABILITIES"):
        return ("bf16", "bf16"), ("bf16", "f32"), ("f32", "f32")
    return (("f32", "f32"),)


def engine_name(vision: Precision, action: Precision) -> str:
    """Name of the engine at these precisions of the image and the action path."""
    return f"{NAME}-{vision}" if vision == action else f"{NAME}-{vision}-{action}"


class GraphCompiler:
    """Compiles graphs; ``subject`` is a text that differs wherever one of its graphs does."""

    def __init__(self, subject: str) -> None:
        self._core = ov.Core()
        self._cache = CompileCache(user_cache_folder() / NAME)
        digest = hashlib.sha256()
        here = Path(__file__).parent
        for source in sorted([*here.glob("openvino_*.py"), *here.parent.glob("nets/*.py")]):
            digest.update(source.read_bytes())
        cpu = self._core.get_property(DEVICE, "FULL_DEVICE_NAME")
        capabilities = self._core.get_property(DEVICE, "OPTIMIZATION_CAPABILITIES")
        versions = f"{ov.__version__} {torch.__version__}"
        self._key = f"{subject} {digest.hexdigest()} {versions} {cpu} {capabilities}"

    def compile(self, name: str, precision: Precision, build: Callable[[], "ov.Model"]) -> "Graph":
        """The graph that ``build`` makes, at a precision; ``name`` tells it from others here."""
        properties = {
            "PERFORMANCE_HINT": "LATENCY",
            "NUM_STREAMS": "1",
            "INFERENCE_NUM_THREADS": "1",
            "ENABLE_CPU_PINNING": "NO",
            "INFERENCE_PRECISION_HINT": precision,
        }
        key = f"{self._key} {name} {properties}"
        stored = self._cache.load(key)
        if stored is not None:
            try:
                return Graph(self._core.import_model(io.BytesIO(stored), DEVICE, properties))
            except RuntimeError:
                pass  # of another build after all: compile it again
        compiled = self._core.compile_model(build(), DEVICE, properties)
        self._cache.store(key, compiled.export_model().getvalue())
        return Graph(compiled)


class Graph:
    """One compiled graph with arrays of its own at every input; for one thread."""

    def __init__(self, compiled: "ov.CompiledModel") -> None:
        self._request = compiled.create_infer_request()
        self._inputs = [np.zeros(port.shape, np.float32) for port in compiled.inputs]
        for index, array in enumerate(self._inputs):
            self._request.set_input_tensor(index, ov.Tensor(array, shared_memory=True))
        self._outputs = [np.zeros(port.shape, np.float32) for port in compiled.outputs]
        for index, array in enumerate(self._outputs):
            self._request.set_output_tensor(index, ov.Tensor(array, shared_memory=True))

    def __call__(self, *arrays: FloatArray) -> FloatArray:
        """Return the first output of a run, the caller's; refuses an array of another shape."""
        for index, (own, array) in enumerate(zip(self._inputs, arrays, strict=True)):
            if own.shape != array.shape:
                raise PolicyError(
                    f"input {index} must be {list(own.shape)}, got {list(array.shape)}"
                )
            np.copyto(own, array)
        self._request.infer()
        return self._outputs[0].copy()

    def rest(self) -> list[FloatArray]:
        """Return copies of the further outputs of the last run."""
        return [array.copy() for array in self._outputs[1:]]
