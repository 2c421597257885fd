"""Choice of the engine: the fastest available one whose output agrees with plain torch.

An engine that cannot be created, or fails the parity check, is skipped with a note of the reason.
Torch, the reference, is last.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec

import numpy as np
import torch

from policy.contract import (
    QUATERNION,
    SINCE_EXPOSURE_DIM,
    STATE_DIM,
    CameraImage,
    Contract,
    FloatArray,
)
from policy.engines.runner import EngineName, ExecutionSettings, encode_all
from policy.engines.torch_engines import (
    make_cuda_graph_runner,
    make_torch_runner,
    modules_of,
)
from policy.errors import Agreed, NoChunkError, PolicyError, warned
from policy.nets.toge import Toge
from policy.preprocess import SINCE_EXPOSURE_SCALE
from policy.protocol import PolicyRunner, SingleRatePolicy

MIN_COSINE = 0.999
"""Minimum cosine between the two chunks of a sample, taken as vectors."""
MAX_ACTION_ERROR = 0.01
"""Largest difference, of full deflection (5 us of PWM on the usual 1000..2000 us), or of the
largest value where actions exceed 1, as m/s and rad/s do."""
SAMPLES = 4
_NOT_REPEATED = (
    "the same inputs do not give the same chunk again, so it draws random numbers, or keeps "
    "something from call to call"
)
Candidate = tuple[str, Callable[[], PolicyRunner]]
"""Name of an engine to try, and the function that creates its runner.

It raises PolicyError or RuntimeError for a policy that the engine cannot run."""


@dataclass(frozen=True, kw_only=True)
class ParitySamples:
    """Synthetic samples that exercise every input of a policy; equal for equal contracts.

    They are rgb [samples, H, W, 3] or depth in its place, state [samples, state_dim] and history
    [samples, K, 4]. Several cameras or observations add axes as in ``Contract.image_shape``.
    """

    rgb: CameraImage
    state: FloatArray
    history: FloatArray


def make_parity_samples(contract: Contract) -> ParitySamples:
    """Return smooth random images, with states and sticks of a fast flight."""
    random = np.random.default_rng(0)
    height, width = contract.image_height, contract.image_width
    images = (SAMPLES, *contract.image_shape[:-3])
    coarse = random.integers(0, 256, (*images, 8, 8, 3), dtype=np.uint8)
    rows, columns = np.arange(height) * 8 // height, np.arange(width) * 8 // width
    fine = random.integers(0, 32, (*images, height, width, 3), dtype=np.uint8)
    rgb = coarse[..., rows, :, :][..., columns, :] // 8 * 7 + fine
    states = (SAMPLES, *contract.state_shape[:-1])
    parts = [random.normal(0.0, 2.0, (*states, STATE_DIM))]
    parts[0][..., QUATERNION] /= np.linalg.norm(parts[0][..., QUATERNION], axis=-1, keepdims=True)
    history = random.uniform(-1.0, 1.0, (SAMPLES, *contract.history_shape))
    if contract.since_exposure:
        since = random.uniform(-1.0, 1.0, (*states, SINCE_EXPOSURE_DIM)) * SINCE_EXPOSURE_SCALE
        since[..., 0] = np.abs(since[..., 0])
        parts.append(since)
    extras = contract.state_dim - sum(part.shape[-1] for part in parts)
    parts.append(random.normal(0.0, 5.0, (*states, extras)))  # metres
    pixels: CameraImage = rgb.astype(np.uint8)
    return ParitySamples(
        rgb=64 * pixels[..., 0].astype(np.uint16) if contract.is_depth else pixels,
        state=np.concatenate(parts, axis=-1).astype(np.float32),
        history=history.astype(np.float32),
    )


def parity_failure(expected: FloatArray, chunks: FloatArray) -> str | None:
    """Return why two arrays of chunks [samples, horizon, 4] disagree, or None."""
    if expected.shape != chunks.shape:
        return f"chunks of shape {list(chunks.shape)} instead of {list(expected.shape)}"
    if not np.isfinite(chunks).all():
        return "NaN or infinity in a chunk"
    reach = np.abs(expected).max(axis=(0, 1)).clip(min=1.0)
    furthest = float((np.abs(expected - chunks) / reach).max())
    cosine = min(_cosine(a, b) for a, b in zip(expected, chunks, strict=True))
    if furthest <= MAX_ACTION_ERROR and cosine >= MIN_COSINE:
        return None
    return (
        f"an action is off by {furthest:.4f} (at most {MAX_ACTION_ERROR}), the cosine is "
        f"{cosine:.5f} (at least {MIN_COSINE})"
    )


def _cosine(a: FloatArray, b: FloatArray) -> float:
    lengths = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float((a * b).sum()) / lengths if lengths > 0 else float(np.array_equal(a, b))


def choose_runner(
    policy: SingleRatePolicy, engine: EngineName, settings: ExecutionSettings
) -> tuple[PolicyRunner, tuple[str, ...]]:
    """Return the runner, and lines for the user: the engine, and why faster ones were skipped.

    ``auto`` is the fastest engine: for a policy whose parts keep nothing from call to call.
    """
    modules = modules_of(policy)
    for module in modules:
        module.eval()  # before any engine inspects it: a flight does not train
    if engine == "torch" or (engine == "auto" and not modules):
        return make_torch_runner(policy, settings), ()
    if not modules:
        raise PolicyError(
            f"network.engine={engine} takes a torch.nn.Module, or a class that holds one as an "
            f"attribute: leave it out, and {settings.name} runs on torch"
        )
    if not isinstance(policy, Toge):
        if engine == "auto" and settings.device != "cpu":
            return make_torch_runner(policy, settings), ()
        if hasattr(policy, "reset"):
            note = (
                "engine torch: the policy has reset, so it keeps something from call to call, "
                "which a graph cannot; without reset it is converted to the faster openvino"
            )
            return make_torch_runner(policy, settings), (note,)
    candidates = _candidates(policy, engine, settings)
    return first_that_agrees(policy, candidates, settings)


def first_that_agrees(
    policy: SingleRatePolicy, candidates: list[Candidate], settings: ExecutionSettings
) -> tuple[PolicyRunner, tuple[str, ...]]:
    """Return the first candidate that passes the check, or torch; and a line per skipped one."""
    if not candidates:
        return make_torch_runner(policy, settings), ()
    reference = make_torch_runner(policy, replace(settings, device="cpu"))
    try:
        runner, notes = fastest_like(reference, candidates)
    except NoChunkError as error:
        note = f"engine torch: it has no chunk for a sample, which a graph cannot say: {error}"
        return make_torch_runner(policy, settings), (note,)
    is_elsewhere = runner is reference and settings.device != "cpu"
    return make_torch_runner(policy, settings) if is_elsewhere else runner, notes


def fastest_like(
    reference: PolicyRunner, faster: Sequence[Candidate]
) -> tuple[PolicyRunner, tuple[str, ...]]:
    """Return the first candidate with the chunks of a float32 runner, else that; and notes."""
    samples = make_parity_samples(reference.contract)
    expected = chunks_of_samples(reference, samples)
    if not np.array_equal(chunks_of_samples(reference, samples), expected, equal_nan=True):
        return reference, (warned(f"engine {reference.engine}: {_NOT_REPEATED}"),)
    notes: list[str] = []
    for label, make in faster:
        try:
            runner = make()
            reason = parity_failure(expected, chunks_of_samples(runner, samples))
        except (PolicyError, RuntimeError, TypeError) as error:
            told = [*str(error).strip().splitlines(), "(nothing)"][0]
            reason = f"{type(error).__name__}: {told}"
        if reason is None:
            agreed = f"engine {runner.engine}: agrees with"
            is_torch = reference.engine == "torch"
            return runner, (*notes, Agreed(f"{agreed} torch") if is_torch else f"{agreed} float32")
        notes.append(warned(f"engine {label} is passed over: {reason}"))
    return reference, (*notes, f"engine {reference.engine}")


def chunks_of_samples(runner: PolicyRunner, samples: ParitySamples) -> FloatArray:
    """Return chunks [samples, horizon, 4] of the whole path from image to stick, after a reset."""
    runner.reset()
    inputs = zip(samples.rgb, samples.state, samples.history, strict=True)
    return np.concatenate(
        [runner.act(encode_all(runner, rgb), s[None], h[None]) for rgb, s, h in inputs]
    )


def _candidates(
    policy: SingleRatePolicy, engine: EngineName, settings: ExecutionSettings
) -> list[Candidate]:
    device = settings.device.partition(":")[0]
    if engine == "openvino" and device != "cpu":
        raise PolicyError(f"network.engine=openvino runs on --device cpu, not on {device}")
    if engine == "cuda-graph" and device != "cuda":
        raise PolicyError(f"network.engine=cuda-graph runs on --device cuda, not on {device}")
    if device == "cpu" and find_spec("openvino") is not None:
        from policy.engines.openvino_compile import precisions
        from policy.engines.openvino_modules import ModuleConverter, make_module_runner

        make = partial(make_module_runner, ModuleConverter(policy, settings))
        return [
            (
                f"openvino (images {pair[0]}, actions {pair[1]})",
                partial(make, policy, settings, *pair),
            )
            for pair in precisions()
        ]
    if engine == "openvino":
        raise PolicyError("network.engine=openvino: the package is missing; pip install openvino")
    if device == "cuda" and torch.cuda.is_available():
        return [("cuda-graph", partial(make_cuda_graph_runner, policy, settings))]
    return []
