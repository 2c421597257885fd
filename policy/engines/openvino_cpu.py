"""OpenVINO on the CPU: the image path and the action path as one compiled graph each.

Each path infers on its own thread alone, without the GIL, on arrays that are bound once. Threads
are not pinned to cores: measured beside a second loop, pinning was slower or made no difference.
"""

import hashlib
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import openvino as ov

from policy.contract import Executable, FloatArray, PolicyError
from policy.engines.compile_cache import CompileCache, user_cache_folder
from policy.engines.executable import Precision, Settings, assemble
from policy.engines.openvino_graph import refine_graph, sample_graph, vision_graph
from policy.engines.signal_stack import signal_stack_kept
from policy.preprocess import egocentric
from policy.resnet_unet import ResnetUnet
from policy.toge import Toge

NAME = "openvino"
DEVICE = "CPU"

_PROPERTIES = {
    "PERFORMANCE_HINT": "LATENCY",
    "NUM_STREAMS": "1",
    "INFERENCE_NUM_THREADS": "1",
    "ENABLE_CPU_PINNING": "NO",
}


@signal_stack_kept()
def precisions() -> tuple[tuple[Precision, Precision], ...]:
    """Pairs to try for the image and the action path, the fastest first.

    bf16 only where the CPU computes in it; elsewhere it is emulated, or slower than float32.
    """
    if "BF16" in ov.Core().get_property(DEVICE, "OPTIMIZATION_CAPABILITIES"):
        return ("bf16", "bf16"), ("bf16", "f32"), ("f32", "f32")
    return (("f32", "f32"),)


@signal_stack_kept()
def make_openvino_executable(
    policy: Toge | ResnetUnet, settings: Settings, vision: Precision, action: Precision
) -> Executable:
    """Compile a policy for the loops, or take it from the user's cache; tried once.

    Args:
        policy: on the CPU; its initial noise is taken as it is now.
        settings: what was asked for.
        vision: precision of the image path.
        action: precision of the action path.

    Raises:
        PolicyError: the policy failed on a dummy sample.
        RuntimeError: OpenVINO cannot compile it.
    """
    compiler = _Compiler(policy)
    noise = policy.head.initial_noise.cpu().numpy().copy()
    steps, head_steps = settings.num_diffusion_steps, settings.head_steps
    encode = compiler.compile("vision", vision, lambda: vision_graph(policy))
    run_sample = compiler.compile(f"sample {steps}", action, lambda: sample_graph(policy, steps))

    def sample(encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        return run_sample(encoded, egocentric(state, policy.contract), history, noise)

    name = f"{NAME}-{vision}" if vision == action else f"{NAME}-{vision}-{action}"
    if not settings.dual_rate:

        def from_image(image: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
            return sample(encode(image), state, history)

        return assemble(policy.contract, lambda image: image, from_image, None, name, settings)
    if head_steps is None or not isinstance(policy, Toge):
        return assemble(policy.contract, encode, sample, None, name, settings)
    warm = policy
    run_refine = compiler.compile(
        f"refine {steps} {head_steps}", action, lambda: refine_graph(warm, steps, head_steps)
    )

    def refine(
        encoded: FloatArray, state: FloatArray, history: FloatArray, guess: FloatArray
    ) -> FloatArray:
        return run_refine(encoded, egocentric(state, warm.contract), history, guess, noise)

    return assemble(policy.contract, encode, sample, refine, name, settings)


class _Compiler:
    """Compiles the graphs of one policy; a key holds all that the result depends on."""

    def __init__(self, policy: Toge | ResnetUnet) -> None:
        self._core = ov.Core()
        self._cache = CompileCache(user_cache_folder() / NAME)
        digest = hashlib.sha256()
        for source in sorted(Path(__file__).parent.glob("openvino_*.py")):
            digest.update(source.read_bytes())
        for name, value in policy.state_dict().items():
            digest.update(f"{name} {value.dtype} {list(value.shape)}".encode())
            digest.update(value.cpu().contiguous().numpy())
        cpu = self._core.get_property(DEVICE, "FULL_DEVICE_NAME")
        capabilities = self._core.get_property(DEVICE, "OPTIMIZATION_CAPABILITIES")
        self._key = f"{digest.hexdigest()} {policy.config} {ov.__version__} {cpu} {capabilities}"

    def compile(self, name: str, precision: Precision, build: Callable[[], "ov.Model"]) -> "_Graph":
        properties = {**_PROPERTIES, "INFERENCE_PRECISION_HINT": precision}
        key = f"{self._key} {name} {properties}"
        stored = self._cache.load(key)
        if stored is not None:
            try:
                return _Graph(self._core.import_model(io.BytesIO(stored), DEVICE, properties))
            except RuntimeError:
                pass  # of another build after all: compile it again
        compiled = self._core.compile_model(build(), DEVICE, properties)
        self._cache.store(key, compiled.export_model().getvalue())
        return _Graph(compiled)


class _Graph:
    """One compiled graph with arrays of its own at every input; for one thread."""

    def __init__(self, compiled: "ov.CompiledModel") -> None:
        self._request = compiled.create_infer_request()
        self._inputs = [np.zeros(port.shape, np.float32) for port in compiled.inputs]
        for index, array in enumerate(self._inputs):
            self._request.set_input_tensor(index, ov.Tensor(array, shared_memory=True))
        self._output = np.zeros(compiled.output(0).shape, np.float32)
        self._request.set_output_tensor(ov.Tensor(self._output, shared_memory=True))

    def __call__(self, *arrays: FloatArray) -> FloatArray:
        """Run the graph; the result is the caller's.

        Raises:
            PolicyError: an array is not of the input's shape.
        """
        for index, (own, array) in enumerate(zip(self._inputs, arrays, strict=True)):
            if own.shape != array.shape:
                raise PolicyError(
                    f"input {index} must be {list(own.shape)}, got {list(array.shape)}"
                )
            np.copyto(own, array)
        self._request.infer()
        return self._output.copy()
